"""dnrtrain stands on torch alone, no import runs upwards or in a circle, every module imports. The checks can fail."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import dnrpipe
import dnrtrain

PACKAGE = Path(dnrtrain.__file__).parent
PACKAGES = (Path(dnrpipe.__file__).parent, PACKAGE)
TOP = {path.name for path in PACKAGES[0].iterdir() if path.is_dir()}

# Imports every module of dnrtrain in a Python that behaves as if the others were not installed.
CODE = """
import importlib, importlib.abc, pkgutil, sys
FORBIDDEN = {"bpy", "bmesh", "mathutils", "mitsuba", "drjit", "dnrpipe", "click", "rich", "filelock", "jinja2",
             "matplotlib", "PIL", "flip_evaluator", "imageio_ffmpeg", "OpenEXR"}

class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in FORBIDDEN:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
sys.path.insert(0, sys.argv[1])
import dnrtrain
assert dnrtrain.__path__[0].startswith(sys.argv[1]), dnrtrain.__path__
assert "torch" not in sys.modules, "import dnrtrain should cost nothing"
names = [m.name for m in pkgutil.walk_packages(dnrtrain.__path__, "dnrtrain.")]
for name in names:
    importlib.import_module(name)
print(len(names))
"""


def _import_all(root: Path) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, "-c", CODE, str(root)], capture_output=True, text=True, check=False, env=environment
    )


def test_dnrtrain_imports_with_torch_alone() -> None:
    done = _import_all(PACKAGE.parent)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == len(list(PACKAGE.rglob("*.py"))) - 1  # all but dnrtrain itself


def test_the_check_finds_a_forbidden_import(tmp_path: Path) -> None:
    for forbidden in ("bpy", "mitsuba", "dnrpipe.core.settings"):
        root = tmp_path / forbidden
        shutil.copytree(PACKAGE, root / "dnrtrain")
        with (root / "dnrtrain" / "metrics.py").open("a") as file:
            file.write(f"\nimport {forbidden}\n")
        done = _import_all(root)
        assert done.returncode != 0
        assert f"No module named '{forbidden.split('.')[0]}" in done.stderr


def test_import_linter_finds_a_forbidden_import(tmp_path: Path) -> None:
    """The contracts in pyproject.toml hold, and break when dnrtrain imports bpy."""
    repo = PACKAGE.parents[1]
    for name in ("pipeline", "trainer"):
        shutil.copytree(repo / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(repo / "pyproject.toml", tmp_path)
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path / 'pipeline'}:{tmp_path / 'trainer'}"}
    command = [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"]

    def lint() -> subprocess.CompletedProcess[str]:
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)

    clean = lint()
    assert clean.returncode == 0, clean.stdout
    with (tmp_path / "trainer" / "dnrtrain" / "metrics.py").open("a") as file:
        file.write("\nimport bpy\n")
    broken = lint()
    assert broken.returncode != 0
    assert "bpy" in broken.stdout

    (tmp_path / "trainer" / "dnrtrain" / "metrics.py").write_text("")
    with (tmp_path / "pipeline" / "dnrpipe" / "core" / "errors.py").open("a") as file:
        file.write("\nimport dnrpipe.stages.stage\n")
    upwards = lint()
    assert upwards.returncode != 0
    assert "dnrpipe.core is not allowed to import dnrpipe.stages" in upwards.stdout


def _circles(*packages: Path) -> list[list[str]]:
    """Groups of modules that import each other in a loop, imports inside functions and for type checkers included."""
    graph = {name: _imports(name, path) for name, path in _modules(*packages).items()}
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:  # Tarjan's strongly connected components
        order[module] = low[module] = len(order)
        stack.append(module)
        for other in graph[module] & graph.keys():
            if other not in order:
                visit(other)
            if other in stack:
                low[module] = min(low[module], low[other])
        if low[module] == order[module]:
            group = [stack.pop()]
            while group[-1] != module:
                group.append(stack.pop())
            if len(group) > 1:
                found.append(sorted(group))

    for module in graph:
        if module not in order:
            visit(module)
    return found


def _modules(*packages: Path) -> dict[str, Path]:
    found = {}
    for package in packages:
        for path in package.rglob("*.py"):
            parts = path.relative_to(package.parent).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def _imports(module: str, path: Path) -> set[str]:
    """Names that the module imports: modules, and ``module.name`` of what it takes from them."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parts, *([node.module] if node.module else [])])
            found |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return found - {module, package}


def test_no_modules_import_each_other_in_a_circle() -> None:
    assert _circles(*PACKAGES) == []


def test_a_circle_is_found(tmp_path: Path) -> None:
    for package in PACKAGES:
        shutil.copytree(package, tmp_path / package.name, ignore=shutil.ignore_patterns("__pycache__"))
    copies = [tmp_path / package.name for package in PACKAGES]
    with (tmp_path / "dnrpipe" / "core" / "errors.py").open("a") as file:
        file.write("\n\ndef late() -> None:\n    from .settings import Settings\n")
    assert [{"dnrpipe.core.errors", "dnrpipe.core.settings"} <= set(circle) for circle in _circles(*copies)] == [True]


def test_only_packages_at_the_top_and_every_module_imports() -> None:
    """Modules are named in strings, too (workers): each of those exists."""
    top = {path.name for path in PACKAGES[0].iterdir() if path.suffix == ".py"}
    assert top == {"__init__.py"}
    known = _modules(*PACKAGES).keys()
    named = {
        name
        for path in (path for package in PACKAGES for path in package.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        for name in re.findall(r"^(dnrpipe(?:\.\w+){2,})$", node.value)
    }
    workers = {name for name in named if name.split(".")[1] in TOP}  # others name Blender's own data
    assert "dnrpipe.raytrace.tracer" in workers and workers <= known

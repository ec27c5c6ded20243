"""dnrtrain stands on torch alone: no Blender, no Mitsuba, no pipeline. And the check can fail."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import dnrtrain

PACKAGE = Path(dnrtrain.__file__).parent

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

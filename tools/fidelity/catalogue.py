"""The list of fidelity scenes. Builders register themselves with `scene`."""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

FAMILIES = ("principled", "shaders", "textures", "lights", "geometry")
SIDE = 96


@dataclass(frozen=True)
class Case:
    """One feature, isolated in one scene.

    name: of the builder; title: what a reader calls the feature; group: heading in the table.
    build: fills the open, empty Blender file. size: width, height in pixels.
    samples: factor on both renderers' samples per pixel, for scenes that converge slowly.
    formulas: names in `formulas` of what another exporter does here.
    source: all code that decides the scene, the builder's own and the shared studio's; layout does not count.
    """

    name: str
    title: str
    group: str
    build: Callable[[], None]
    size: tuple[int, int] = (SIDE, SIDE)
    samples: float = 1.0
    formulas: tuple[str, ...] = field(default=())
    source: str = ""


_CASES: dict[str, Case] = {}


def scene(
    title: str,
    group: str,
    *,
    size: tuple[int, int] = (SIDE, SIDE),
    samples: float = 1.0,
    formulas: tuple[str, ...] = (),
) -> Callable[[Callable[[], None]], Callable[[], None]]:
    """Register a builder. Its function name is the case's name."""

    def register(build: Callable[[], None]) -> Callable[[], None]:
        name = build.__name__
        if name in _CASES and _CASES[name].build.__module__ != build.__module__:
            raise ValueError(f"two fidelity scenes are called {name}")
        source = f"{_code(build)}\n{size}\n{samples}"
        _CASES[name] = Case(name, title, group, build, size, samples, formulas, source)
        return build

    return register


def _code(build: Callable[[], None]) -> str:
    """The builder's body and the studio as syntax trees, read once: a run does not change under an editor's hands."""
    own = ast.parse(textwrap.dedent(inspect.getsource(build))).body[0]
    assert isinstance(own, ast.FunctionDef)
    return "\n".join([_studio(), *(ast.dump(node) for node in own.body)])


@functools.cache
def _studio() -> str:
    return ast.dump(ast.parse(Path(__file__).with_name("studio.py").read_text(encoding="utf-8")))


def all_cases() -> dict[str, Case]:
    """Every case by name, in the order of the document. Imports bpy."""
    for family in FAMILIES:
        importlib.import_module(f".scenes_{family}", __package__)
    return dict(_CASES)

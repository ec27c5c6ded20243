"""``fleet.toml``: which scenes, with which settings, and which commands each of them goes through.

out = "fleet"                            # workspaces and summary; relative to this file, as scenes are
commands = ["run", "render --orbit 60"]  # of each scene, one after the other; default ["run"]
preset = "draft"
scenes = ["chairs/*.blend", "hall.blend"]

[settings]                               # of all
cameras.train = 40

[variants.cheap]                         # each scene once per variant; none: once
select.budget = 0
[variants.full]
select.budget = 25
"""

from __future__ import annotations

import json
import shlex
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from dnrtrain.settings import Strict

from ..core.errors import UserError
from ..core.scene_files import TAKES_SCENE
from ..core.settings import merge, resolve

TAKES_NO_FORCE = TAKES_NO_SETTINGS = ("export-nerf", "export-onnx", "export-gltf", "export-web")
FORGETS = ("render", "report")
"""Commands whose settings hold for themselves alone; the workspace does not remember them."""
COMMANDS = (
    *TAKES_SCENE,
    *("select", "raytrace-selected", "finetune", "evaluate", "render", "report"),
    *TAKES_NO_FORCE,
)
"""What a fleet may ask of a scene."""


class FleetFile(Strict):
    """See the module."""

    out: str = "fleet"
    commands: list[str] = Field(default=["run"], min_length=1)
    preset: str | None = None
    scenes: list[str] = Field(min_length=1)
    settings: dict[str, Any] = Field(default={})
    variants: dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")], dict[str, Any]] = Field(default={})


@dataclass(frozen=True)
class FleetJob:
    """One scene with one variant's settings. name: of its workspace. commands: words of each command line."""

    name: str
    scene: Path
    workspace: Path
    commands: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Fleet:
    """out: folder of workspaces and summary."""

    out: Path
    jobs: list[FleetJob]


def read_fleet(path: Path) -> Fleet:
    """The fleet that a file describes, checked before anything starts.

    A scene file that is missing fails when its turn comes, and stops no other.

    Raises UserError: it is missing, is no such TOML, names a command or setting that does not exist, or two scenes
    of one name.
    """
    try:
        given = FleetFile.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not valid TOML ({error})") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise UserError(f"{path}: {where}: {first['msg'].lower()}") from None
    out = (path.parent / given.out).absolute()
    commands = [_words(path, command) for command in given.commands]
    jobs: dict[str, FleetJob] = {}
    for scene in _scenes(path, given.scenes):
        for variant, own in (given.variants or {"": {}}).items():
            name = f"{scene.stem}-{variant}" if variant else scene.stem
            if name in jobs:
                raise UserError(f"{path}: {jobs[name].scene} and {scene} would both be {name}; rename one of them")
            settings = merge(given.settings, own)
            try:
                resolve(given.preset, settings, environment={})
            except UserError as error:
                raise UserError(f"{path}: {error}") from None
            workspace = out / f"{name}.dnr"
            lines = _lines(commands, scene, workspace, given.preset, settings)
            jobs[name] = FleetJob(name, scene, workspace, tuple(lines))
    return Fleet(out, list(jobs.values()))


def _scenes(path: Path, patterns: list[str]) -> list[Path]:
    """Scene files of the list, in its order; a pattern's by name."""
    found: list[Path] = []
    for pattern in patterns:
        base = Path(pattern)
        if any(character in pattern for character in "*?["):
            anchor = Path(base.anchor) if base.is_absolute() else path.parent
            matches = sorted(anchor.glob(str(base.relative_to(base.anchor) if base.is_absolute() else base)))
            if not matches:
                raise UserError(f"{path}: scenes: {pattern} matches no file")
        else:
            matches = [path.parent / base]
        found += [match.absolute() for match in matches if match.absolute() not in found]
    return found


def _words(path: Path, command: str) -> list[str]:
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise UserError(f"{path}: commands: {command!r}: {error}") from None
    if not words or words[0] not in COMMANDS:
        raise UserError(f"{path}: commands: {command!r} is none of {', '.join(COMMANDS)}")
    for refused in ("-w", "--workspace", "--json"):
        if refused in words:
            raise UserError(f"{path}: commands: {command!r}: {refused} is the fleet's to say")
    return words


def _lines(
    commands: list[list[str]], scene: Path, workspace: Path, preset: str | None, settings: dict[str, Any]
) -> list[tuple[str, ...]]:
    """Command lines of a scene. Commands are given all settings until one has remembered them in the workspace for the
    others; the executor, which is not remembered, is given to each."""
    flags = [*(["--preset", preset] if preset else []), *_assignments(settings)]
    own = _assignments({key: value for key, value in settings.items() if key == "executor"})
    lines, told = [], False
    for name, *more in commands:
        scene_words = [str(scene)] if name in TAKES_SCENE else []
        if name in TAKES_NO_SETTINGS:
            given = []
        else:
            given = own if told and not scene_words else flags
            told = told or name not in FORGETS
        lines.append((name, *scene_words, *given, *more, "-w", str(workspace)))
    return lines


def _assignments(settings: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Nested settings as ``--set`` flags."""
    flags: list[str] = []
    for key, value in settings.items():
        if isinstance(value, Mapping):
            flags += _assignments(value, f"{prefix}{key}.")
        else:
            flags += ["--set", f"{prefix}{key}={json.dumps(value)}"]
    return flags

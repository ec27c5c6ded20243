"""Read ``scene/``: summary, census, frame, and the fingerprint of what the scene was converted from."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dnrtrain.contract import SPLITS, DamagedFile, SceneFrame, View, read_cameras
from dnrtrain.records import Model, Selection, read

from .errors import UserError
from .scene_records import Census, Conversion, RasterChoice, SceneSummary
from .workspace import Workspace, digest, sha256_now

TAKES_SCENE = ("run", "prepare", "shot")
"""Commands that read a scene file: the one they are given, else that of the workspace."""
SCENE_VERSION = 9  # raise when the conversion or the G-buffer scene changes what it writes


def read_json(path: Path) -> Any:
    """JSON that an earlier stage wrote. Raises UserError when it is missing, DamagedFile when it does not read."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{path}: is missing; run `dnrpipe prepare --force`") from None
    except (ValueError, RecursionError) as error:
        raise DamagedFile(path, str(error)) from None


def read_record(path: Path, kind: type[Model]) -> Model:
    """JSON that an earlier stage wrote, as a record. Raises UserError, DamagedFile as `read_json`."""
    try:
        return read(path, kind)
    except FileNotFoundError:
        raise UserError(f"{path}: is missing; run `dnrpipe prepare --force`") from None


def _of_scene(name: str, kind: type[Model]) -> Callable[[Path], Model]:
    """Reads the file of that name in the folder ``scene/``. Raises UserError, DamagedFile as `read_json`."""
    return lambda scene: read_record(scene / name, kind)


read_summary = _of_scene("summary.json", SceneSummary)
read_census = _of_scene("census.json", Census)
read_conversion = _of_scene("prepared.json", Conversion)


def read_raster_choice(workspace: Workspace) -> RasterChoice | None:
    """``passes/raster.json``, or None while no engine is chosen. Raises DamagedFile as `read_json`."""
    path = workspace.root / "passes" / "raster.json"
    return read_record(path, RasterChoice) if path.exists() else None


def read_frame(workspace: Workspace) -> SceneFrame:
    """``scene/frame.json``. Raises UserError, DamagedFile as `read_json`."""
    return read_record(workspace.scene / "frame.json", SceneFrame)


def scene_fingerprint(workspace: Workspace) -> str:
    """Hash of what the scene is converted from: the scene file and the files it refers to.

    A file that is gone counts as it was: a workspace lives without its sources. A missing or damaged summary counts
    as one without such files.
    """
    try:
        summary = read_summary(workspace.scene)
        recorded, bake_size = summary.external, summary.bake_size
    except (UserError, DamagedFile):
        recorded, bake_size = {}, None
    current = {name: sha256_now(Path(name)) if Path(name).is_file() else sha for name, sha in recorded.items()}
    # Without their folders: moving a scene with its textures changes nothing.
    files = sorted((Path(name).name, sha) for name, sha in current.items())
    return digest([SCENE_VERSION, workspace.manifest.source.sha256, files, bake_size])


def split_views(workspace: Workspace) -> dict[str, list[View]]:
    """The views of each split, as `prepare` placed them."""
    return {split: read_cameras(workspace.cameras(split)) for split in SPLITS if workspace.cameras(split).exists()}


def read_selection(workspace: Workspace) -> Selection:
    """``selection.json``. Raises UserError: there is none. DamagedFile: it does not read, or names other views."""
    path = workspace.selection
    try:
        selection = read(path, Selection)
    except FileNotFoundError:
        raise UserError(f"{workspace.root}: no views selected yet; run `dnrpipe select` first") from None
    cameras = workspace.cameras("train")
    unknown = sorted(set(selection.views) - {view.name for view in read_cameras(cameras)}) if cameras.exists() else []
    if unknown:
        raise DamagedFile(path, f"views {', '.join(unknown)[:200]} are no candidates")
    return selection

"""From a scene file or a camera file to the frames of a shot, and a workspace that is prepared for them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dnrtrain.atomic import write_json
from dnrtrain.contract import View

from ...core.cameras import read_camera_file, shot_views, spread
from ...core.errors import UserError
from ...core.shot_records import told_frames
from ...core.workspace import file_sha256
from ..session import Session
from ..shot_scene import look_at_shot
from .records import ShotFrame

CANDIDATES = 40
"""Frames that may be traced to train on, at most."""
CAMERAS = "candidates.json"
"""The workspace's cameras, in the shot's folder."""
SIZE = re.compile(r"(\d+)\s*[x×]\s*(\d+)")
LEAST, MOST = 16, 16384
FPS = 24.0


@dataclass(frozen=True)
class ShotFile:
    """A shot as its file has it.

    Args:
        moving: what changes over its frames, in words, by name.
        transparent: the world behind everything is left out.
        warnings: lines for the user.
    """

    frames: list[ShotFrame]
    fps: float
    moving: dict[str, str] = field(default_factory=dict)
    transparent: bool = False
    warnings: tuple[str, ...] = ()


def parse_size(text: str) -> tuple[int, int]:
    """``1280x720`` -> (width, height). Raises UserError: anything else, or no size of a picture."""
    found = SIZE.fullmatch(text.strip().lower())
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    if not all(LEAST <= side <= MOST for side in size):
        raise UserError(f"--size {text}: expected WIDTHxHEIGHT in pixels, {LEAST} to {MOST} each, such as 1280x720")
    return size


def shot_of_scene(
    scene: Path, frames: Sequence[int] | None, camera: str | None, size: tuple[int, int] | None, log: Path
) -> ShotFile:
    """The file's animated cameras. size: None for the file's own. Raises UserError as `look_at_shot` does."""
    found = look_at_shot(scene, frames, camera, log)
    views = shot_views(found, *(size or found.resolution))
    return ShotFile(
        [
            ShotFrame(number=number, camera=own.name, view=view, lens=own.dof, moving=tuple(found.changing(number)))
            for number, own, view in zip(found.frames, found.cameras, views, strict=True)
        ],
        found.fps,
        {change.name: f"{change.kind} in {told_frames(change.frames)}" for change in found.changes},
        found.film_transparent,
        tuple(found.warnings),
    )


def shot_of_cameras(path: Path, session: Session, size: tuple[int, int] | None) -> ShotFile:
    """The views of a NeRF ``transforms.json``, in their order, as frames from 1 on; nothing moves in them.

    Raises UserError: broken, or of several sizes.
    """
    cameras = session.settings.cameras
    width, height = size or (cameras.width, cameras.height)
    views = read_camera_file(path, cameras.model_copy(update={"width": width, "height": height}))
    if size is not None:
        views = [resized(view, *size) for view in views]
    return ShotFile([ShotFrame(number=i + 1, camera=path.stem, view=view) for i, view in enumerate(views)], FPS)


def resized(view: View, width: int, height: int) -> View:
    """The view on pictures of another size: what it sees across stays."""
    scale = width / view.width
    return view.model_copy(
        update={
            "width": width,
            "height": height,
            "fl_x": view.fl_x * scale,
            "fl_y": view.fl_y * scale,
            "cx": width / 2 + (view.cx - view.width / 2) * scale,
            "cy": height / 2 + (view.cy - view.height / 2) * scale,
        }
    )


def prepare_for(session: Session, folder: Path, frames: Sequence[ShotFrame], held_out: Sequence[int]) -> None:
    """Prepare the session's workspace for the shot: its candidates are frames that stand still.

    held_out: places of frames that are not among them. Raises UserError as `prepare` does, and where a renderer was
    trained on views of other cameras: it would be lost.
    """
    manifest = session.workspace.manifest
    selected = manifest.stages.get("select")
    if selected is not None and selected.detail["views"] and not _is_of_a_shot(session.settings.cameras.source):
        raise UserError(
            f"{session.workspace.root}: views of other cameras were chosen here (cameras.source ="
            f" {session.settings.cameras.source}); a shot needs a workspace of its own: name another with -w"
        )
    still = [place for place, frame in enumerate(frames) if not frame.moving and place not in held_out]
    chosen = [(place, "train") for place in spread(still or range(len(frames)), CANDIDATES)]
    chosen += [(place, "test") for place in held_out]
    path = folder / CAMERAS
    write_json(path, {"camera_model": "OPENCV", "frames": [_entry(frames[place], split) for place, split in chosen]})
    view = frames[0].view
    cameras: dict[str, Any] = {"source": str(path.resolve()), "source_sha256": file_sha256(path)}
    session.adopt({"cameras": {**cameras, "width": view.width, "height": view.height}, "select": {"budget": 0}})
    session.stages("prepare")


def _is_of_a_shot(source: str) -> bool:
    """Whether a camera file is one that `prepare_for` wrote: ``shots/NAME/candidates.json``, of a workspace that may
    have lain elsewhere then."""
    path = Path(source)
    return path.name == CAMERAS and path.parent.parent.name == "shots"


def _entry(frame: ShotFrame, split: str) -> dict[str, Any]:
    view = frame.view
    matrix = [list(row) for row in view.c2w]
    return {"file_path": view.name, "split": split, **view.intrinsics, "transform_matrix": matrix}

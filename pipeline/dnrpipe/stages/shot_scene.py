"""What a scene file says of a shot, asked of a worker."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..blender.tasks import ShotTask
from ..core.shot_records import ShotFacts
from .inspect_scene import require_file
from .prepare import open_scene


def look_at_shot(scene: Path, frames: Sequence[int] | None, camera: str | None, log: Path) -> ShotFacts:
    """Ask the scene file for the cameras of a shot's frames; `core.cameras.shot_views` makes views of them.

    Args:
        frames: rising, of any number; None for the file's own range.
        camera: name of one; None for the active one, which markers of the file may switch.
        log: of the worker.

    Raises UserError: unusable input; no such camera, or one that cannot see or is not a perspective one.
    """
    require_file(scene)
    task = ShotTask(source=scene.resolve(), frames=None if frames is None else tuple(frames), camera=camera)
    return open_scene("dnrpipe.blender.shot", task, ShotFacts, log)[0]

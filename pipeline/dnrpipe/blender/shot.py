"""Worker that says what the frames of a shot see."""

from __future__ import annotations

from typing import Any

import bpy

from dnrpipe.core.cameras import require_perspective
from dnrpipe.core.errors import UserError
from dnrpipe.core.shot_records import ShotFacts

from .cameras import cameras_in_place, picture_size, shot_cameras
from .motion.changes import find_changes
from .motion.simulations import is_simulated
from .motion.suspects import settings_with_keys
from .reading.opening import open_scene
from .tasks import ShotTask


class Worker:
    """Looks at one shot per task, a `ShotTask`."""

    def __init__(self, common: dict[str, Any]) -> None:
        del common

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        return look_at_shot(ShotTask.model_validate(task)).data()


def look_at_shot(task: ShotTask) -> ShotFacts:
    """Open the scene file and say what the shot's frames see.

    Raises UserError: unusable input; no such camera, or one that cannot see or is not a perspective one.
    """
    open_scene(task.source)
    scene: Any = bpy.context.scene
    render = scene.render
    frames = task.frames
    if frames is None:
        frames = tuple(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))
    try:
        cameras = shot_cameras(scene, frames, task.camera)
        require_perspective(cameras)
        changes, examined = find_changes(scene, frames)
        if is_simulated(scene):
            cameras = cameras_in_place(scene, cameras)
    except UserError as error:
        raise type(error)(f"{task.source}: {error}") from None
    return ShotFacts(
        cameras=cameras,
        fps=render.fps / render.fps_base,
        frame_start=scene.frame_start,
        frame_end=scene.frame_end,
        resolution=picture_size(scene),
        film_transparent=render.film_transparent,
        converted=scene.frame_current,
        changes=changes,
        examined=examined,
        warnings=_warnings(scene),
    )


def _warnings(scene: Any) -> list[str]:
    keyed = settings_with_keys(scene)
    if not keyed:
        return []
    return [f"settings of the scene with keys stay as at frame {scene.frame_current}: {', '.join(keyed)}"]

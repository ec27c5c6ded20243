"""Cameras of the scene file and their animation, for summary.json."""

from __future__ import annotations

import math
from typing import Any

import bpy

from .camera import describe

MAX_FRAMES = 500


def scene_cameras(scene: bpy.types.Scene) -> list[dict[str, Any]]:
    """Every camera object of the scene at its current frame (see :func:`camera.describe`)."""
    return [
        {"name": obj.name, "active": obj == scene.camera, **describe(obj)}
        for obj in scene.objects
        if obj.type == "CAMERA"
    ]


def camera_animation(scene: bpy.types.Scene, max_frames: int = MAX_FRAMES) -> list[dict[str, Any]]:
    """The active camera over the frame range, at most ``max_frames`` frames; [] when it does not move.

    Camera markers are followed. The scene is left at the frame it was at.
    """
    if not _may_move(scene):
        return []
    before, subframe = scene.frame_current, scene.frame_subframe
    step = max(1, math.ceil((scene.frame_end - scene.frame_start + 1) / max_frames))
    frames = []
    try:
        for frame in range(scene.frame_start, scene.frame_end + 1, step):
            scene.frame_set(frame)
            if scene.camera is not None:
                frames.append({"frame": frame, "name": scene.camera.name, **describe(scene.camera)})
    finally:
        scene.frame_set(before, subframe=subframe)
    moves = any({**f, "frame": 0} != {**frames[0], "frame": 0} for f in frames)
    return frames if moves else []


def _may_move(scene: bpy.types.Scene) -> bool:
    """Whether the camera, or anything it hangs on, is animated (cheap: evaluates no frame)."""
    if any(marker.camera for marker in scene.timeline_markers):
        return True
    todo = [scene.camera]
    seen: set[bpy.types.Object] = set()
    while todo:
        obj = todo.pop()
        if obj is None or obj in seen:
            continue
        seen.add(obj)
        if obj.animation_data or (obj.data and obj.data.animation_data) or obj.rigid_body:
            return True
        todo.append(obj.parent)
        todo += [getattr(constraint, "target", None) for constraint in obj.constraints]
    return False

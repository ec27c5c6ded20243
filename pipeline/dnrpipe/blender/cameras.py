"""Cameras of the scene file and their animation."""

from __future__ import annotations

import math
from typing import Any

import bpy

from dnrpipe.core.scene_records import SceneCamera

from .passes.camera import describe
from .reading.framing import usable

MAX_FRAMES = 500


def scene_cameras(scene: bpy.types.Scene) -> list[SceneCamera]:
    """Every camera of the scene that can see, at the current frame."""
    return [describe(obj).model_copy(update={"active": obj == scene.camera}) for obj in scene.objects if usable(obj)]


def camera_animation(scene: bpy.types.Scene, max_frames: int = MAX_FRAMES) -> list[SceneCamera]:
    """The active camera over the frame range, at most ``max_frames`` frames; [] when it does not move.

    Follows camera markers. Evaluates frames in a scene that holds the cameras alone, with what they depend on: a
    heavy scene would take minutes. Rigid-body cameras need their whole scene and stay where they are.
    """
    if not _may_move(scene):
        return []
    step = max(1, math.ceil((scene.frame_end - scene.frame_start + 1) / max_frames))
    helper: Any = bpy.data.scenes.new("dnrpipe.cameras")
    try:
        for name in ("frame_map_old", "frame_map_new"):
            setattr(helper.render, name, getattr(scene.render, name))
        for bound in {scene.camera, *(marker.camera for marker in scene.timeline_markers)} - {None}:
            helper.collection.objects.link(bound)
        frames = []
        for frame in range(scene.frame_start, scene.frame_end + 1, step):
            camera: Any = _camera_at(scene, frame)
            helper.frame_set(frame)
            evaluated = None if camera is None else camera.evaluated_get(helper.view_layers[0].depsgraph)
            if evaluated is not None and usable(evaluated):
                frames.append(describe(evaluated).model_copy(update={"frame": frame}))
    finally:
        bpy.data.scenes.remove(helper)
    seen = [camera.model_copy(update={"frame": 0, "name": ""}) for camera in frames]
    return frames if any(camera != seen[0] for camera in seen) else []


def _camera_at(scene: bpy.types.Scene, frame: int) -> Any:
    """The active camera at a frame: of the last marker that binds one, of the first before that, or the scene's."""
    bound = [marker for marker in scene.timeline_markers if marker.camera and not marker.camera.hide_render]
    if not bound:
        return scene.camera
    bound.sort(key=lambda marker: marker.frame)
    return next((marker.camera for marker in reversed(bound) if marker.frame <= frame), bound[0].camera)


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
        if obj.animation_data or (obj.data and obj.data.animation_data):
            return True
        todo.append(obj.parent)
        todo += [getattr(constraint, "target", None) for constraint in obj.constraints]
    return False

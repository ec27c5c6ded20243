"""Cameras of the scene file and their animation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import bpy

from dnrpipe.core.scene_records import SceneCamera

from .passes.camera import describe
from .reading.framing import usable

MAX_FRAMES = 500


def scene_cameras(scene: bpy.types.Scene) -> list[SceneCamera]:
    """Every camera of the scene that can see, at the current frame; those hidden in the viewport too."""
    cameras = [obj for obj in scene.objects if obj.type == "CAMERA"]
    if scene.camera is not None and scene.camera not in cameras:
        cameras.append(scene.camera)
    with _alone(scene, cameras) as helper:
        helper.frame_set(scene.frame_current, subframe=scene.frame_subframe)
        evaluated = [(obj, obj.evaluated_get(helper.view_layers[0].depsgraph)) for obj in cameras]
        seeing = [(describe(found, scene.render), obj == scene.camera) for obj, found in evaluated if usable(found)]
    return [camera.model_copy(update={"active": active}) for camera, active in seeing]


@contextmanager
def _alone(scene: bpy.types.Scene, cameras: Sequence[Any]) -> Iterator[Any]:
    """A scene that holds the cameras alone, with what they depend on, and hides none from its viewport.

    Blender evaluates for scripts what the viewport shows: elsewhere a hidden camera stays at the origin.
    """
    helper: Any = bpy.data.scenes.new("dnrpipe.cameras")
    hidden = [camera for camera in cameras if camera.hide_viewport]
    try:
        for name in ("frame_map_old", "frame_map_new", "fps", "fps_base"):
            setattr(helper.render, name, getattr(scene.render, name))
        for camera in cameras:
            helper.collection.objects.link(camera)
        for camera in hidden:
            camera.hide_viewport = False
        yield helper
    finally:
        for camera in hidden:
            camera.hide_viewport = True
        bpy.data.scenes.remove(helper)


def camera_animation(scene: bpy.types.Scene, max_frames: int = MAX_FRAMES) -> list[SceneCamera]:
    """The active camera over the frame range, at most ``max_frames`` frames; [] when it does not move.

    Follows camera markers. Evaluates frames in a scene that holds the cameras alone, with what they depend on: a
    heavy scene would take minutes. Rigid-body cameras need their whole scene and stay where they are.
    """
    if not _may_move(scene):
        return []
    step = max(1, math.ceil((scene.frame_end - scene.frame_start + 1) / max_frames))
    bound = {scene.camera, *(marker.camera for marker in scene.timeline_markers)} - {None}
    with _alone(scene, list(bound)) as helper:
        frames = []
        for frame in range(scene.frame_start, scene.frame_end + 1, step):
            camera: Any = _camera_at(scene, frame)
            helper.frame_set(frame)
            evaluated = None if camera is None else camera.evaluated_get(helper.view_layers[0].depsgraph)
            if evaluated is not None and usable(evaluated):
                frames.append(describe(evaluated, scene.render).model_copy(update={"frame": frame}))
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

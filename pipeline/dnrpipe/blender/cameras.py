"""Cameras of the scene file and their animation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import bpy

from dnrpipe.core.errors import UserError
from dnrpipe.core.scene_records import SceneCamera

from .geometry.render_graph import with_render_graph
from .passes.camera import describe
from .reading.framing import usable

MAX_FRAMES = 500


def scene_cameras(scene: bpy.types.Scene) -> list[SceneCamera]:
    """Every camera of the scene that can see, at the current frame; those hidden in the viewport too."""
    cameras = _cameras(scene)
    with _alone(scene, cameras) as helper:
        helper.frame_set(scene.frame_current, subframe=scene.frame_subframe)
        evaluated = [(obj, obj.evaluated_get(helper.view_layers[0].depsgraph)) for obj in cameras]
        seeing = [(describe(found, scene.render), obj == scene.camera) for obj, found in evaluated if usable(found)]
    return [camera.model_copy(update={"active": active}) for camera, active in seeing]


def _cameras(scene: bpy.types.Scene) -> list[Any]:
    cameras = [obj for obj in scene.objects if obj.type == "CAMERA"]
    if scene.camera is not None and scene.camera not in cameras:
        cameras.append(scene.camera)
    return cameras


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


def camera_animation(scene: bpy.types.Scene) -> list[SceneCamera]:
    """The active camera over the frame range, at most `MAX_FRAMES` frames; [] when it does not move.

    Follows camera markers.
    """
    if not _may_move(scene):
        return []
    step = max(1, math.ceil((scene.frame_end - scene.frame_start + 1) / MAX_FRAMES))
    frames = range(scene.frame_start, scene.frame_end + 1, step)
    found = _over_frames(scene, frames, lambda frame: camera_at(scene, frame))
    seeing = [camera for _, _, camera in found if camera is not None]
    seen = [camera.model_copy(update={"frame": 0, "name": ""}) for camera in seeing]
    return seeing if any(camera != seen[0] for camera in seen) else []


def shot_cameras(scene: bpy.types.Scene, frames: Sequence[int], name: str | None) -> list[SceneCamera]:
    """The camera of each frame, in order: the one of that name, else the one that Blender renders with.

    Raises UserError: no such camera (names those that are there); none at all; one that cannot see.
    """
    chosen: Any = None if name is None else _named(scene, name)
    cameras = []
    for frame, camera, seen in _over_frames(scene, frames, lambda frame: chosen or camera_at(scene, frame)):
        if camera is None:
            choose = "none of them active: choose one with --camera" if _cameras(scene) else "a shot needs one"
            raise UserError(f"{_has(scene)}; {choose}")
        if seen is None:
            raise UserError(f"camera '{camera.name}' cannot see at frame {frame}: its lens or scale is 0 or not finite")
        cameras.append(seen)
    return cameras


def cameras_in_place(scene: bpy.types.Scene, cameras: Sequence[SceneCamera]) -> list[SceneCamera]:
    """The cameras of a shot once more, evaluated with their whole scene: simulations may carry them."""
    found: dict[int | None, SceneCamera] = {}
    active: Any = scene.camera
    for name in dict.fromkeys(camera.name for camera in cameras):
        own: Any = _named(scene, name)
        frames = [camera.frame for camera in cameras if camera.name == name]
        scene.camera = own  # what pictures are taken with is evaluated, wherever it lies
        found |= with_render_graph(
            scene, lambda engine, graph, own=own, frames=frames: _seen(scene, engine, graph, own, frames)
        )
    scene.camera = active
    return [found[camera.frame] for camera in cameras]


def _seen(
    scene: bpy.types.Scene, engine: Any, graph: Any, camera: Any, frames: Sequence[int | None]
) -> dict[int | None, SceneCamera]:
    now, subframe = graph.scene.frame_current, graph.scene.frame_subframe
    found = {}
    for frame in frames:
        engine.frame_set(frame, 0.0)
        found[frame] = describe(camera.evaluated_get(graph), scene.render).model_copy(update={"frame": frame})
    engine.frame_set(now, subframe)
    return found


def _named(scene: bpy.types.Scene, name: str) -> Any:
    found = next((camera for camera in _cameras(scene) if camera.name == name), None)
    if found is None:
        raise UserError(f"no camera '{name}': {_has(scene)}")
    return found


def _has(scene: bpy.types.Scene) -> str:
    names = ", ".join(f"'{camera.name}'" for camera in sorted(_cameras(scene), key=lambda camera: camera.name))
    return f"scene '{scene.name}' has " + (f"the camera(s) {names}" if names else "no camera")


def _over_frames(
    scene: bpy.types.Scene, frames: Iterable[int], choose: Callable[[int], Any]
) -> list[tuple[int, Any, SceneCamera | None]]:
    """(frame, its camera object or None, what that sees or None where it cannot see) of each frame.

    Evaluates frames in a scene that holds the cameras alone, with what they depend on: a heavy scene would take
    minutes. Rigid-body cameras need their whole scene and stay where they are.

    Args:
        choose: frame -> camera object or None.
    """
    chosen = [(frame, choose(frame)) for frame in frames]
    cameras = list(dict.fromkeys(camera for _, camera in chosen if camera is not None))
    edit: Any = bpy.context.preferences.edit
    before, negative = scene.frame_current, edit.use_negative_frames
    edit.use_negative_frames = True
    found: list[tuple[int, Any, SceneCamera | None]] = []
    try:
        with _alone(scene, cameras) as helper:
            for frame, camera in chosen:
                scene.frame_current = frame  # drivers may read it of the scene itself
                helper.frame_set(frame)
                evaluated = None if camera is None else camera.evaluated_get(helper.view_layers[0].depsgraph)
                seen = (
                    describe(evaluated, scene.render).model_copy(update={"frame": frame}) if usable(evaluated) else None
                )
                found.append((frame, camera, seen))
    finally:
        scene.frame_current = before
        edit.use_negative_frames = negative
    return found


def camera_at(scene: bpy.types.Scene, frame: int) -> Any:
    """The camera object that Blender renders a frame with, or None: of the last marker that binds one, of the first
    before that, or the scene's (BKE_scene_camera_switch_find)."""
    bound = [marker for marker in scene.timeline_markers if marker.camera and not marker.camera.hide_render]
    if not bound:
        return scene.camera
    past = [marker for marker in bound if marker.frame <= frame]
    return (max(past, key=_frame) if past else min(bound, key=_frame)).camera


def _frame(marker: Any) -> int:
    return marker.frame


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


def picture_size(scene: bpy.types.Scene) -> tuple[int, int]:
    """Width and height of the file's pictures, its percentage applied; pixels."""
    scale = scene.render.resolution_percentage / 100
    return max(1, round(scene.render.resolution_x * scale)), max(1, round(scene.render.resolution_y * scale))

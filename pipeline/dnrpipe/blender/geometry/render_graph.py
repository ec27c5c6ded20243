"""The scene as a final render evaluates it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import bpy

Result = TypeVar("Result")


class _GraphEngine(bpy.types.RenderEngine):
    """A render engine that draws nothing.

    Blender hands a depsgraph in RENDER mode (hide_render, render levels of modifiers) to render engines
    only; the one that scripts get from ``evaluated_depsgraph_get`` has viewport visibility.
    """

    bl_idname = "DNRPIPE_GRAPH"
    bl_label = "dnrpipe graph"

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        try:
            _outcome.append(_work[-1](self, depsgraph))
        except Exception as error:  # Blender would print and swallow it; with_render_graph raises it again
            _failed.append(error)


_work: list[Callable[[Any, bpy.types.Depsgraph], Any]] = []
_outcome: list[Any] = []
_failed: list[Exception] = []


def render_layer(scene: bpy.types.Scene) -> bpy.types.ViewLayer:
    """The view layer that pictures are made of: the first one that is used for rendering."""
    return next((layer for layer in scene.view_layers if layer.use), scene.view_layers[0])


def with_render_graph(scene: bpy.types.Scene, work: Callable[[Any, bpy.types.Depsgraph], Result]) -> Result:
    """``work(engine, depsgraph)`` on the scene at its current frame with render visibility.

    ``engine.frame_set(frame, subframe)`` brings the depsgraph, and the scene's frame number, to another frame. The
    scene's settings stay as they were.
    """
    render = scene.render
    wanted = {
        "engine": _GraphEngine.bl_idname,
        **dict.fromkeys(("resolution_x", "resolution_y"), 8),
        "resolution_percentage": 100,
        **dict.fromkeys(("use_border", "use_multiview", "use_compositing", "use_sequencer", "use_simplify"), False),
    }
    kept = {name: getattr(render, name) for name in wanted}
    layer = render_layer(scene)
    used, active = layer.use, scene.camera
    camera = None
    if active is None:  # the render operator insists on one
        camera = bpy.data.cameras.new("dnrpipe.freeze")
        scene.camera = bpy.data.objects.new("dnrpipe.freeze", camera)
    bpy.utils.register_class(_GraphEngine)
    _work.append(work)
    try:
        layer.use = True
        for name, value in wanted.items():
            setattr(render, name, value)
        bpy.ops.render.render(scene=scene.name, layer=layer.name)
    finally:
        _work.pop()
        outcome, failed = _outcome[:], _failed[:]
        _outcome.clear()
        _failed.clear()
        for name, value in kept.items():
            setattr(render, name, value)
        layer.use = used
        scene.camera = active  # another frame's marker may have switched it
        if camera is not None:
            bpy.data.cameras.remove(camera)  # takes its object along
        bpy.utils.unregister_class(_GraphEngine)
    if failed:
        raise failed[0]
    if not outcome:
        raise RuntimeError(f"Blender did not evaluate scene '{scene.name}' for rendering")
    return outcome[0]

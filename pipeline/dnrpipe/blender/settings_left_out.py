"""Settings of a scene and its view layer that renders obey and the conversion does not: a finding for each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy

from .geometry.render_graph import render_layer
from .lighting.lights import is_portal

SIMULATED = {"CLOTH", "SOFT_BODY", "FLUID", "DYNAMIC_PAINT", "OCEAN", "PARTICLE_SYSTEM", "MESH_SEQUENCE_CACHE", "BUILD"}
"""Modifiers that change with the frame without keys."""
ENGINES = {"CYCLES", "BLENDER_EEVEE", "BLENDER_EEVEE_NEXT"}
LAYER_SWITCHES = {
    "use_sky": "sky",
    "use_solid": "surfaces",
    "use_strand": "hair",
    "use_volumes": "volumes",
}


def settings_left_out(scene: bpy.types.Scene) -> Iterator[tuple[Any, str, str]]:
    """(kind, feature, note) of findings on what the conversion leaves out of the scene's render settings."""
    render: Any = scene.render
    layer = render_layer(scene)
    if render.pixel_aspect_x != render.pixel_aspect_y:
        aspect = f"{render.pixel_aspect_x:g} : {render.pixel_aspect_y:g}"
        yield "ignored", "pixel aspect", f"{aspect} in views of the scene's own cameras, others have square pixels"
    if render.use_border:
        yield "ignored", "render border", "whole pictures are made"
    if render.use_multiview:
        yield "ignored", "stereo", "pictures of one eye are made"
    if render.use_freestyle and layer.use_freestyle:
        yield "ignored", "freestyle", "no lines are drawn"
    if render.use_simplify:
        yield "ignored", "simplify", "subdivision, hair and volumes are those of a render without it"
    if render.engine not in ENGINES:
        yield "approximated", "render engine", "another than Cycles or EEVEE: converted as Cycles renders the file"
    if render.engine == "CYCLES" and abs(scene.cycles.film_exposure - 1) > 1e-6:
        yield "ignored", "film exposure", f"pictures are not multiplied by {scene.cycles.film_exposure:g}"
    if scene.compositing_node_group is not None and render.use_compositing:
        yield "ignored", "compositor", "pictures are what it receives"
    if scene.sequence_editor is not None and scene.sequence_editor.strips and render.use_sequencer:
        yield "ignored", "sequencer", "pictures are of the scene"
    others = [other.name for other in scene.view_layers if other.use and other != layer]
    if others:
        yield "ignored", "further view layers", f"pictures are of '{layer.name}', without {', '.join(others)}"
    for switch, what in LAYER_SWITCHES.items():
        if not getattr(layer, switch):
            yield "ignored", f"view layer without {what}", "they are rendered all the same"
    for marked in [obj for obj in scene.objects if obj.type == "LIGHT" and not obj.hide_render]:
        if is_portal(marked.data):
            yield "ignored", f"light portal '{marked.name}'", "gives no light of its own, and guides no sampling here"


def moving_objects(scene: bpy.types.Scene) -> list[str]:
    """Objects that move or deform with the frame, by keys, drivers, simulations, or what they hang on."""
    known: dict[Any, bool] = {}
    return sorted(obj.name for obj in scene.objects if obj.type != "EMPTY" and _moves(obj, known))


def _moves(start: Any, known: dict[Any, bool]) -> bool:
    """Without recursion: chains of parents may be long, and constraints run in circles."""
    seen, todo = {start}, [start]
    while todo:
        obj = todo.pop()
        if known.get(obj) or _is_animated(obj):
            known[start] = True
            return True
        targets = [obj.parent, *(getattr(entry, "target", None) for entry in obj.constraints)]
        targets += [getattr(entry, "object", None) for entry in obj.modifiers]
        found = {other for other in targets if isinstance(other, bpy.types.Object)} - seen
        seen |= found
        todo += found
    return False


def _is_animated(obj: Any) -> bool:
    keys = getattr(obj.data, "shape_keys", None)
    for block in (obj, obj.data, keys):
        animation = getattr(block, "animation_data", None)
        if animation is not None and (animation.action or animation.drivers or animation.nla_tracks):
            return True
    return obj.rigid_body is not None or any(modifier.type in SIMULATED for modifier in obj.modifiers)

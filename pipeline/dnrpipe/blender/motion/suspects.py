"""What may change with the frame, by what is animated, driven, simulated or reads the time. Evaluates nothing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import bpy

from ..baking.cache import ANIMATED_IMAGES
from ..geometry.render_graph import render_layer
from ..reading.names import data_collections
from .simulations import SIMULATING, plays

TIMED = {"BUILD", "EXPLODE", "MESH_CACHE", "MESH_SEQUENCE_CACHE", "WAVE"}
"""Modifiers that read the frame."""
LOCAL_MODIFIERS = {
    *("ARRAY", "BEVEL", "CORRECTIVE_SMOOTH", "DECIMATE", "EDGE_SPLIT", "LAPLACIANSMOOTH", "MASK", "MIRROR", "MULTIRES"),
    *(
        "REMESH",
        "SCREW",
        "SKIN",
        "SMOOTH",
        "SOLIDIFY",
        "SUBSURF",
        "TRIANGULATE",
        "WEIGHTED_NORMAL",
        "WELD",
        "WIREFRAME",
    ),
}
"""Modifiers that see nothing but their mesh, unless they name an object."""
TIMED_CONSTRAINTS = {"CAMERA_SOLVER", "FOLLOW_TRACK", "OBJECT_SOLVER", "TRANSFORM_CACHE"}
TIMED_NODES = {"GeometryNodeInputSceneTime", "GeometryNodeBake", "GeometryNodeInputActiveCamera"}
"""The active camera moves, and markers switch it."""
RENDER_SETTINGS = {"view_settings", "render", "cycles", "eevee"}
UNSEEN = {"CAMERA", "ARMATURE", "LATTICE", "SPEAKER", "LIGHT_PROBE"}
"""Types of objects that no picture shows."""


@dataclass(frozen=True)
class Suspects:
    """Full names of what may change with the frame.

    Args:
        objects: of the scene, lamps and what instances others included.
        reshaped: objects of the file that may deform.
        materials: of the file.
        world: whether the scene's world may change.
    """

    objects: frozenset[str]
    reshaped: frozenset[str]
    materials: frozenset[str]
    world: bool

    def __bool__(self) -> bool:
        return bool(self.objects) or self.world


def find_suspects(scene: Any) -> Suspects:
    """What may change, found along the pointers between data-blocks: whoever refers to what changes may change too.

    Too many rather than too few: keys may all have the same value.
    """
    sources = {block for block in _blocks() if _is_animated(block) or reads_time(block)}
    users = bpy.data.user_map()
    changing = _closure(sources, users)
    shaped = _closure({block for block in sources if not isinstance(block, bpy.types.Material)}, users, shapes=True)
    metaballs = {obj for obj in bpy.data.objects if obj.type == "META"}
    if metaballs & shaped:  # all of a family melt into one; no pointer says so
        changing, shaped = changing | _closure(metaballs, users), shaped | _closure(metaballs, users, shapes=True)
    layer = render_layer(scene)
    every = layer.material_override in changing
    shown = [obj for obj in objects_of(scene) if (every or obj in changing) and _may_show(obj)]
    world = layer.world_override or scene.world
    return Suspects(
        objects=frozenset(obj.name_full for obj in shown),
        reshaped=frozenset(obj.name_full for obj in bpy.data.objects if obj in shaped and _may_deform(obj, shaped)),
        materials=frozenset(material.name_full for material in bpy.data.materials if material in changing),
        world=world in changing,
    )


def objects_of(scene: Any) -> list[Any]:
    """Of the scene and of its background sets. What they instance counts by them."""
    behind = [] if scene.background_set is None else objects_of(scene.background_set)
    return [*scene.objects, *behind]


def _may_show(obj: Any) -> bool:
    return obj.type not in UNSEEN and (obj.type != "EMPTY" or obj.instance_type == "COLLECTION")


def _may_deform(obj: Any, shaped: set[Any]) -> bool:
    """Whether the shape in the object's own space may change; else it moves as a whole."""
    if obj.type == "META" or obj.data in shaped or obj.parent_type in {"ARMATURE", "LATTICE"}:
        return True
    keyed = any(path.startswith("modifiers") for path in _animated_paths(obj.animation_data))
    return bool(obj.modifiers) and (keyed or not all(map(_keeps_shape, obj.modifiers)))


def _keeps_shape(modifier: Any) -> bool:
    """Whether a modifier without keys computes the same wherever its object is."""
    kinds = modifier.bl_rna.properties
    refers = any(
        isinstance(getattr(modifier, kind.identifier), bpy.types.ID) for kind in kinds if kind.type == "POINTER"
    )
    return modifier.type in LOCAL_MODIFIERS and not refers


def settings_with_keys(scene: Any) -> list[str]:
    """Settings of renders that are animated, as data paths of the scene."""
    paths = {path for path in _animated_paths(scene.animation_data) if path.split(".")[0] in RENDER_SETTINGS}
    return sorted(paths)


def _animated_paths(animation: Any) -> Iterator[str]:
    """Data paths of keys, drivers and strips."""
    if animation is None:
        return
    strips = [strip for track in animation.nla_tracks for strip in track.strips]
    actions = {animation.action, *(strip.action for strip in strips)} - {None}
    curves = [curve for action in actions for curve in action_curves(action)]
    yield from (curve.data_path for curve in (*curves, *animation.drivers))


def action_curves(action: Any) -> Iterator[Any]:
    """All F-curves of an action, whichever slot they are for."""
    for layer in action.layers:
        for strip in layer.strips:
            for bag in strip.channelbags:
                yield from bag.fcurves


def _blocks() -> Iterator[Any]:
    for collection in data_collections():
        if collection != bpy.data.window_managers:
            yield from collection


def _is_animated(block: Any) -> bool:
    """Keys, drivers or strips on the data-block, or on the node tree inside it."""
    for part in (block, getattr(block, "node_tree", None)):
        animation = getattr(part, "animation_data", None)
        if animation is not None and (animation.action or animation.drivers or animation.nla_tracks):
            return True
    return False


def reads_time(block: Any) -> bool:
    """Whether a data-block changes with the frame without keys."""
    if isinstance(block, bpy.types.Object):
        constraints: list[Any] = list(block.constraints)
        if block.pose is not None:
            constraints += [entry for bone in block.pose.bones for entry in bone.constraints]
        return (
            plays(block)
            or any(modifier.type in TIMED for modifier in block.modifiers)
            or any(entry.type in TIMED_CONSTRAINTS for entry in constraints)
        )
    if isinstance(block, bpy.types.Image):
        return block.source in ANIMATED_IMAGES
    if isinstance(block, bpy.types.NodeTree):
        return any(node.bl_idname in TIMED_NODES | SIMULATING for node in block.nodes)
    return False


def _closure(sources: Iterable[Any], users: dict[Any, set[Any]], *, shapes: bool = False) -> set[Any]:
    """The sources and all that refers to them. shapes: not by way of materials, which change no shape."""
    found, todo = set(sources), list(sources)
    while todo:
        for user in users.get(todo.pop(), ()):
            if user not in found and not (shapes and isinstance(user, bpy.types.Material)):
                found.add(user)
                todo.append(user)
    return found

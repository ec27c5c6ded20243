"""What a frame shows of the suspects, in values that can be compared."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from dnrpipe.core.shot_records import ChangeKind

from ..baking.cache import frame_shown, shows_frames
from ..baking.graph import PER_OBJECT, GraphHasher
from ..findings import Findings
from ..geometry.freeze import surfaces
from ..geometry.local_mesh import LocalMesh
from ..lighting.lights import is_portal
from ..shading.sockets import output_node, resolve, walk
from .suspects import Suspects

TOLERANCE = 4e-6
"""Largest difference, of the largest number of an array, that counts as rounding: a few steps of float32."""
SURFACES = {"MESH", "CURVES", "POINTCLOUD"}
"""Types of instances that have one. Curves, text and metaballs come as meshes too."""
Key = tuple[str, str, tuple[int, ...]]
"""Who shows it (an object, or what instances it), the object whose surface it is, and the number of the instance."""


State = dict[Key, dict[ChangeKind, tuple[Any, ...]]]
"""A frame: of each surface, lamp and world its values, by the kind of change that another value is."""


class StateReader:
    """Reads the states of frames; images are read once for all."""

    def __init__(self, suspects: Suspects) -> None:
        self.suspects = suspects
        self._graphs = GraphHasher()

    def read(self, depsgraph: Any) -> State:
        """The state of the frame at which a depsgraph of a render is."""
        state: State = {}
        meshes: dict[tuple[object, ...], tuple[Any, Any] | None] = {}
        materials: dict[str, tuple[str, bool]] = {}
        frame = depsgraph.scene_eval.frame_current
        override = depsgraph.view_layer_eval.material_override
        for instance in depsgraph.object_instances:
            obj = instance.object
            holder = obj if instance.parent is None else instance.parent
            if not {holder.name_full, obj.name_full} & self.suspects.objects:
                continue
            persistent = tuple(instance.persistent_id) if instance.is_instance else ()
            key = (holder.name_full, obj.name_full, persistent)
            values: dict[ChangeKind, tuple[Any, ...]] = {"moves": _place(instance.matrix_world)}
            if obj.type == "LIGHT":
                if is_portal(obj.data):
                    continue
                values["light changes"] = (self._lamp(obj.data, frame),)
            elif obj.type in SURFACES and (instance.show_self or instance.show_particles):
                shapes = list(self._shapes(instance, obj, holder, meshes))
                values["deforms"] = tuple(shape for shape, _ in shapes)
                used = [override] if override else [slot.material for slot in obj.material_slots if slot.material]
                looks = tuple(self._material(material, obj, materials, frame) for material in used)
                values["changes its material"] = (*looks, *(look for _, look in shapes))
                values["appears or disappears"] = (obj.visible_camera and holder.visible_camera,)
            else:
                continue
            state[key] = values
        if self.suspects.world:
            world = depsgraph.view_layer_eval.world_override or depsgraph.scene_eval.world
            look = self._tree(world.node_tree, frame) if world.node_tree else tuple(world.color)
            state[world.name_full, world.name_full, ()] = {"world changes": (look,)}
        return state

    def _shapes(
        self, instance: Any, obj: Any, holder: Any, known: dict[tuple[object, ...], tuple[Any, Any] | None]
    ) -> Iterator[tuple[Any, Any]]:
        """(shape, look) of each surface that an instance shows, where it may deform."""
        if not {obj.name_full, holder.name_full} & self.suspects.reshaped:
            return
        for key, read in surfaces(obj, instance.show_self, instance.show_particles, Findings()):
            if key not in known:
                local = read()
                known[key] = None if local is None or not len(local.material_index) else _parts(local)
            if (parts := known[key]) is not None:
                yield parts

    def _material(self, material: Any, obj: Any, known: dict[str, tuple[str, bool]], frame: int) -> Any:
        """The look of a material on an object; its name alone where it may not change."""
        name, tree = material.name_full, material.node_tree
        if name not in known:
            plain = repr(tuple(material.diffuse_color))
            look = name if name not in self.suspects.materials else self._tree(tree, frame) if tree else plain
            known[name] = look, any(node.type in PER_OBJECT for node in walk(tree))
        look, by_object = known[name]
        return (look, tuple(obj.color), obj.pass_index) if by_object else look

    def _lamp(self, lamp: Any, frame: int) -> str:
        return repr(list(self._graphs.properties(lamp, {"animation_data"}))) + self._tree(lamp.node_tree, frame)

    def _tree(self, tree: Any, frame: int) -> str:
        """What the tree's output computes, and the pictures of its animated images at the frame."""
        output, scope = output_node(tree)
        sources = [resolve(socket, scope) for socket in output.inputs] if output is not None else []
        values = [self._graphs.hash(source) if source.linked else None for source in sources]
        animated = [node.image_user for node in walk(tree) if shows_frames(node)]
        return repr([*values, *(frame_shown(user, frame) for user in animated)])


def shows_anything(depsgraph: Any) -> bool:
    """Whether the frame shows any surface, of suspects or not."""
    shown = (entry.object for entry in depsgraph.object_instances if entry.show_self or entry.show_particles)
    return any(obj.type in SURFACES and bool(getattr(obj.data, "polygons", True)) for obj in shown)


def _place(matrix: Any) -> tuple[np.ndarray, np.ndarray]:
    """A matrix so that `same` measures turns and scale by the scale, and the place by scale and distance."""
    whole = np.array(matrix, np.float64)
    linear = whole[:3, :3]
    return linear, np.array([*whole[:3, 3], np.abs(linear).max()])


def _parts(mesh: LocalMesh) -> tuple[Any, Any]:
    """(shape, look) of a mesh."""
    layers = [*mesh.uv_layers.values(), *mesh.colors.values()]
    return (mesh.positions, mesh.normals), (mesh.material_index, *layers, *mesh.materials)


def same(a: Any, b: Any, known: dict[tuple[int, int], bool]) -> bool:
    """Whether two values are equal but for rounding. known: tuples that were compared, by their ids."""
    if isinstance(a, tuple) and isinstance(b, tuple):
        pair = id(a), id(b)
        if pair not in known:
            known[pair] = len(a) == len(b) and all(same(x, y, known) for x, y in zip(a, b, strict=True))
        return known[pair]
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        if a.shape != b.shape:
            return False
        if np.array_equal(a, b, equal_nan=True):
            return True
        with np.errstate(invalid="ignore"):
            return bool(np.abs(a.astype(np.float64) - b).max() <= TOLERANCE * np.abs(a).max())
    return a == b

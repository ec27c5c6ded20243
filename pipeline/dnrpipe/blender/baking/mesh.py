"""Frozen meshes as Blender objects to bake: atlas, the artist's UVs, colours, and what nodes read from the object."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import bpy
import mathutils
import numpy as np

from ..geometry.frozen import ATLAS_LAYER, FrozenMesh
from ..geometry.local_mesh import new_mesh
from ..reading.names import find_material
from ..shading.sockets import walk
from .trees import (
    ACTIVE_COLOUR,
    ACTIVE_UV,
    GENERATED,
    LOCATION,
    OBJECT,
    OBJECT_COLOUR,
    OBJECT_NORMAL,
    OBJECT_NUMBERS,
    attribute_names,
    baked_name,
    colour_name,
)

MAX_OWN = 24
"""Objects that a material is baked on one by one; on more, object space is taken for world space."""


def needs_own_space(mesh: FrozenMesh, materials: Iterable[str]) -> bool:
    """Whether one of these materials, on this mesh, converts to or from object space, and the mesh has one."""
    if abs(np.linalg.det(mesh.object_to_world[:3, :3])) < 1e-30:
        return False
    found = [find_material(name) for name in {name for name in mesh.materials if name} & set(materials)]
    return any(is_object_space(node) for material in found if material for node in walk(material.node_tree))


def is_object_space(node: Any) -> bool:
    """Whether the node needs the object's own axes, which world-space triangles do not have."""
    if node.type == "VECT_TRANSFORM":
        return "OBJECT" in {node.convert_from, node.convert_to}
    if node.type == "NORMAL_MAP":
        return node.space in {"OBJECT", "BLENDER_OBJECT"}
    if node.type == "TEX_IMAGE":
        return node.projection == "BOX"  # weighs its three sides by the normal in object space
    if node.type == "TANGENT":
        return node.direction_type == "RADIAL"
    return node.type == "NEW_GEOMETRY" and node.outputs["Tangent"].is_linked


def add_object(
    scene: bpy.types.Scene,
    meshes: Sequence[FrozenMesh],
    materials: Mapping[str, Any],
    dark: Any,
    *,
    local: bool,
    selected: bool = True,
) -> bpy.types.Object:
    """Join ``meshes`` into one object of ``scene``.

    materials: Blender material by original name; all others get ``dark``. local: keep the first mesh's own
    space (its matrix becomes the object's) instead of world space.
    """
    matrix = meshes[0].object_to_world if local else np.eye(4)
    into = np.linalg.inv(matrix)
    positions = np.concatenate([mesh.positions.astype(np.float64) for mesh in meshes]) @ into[:3, :3].T + into[:3, 3]
    normals = _object_normals(np.concatenate([mesh.normals for mesh in meshes]), matrix)
    order = np.arange(len(positions))
    if np.linalg.det(matrix[:3, :3]) < 0:  # Blender turns the winding of mirrored objects again
        order = order.reshape(-1, 3)[:, [0, 2, 1]].ravel()
    corners = np.arange(len(order), dtype=np.int32).reshape(-1, 3)
    data = new_mesh("dnrpipe.bake", positions[order].astype(np.float32), corners)
    _attribute(data, "custom_normal", "FLOAT_VECTOR", normals[order], domain="POINT")
    for material in (*materials.values(), dark):
        data.materials.append(material)
    index = {name: i for i, name in enumerate(materials)}
    data.polygons.foreach_set("material_index", np.concatenate([_slots(mesh, index) for mesh in meshes]))
    names = set[str]().union(*(attribute_names(material) for material in materials.values()))
    _uv_layers(data, meshes, names, order)
    _colours(data, meshes, names, order)
    _object_attributes(data, meshes, order)
    data.update()
    obj = bpy.data.objects.new("dnrpipe.bake", data)
    obj.matrix_world = mathutils.Matrix(matrix.tolist())
    scene.collection.objects.link(obj)
    layer = scene.view_layers[0]
    layer.update()
    obj.select_set(selected, view_layer=layer)
    if selected:
        layer.objects.active = obj
    return obj


def _slots(mesh: FrozenMesh, index: Mapping[str, int]) -> np.ndarray:
    table = np.array([index.get(name, len(index)) if name else len(index) for name in mesh.materials], np.int32)
    return table[mesh.material_index]


def _uv_layers(data: bpy.types.Mesh, meshes: Sequence[FrozenMesh], names: set[str], order: np.ndarray) -> None:
    """The atlas; every mesh's own render layer as one; and the layers that nodes name."""
    wanted = {ATLAS_LAYER: [mesh.atlas for mesh in meshes]}
    wanted[ACTIVE_UV] = [_layer(mesh, mesh.uv_layers, mesh.active_uv, 2) for mesh in meshes]
    for name in sorted({name for mesh in meshes for name in mesh.uv_layers if baked_name(name) in names}):
        wanted[baked_name(name)] = [_layer(mesh, mesh.uv_layers, name, 2) for mesh in meshes]
    for name, parts in wanted.items():
        _attribute(data, name, "FLOAT2", np.concatenate(parts)[order])
    data.uv_layers[ATLAS_LAYER].active = True
    data.uv_layers[ACTIVE_UV].active_render = True


def _layer(mesh: FrozenMesh, layers: Mapping[str, np.ndarray], name: str | None, width: int) -> np.ndarray:
    """A layer of the mesh, [3T, width]; zeros where it has none of the name."""
    found = layers.get(name or "")
    return np.zeros((len(mesh.positions), width), np.float32) if found is None else found


def _colours(data: bpy.types.Mesh, meshes: Sequence[FrozenMesh], names: set[str], order: np.ndarray) -> None:
    wanted = {}
    for name in sorted({name for mesh in meshes for name in mesh.colors} - {ACTIVE_COLOUR}):
        for alias in {baked_name(name), colour_name(name)} & names:
            wanted[alias] = [_layer(mesh, mesh.colors, name, 4) for mesh in meshes]
    if any(mesh.active_color for mesh in meshes):
        wanted[ACTIVE_COLOUR] = [_layer(mesh, mesh.colors, mesh.active_color, 4) for mesh in meshes]
    for name, parts in wanted.items():
        _attribute(data, name, "FLOAT_COLOR", np.concatenate(parts)[order])


def _object_attributes(data: bpy.types.Mesh, meshes: Sequence[FrozenMesh], order: np.ndarray) -> None:
    """Object and generated coordinates, object normal, and Object Info, per corner."""
    inside = [object_positions(mesh) for mesh in meshes]
    generated = [generated_positions(mesh) for mesh in meshes]
    normals = [_object_normals(mesh.normals, mesh.object_to_world) for mesh in meshes]
    for name, parts in ((OBJECT, inside), (GENERATED, generated), (OBJECT_NORMAL, normals)):
        _attribute(data, name, "FLOAT_VECTOR", np.concatenate(parts)[order])
    rows = [object_info(mesh) for mesh in meshes]
    counts = [len(mesh.positions) for mesh in meshes]
    kinds = {LOCATION: "FLOAT_VECTOR", OBJECT_COLOUR: "FLOAT_COLOR", OBJECT_NUMBERS: "FLOAT_VECTOR"}
    for column, (name, kind) in enumerate(kinds.items()):
        _attribute(data, name, kind, np.repeat(np.array([row[column] for row in rows]), counts, axis=0)[order])


def _object_normals(normals: np.ndarray, object_to_world: np.ndarray) -> np.ndarray:
    """World-space normals [N, 3] as unit ones in the object's space, float64."""
    turned = normals.astype(np.float64) @ object_to_world[:3, :3]
    return turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)


def object_positions(mesh: FrozenMesh) -> np.ndarray:
    """Positions [3T, 3] in the object's own space, float64, rounded to 2^-20 of the mesh's extent.

    Walls often lie at round coordinates, where a checker or a step decides by the last bit; going to world space
    and back in single precision would turn such a wall into noise.
    """
    points = _unrounded(mesh)
    extent = float(np.abs(points).max(initial=0.0))
    if not 0 < extent < np.inf:
        return points
    step = 2.0 ** (np.ceil(np.log2(extent)) - 20)
    return np.round(points / step) * step


def generated_positions(mesh: FrozenMesh) -> np.ndarray:
    """Generated coordinates [3T, 3]: 0 to 1 over the texture space; rounded to 2^-18, so that its ends are exact."""
    location, size = (np.asarray(part, np.float64) for part in mesh.texture_space)
    generated = (_unrounded(mesh) - location) / np.where(size == 0, 1, 2 * size) + 0.5
    return np.round(generated * 2**18) / 2**18


def _unrounded(mesh: FrozenMesh) -> np.ndarray:
    inverse = np.linalg.pinv(mesh.object_to_world)
    return mesh.positions.astype(np.float64) @ inverse[:3, :3].T + inverse[:3, 3]


def object_info(mesh: FrozenMesh) -> tuple[list[float], list[float], list[float]]:
    """Location, colour, and (index, random, 0), as the Object Info node gives them."""
    obj = bpy.data.objects.get(mesh.object_name)
    colour = [1.0, 1.0, 1.0, 1.0] if obj is None else [float(v) for v in obj.color]
    index = 0.0 if obj is None else float(obj.pass_index)
    location = [float(v) for v in mesh.object_to_world[:3, 3]]
    return location, colour, [index, object_random(mesh.object_name), 0.0]


def object_random(name: str) -> float:
    """Object Info's Random of an object that is no instance: Blender hashes its name (BLI_hash_int_2d)."""
    mask = 0xFFFFFFFF
    key = 0
    for byte in name.encode():
        key = (key * 37 + byte) & mask

    state = dict.fromkeys("abc", (0xDEADBEEF + (2 << 2) + 13) & mask)
    state["a"] = (state["a"] + key) & mask
    for (target, other), by in (("cb", 14), ("ac", 11), ("ba", 25), ("cb", 16), ("ac", 4), ("ba", 14), ("cb", 24)):
        turned = (state[other] << by | state[other] >> (32 - by)) & mask
        state[target] = ((state[target] ^ state[other]) - turned) & mask
    return state["c"] / mask


def _attribute(data: bpy.types.Mesh, name: str, kind: str, values: np.ndarray, domain: str = "CORNER") -> None:
    attribute = data.attributes.new(name, kind, domain)
    field = "color" if kind == "FLOAT_COLOR" else "vector"
    attribute.data.foreach_set(field, np.ascontiguousarray(values, np.float32).ravel())

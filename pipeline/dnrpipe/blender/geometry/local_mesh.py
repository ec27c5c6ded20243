"""One evaluated mesh in object space, as unindexed triangles with everything that renders use of it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field

import bpy
import numpy as np

from ..baking.trees import attribute_names
from .frozen import UNIT_TEXTURE_SPACE, TextureSpace

FIELDS = {
    "FLOAT": ("value", 1),
    "INT": ("value", 1),
    "BOOLEAN": ("value", 1),
    "FLOAT_VECTOR": ("vector", 3),
    "FLOAT2": ("vector", 2),
    "FLOAT_COLOR": ("color", 4),
    "BYTE_COLOR": ("color", 4),
}
"""Type of attribute -> (its property, numbers per element)."""
UV_STEPS = 2**20  # artist's UVs are rounded to multiples of 1 / UV_STEPS


@dataclass
class LocalMesh:
    """Unindexed triangles in object space; arrays as in `frozen.FrozenMesh`."""

    positions: np.ndarray
    normals: np.ndarray
    material_index: np.ndarray
    materials: list[str | None]
    uv_layers: dict[str, np.ndarray] = field(default_factory=dict)
    active_uv: str | None = None
    colors: dict[str, np.ndarray] = field(default_factory=dict)
    active_color: str | None = None
    texture_space: TextureSpace = UNIT_TEXTURE_SPACE
    strands: bool = False

    def tilt(self) -> float:
        """Mean angle between a corner's normal and its triangle's, by area, in radians; 0 for flat shading."""
        corners = self.positions.reshape(-1, 3, 3).astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            cosine = np.einsum("tcd,td->tc", self.normals.reshape(-1, 3, 3), cross / area[:, None])
        angle = np.arccos(np.clip(cosine, -1, 1)).mean(axis=1)
        fine = np.isfinite(angle) & np.isfinite(area)
        return float(np.average(angle[fine], weights=area[fine])) if area[fine].sum() > 0 else 0.0

    def digest(self) -> bytes:
        """Hash of all content: equal for meshes that evaluate to the same geometry with the same materials."""
        state = hashlib.blake2b(digest_size=16)
        layers = (*self.uv_layers.values(), *self.colors.values())
        for array in (self.positions, self.normals, self.material_index, *layers):
            state.update(np.ascontiguousarray(array).data)
        names = (self.materials, list(self.uv_layers), self.active_uv, list(self.colors), self.active_color)
        state.update(repr((names, self.texture_space)).encode())
        return state.digest()


def read_local(obj: bpy.types.Object) -> LocalMesh | None:
    """The mesh of an evaluated object; None for a metaball that is drawn with another one of its family."""
    mesh = obj.to_mesh()
    if mesh is None:
        return None
    try:
        mesh.calc_loop_triangles()
        count = len(mesh.loop_triangles)
        loops = np.empty(3 * count, np.int32)
        polygons = np.empty(count, np.int32)
        mesh.loop_triangles.foreach_get("loops", loops)
        mesh.loop_triangles.foreach_get("polygon_index", polygons)
        corner_vertex = np.empty(len(mesh.loops), np.int32)
        mesh.loops.foreach_get("vertex_index", corner_vertex)
        vertices = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.vertices.foreach_get("co", vertices.ravel())
        normals = np.empty((len(mesh.loops), 3), np.float32)
        mesh.corner_normals.foreach_get("vector", normals.ravel())
        slot = np.empty(len(mesh.polygons), np.int32)
        mesh.polygons.foreach_get("material_index", slot)
        uv_layers = {}
        active = None
        for layer in mesh.uv_layers:
            uv = np.empty((len(mesh.loops), 2), np.float32)
            layer.uv.foreach_get("vector", uv.ravel())
            # Modifiers give the last bits of interpolated UVs either way from run to run: a texel's 1/256 at 4096².
            uv_layers[layer.name] = (np.round(uv * UV_STEPS) / np.float32(UV_STEPS))[loops]
            if layer.active_render:
                active = layer.name
        materials = slot_names(obj)
        places = {"POINT": corner_vertex[loops], "CORNER": loops, "FACE": np.repeat(polygons, 3)}
        colors = _colors(mesh, places)
        known = set(uv_layers) | set(colors)
        return LocalMesh(
            positions=vertices[places["POINT"]],
            normals=normals[loops],
            # Renderers use the last slot for indices beyond it.
            material_index=np.clip(slot[polygons], 0, len(materials) - 1),
            materials=materials,
            uv_layers=uv_layers,
            active_uv=active,
            colors=colors | _named_attributes(obj, mesh, known, places),
            active_color=mesh.attributes.default_color_name or None,
            texture_space=(_triple(mesh.texspace_location), _triple(mesh.texspace_size)),
        )
    finally:
        obj.to_mesh_clear()


def new_mesh(name: str, vertices: np.ndarray, faces: np.ndarray) -> bpy.types.Mesh:
    """A Blender mesh of triangles. vertices: float32 [V, 3]; faces: int32 [T, 3]."""
    data = bpy.data.meshes.new(name)
    data.vertices.add(len(vertices))
    data.loops.add(faces.size)
    data.polygons.add(len(faces))
    data.vertices.foreach_set("co", np.ascontiguousarray(vertices).ravel())
    data.loops.foreach_set("vertex_index", np.ascontiguousarray(faces).ravel())
    data.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    data.update(calc_edges=True)
    return data


def slot_names(obj: bpy.types.Object) -> list[str | None]:
    """Material names by slot, never empty; None is an empty slot."""
    return [slot.material.name_full if slot.material else None for slot in obj.material_slots] or [None]


def _colors(mesh: bpy.types.Mesh, places: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Colour attributes per triangle corner, float32 [3T, 4], linear: Blender decodes byte colours itself."""
    result = {}
    for attribute in mesh.color_attributes:
        if attribute.domain not in {"POINT", "CORNER"}:
            continue  # Blender itself shows no others as colours
        values = np.empty((len(attribute.data), 4), np.float32)
        attribute.data.foreach_get("color", values.ravel())
        result[attribute.name] = values[places[attribute.domain]]
    return result


def _named_attributes(
    obj: bpy.types.Object, mesh: bpy.types.Mesh, known: set[str], places: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Attributes other than UV layers and colours that the object's materials name, float32 [3T, 4].

    A number fills all three channels, as Cycles shows it as a colour; alpha is 1 unless the attribute has one.
    known: names that are read elsewhere. places: by domain, the element at each corner of the triangles, int [3T].
    """
    wanted = set[str]()
    for slot in obj.material_slots:
        if slot.material is not None:
            wanted |= attribute_names(slot.material)
    result = {}
    for name in sorted(wanted - known):
        attribute = mesh.attributes.get(name)
        if attribute is None or attribute.domain not in places or attribute.data_type not in FIELDS:
            continue
        if attribute.is_required or attribute.is_internal:
            continue  # Blender's own, such as the positions themselves
        field, width = FIELDS[attribute.data_type]
        kind = {"INT": np.int32, "BOOLEAN": bool}.get(attribute.data_type, np.float32)
        values = np.empty(len(attribute.data) * width, kind)
        attribute.data.foreach_get(field, values)
        rows = values.reshape(-1, width).astype(np.float32)
        full = np.zeros((len(rows), 4), np.float32)
        full[:, 3] = 1
        full[:, : 3 if width == 1 else width] = rows  # a single number is broadcast
        result[name] = full[places[attribute.domain]]
    return result


def _triple(vector: bpy.types.bpy_prop_array) -> tuple[float, float, float]:
    x, y, z = vector
    return float(x), float(y), float(z)

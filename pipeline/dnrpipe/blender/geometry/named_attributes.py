"""Mesh attributes that materials ask for by name (geometry nodes make such), as values per triangle corner."""

from __future__ import annotations

import bpy
import numpy as np

from ..baking.trees import attribute_names

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


def named_attributes(
    obj: bpy.types.Object,
    mesh: bpy.types.Mesh,
    known: set[str],
    corner_vertex: np.ndarray,
    loops: np.ndarray,
    polygons: np.ndarray,
) -> dict[str, np.ndarray]:
    """Attributes other than UV layers and colours that the object's materials name, float32 [3T, 4].

    A number fills all three channels, as Cycles shows it as a colour; alpha is 1 unless the attribute has one.

    Args:
        known: names that are read elsewhere.
        corner_vertex: vertex of every corner of the mesh. loops, polygons: corner [3T] and polygon [T] of the
            triangles.
    """
    wanted = set[str]()
    for slot in obj.material_slots:
        if slot.material is not None:
            wanted |= attribute_names(slot.material)
    places = {"POINT": corner_vertex[loops], "CORNER": loops, "FACE": np.repeat(polygons, 3)}
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

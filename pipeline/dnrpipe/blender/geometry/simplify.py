"""Heavy geometry with thousands of instances: simplified until all of it fits the ray tracer.

Mitsuba's llvm and cuda variants cannot hold thousands of instances (see `shapes`), so copies are written out
as triangles, up to a budget. The simpler mesh is used everywhere: G-buffers and ray tracing agree.
"""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from ..bundle.ply import weld
from ..findings import Findings
from ..reading.names import find_material
from .frozen import FrozenMesh
from .local_mesh import new_mesh, read_local
from .world import to_world

WRITTEN_TRIANGLES = 6_000_000
"""Triangles of all copies together: about 270 bytes and 3 microseconds of loading each in the ray tracer."""
MITSUBA_INSTANCES = 100
"""Up to here a heavy mesh stays exact, as Mitsuba instances (0.25 s a picture for a hundred)."""
FEWEST = 32  # triangles of a simplified mesh
FLAT = 0.9999  # cosine between corner and face normal above which a mesh counts as flat-shaded


def fit_instances(
    meshes: Sequence[FrozenMesh], repairs: dict[str, int], findings: Findings, *, budget: int = WRITTEN_TRIANGLES
) -> None:
    """Simplify, in place, the meshes whose copies exceed the budget, and thin out copies where that is not enough."""
    crowds = [mesh for mesh in meshes if len(mesh.copies) >= MITSUBA_INSTANCES]
    total = sum(mesh.triangles * len(mesh.copies) for mesh in crowds)
    if total <= budget:
        return
    # Water-filling: light meshes keep what they have, the heavy ones share the rest alike.
    left = budget
    crowds.sort(key=lambda mesh: mesh.triangles * len(mesh.copies))
    for position, mesh in enumerate(crowds):
        share = left // (len(crowds) - position)
        before, placed = mesh.triangles, len(mesh.copies) + 1
        if before * len(mesh.copies) > share:
            wanted = max(share // len(mesh.copies), FEWEST)
            if wanted < before:
                _simplify(mesh, wanted / before, repairs)
            kept = max(share // mesh.triangles, 1)
            if kept < len(mesh.copies):
                mesh.copies = mesh.copies[np.linspace(0, len(mesh.copies) - 1, kept).round().astype(int)]
            dropped = placed - 1 - len(mesh.copies)
            lost = f", and {dropped:,} instances left out" if dropped else ""
            findings.add(
                "approximated",
                "heavy instances",
                f"{placed:,} instances of {before:,} triangles are too much for the ray tracer: simplified to"
                f" {mesh.triangles:,}{lost}",
                object=mesh.object_name,
            )
        left -= mesh.triangles * len(mesh.copies)


def _simplify(mesh: FrozenMesh, ratio: float, repairs: dict[str, int]) -> None:
    """Collapse edges (Blender's Decimate modifier) to ``ratio`` of the triangles; UVs, colours, materials stay."""
    data = _connected(mesh)
    obj = bpy.data.objects.new("dnrpipe.simplify", data)
    scene = bpy.data.scenes.new("dnrpipe.simplify")
    try:
        scene.collection.objects.link(obj)
        obj.modifiers.new("decimate", "DECIMATE").ratio = ratio
        layer = scene.view_layers[0]
        layer.update()
        local = read_local(obj.evaluated_get(layer.depsgraph))
    finally:
        bpy.data.scenes.remove(scene)
        bpy.data.batch_remove([obj, data])
    if local is None or not len(local.material_index):
        return
    simple = to_world(mesh.name, np.eye(4), local, repairs)
    if simple.triangles:
        for name in ("positions", "normals", "material_index", "uv_layers", "colors", "atlas"):
            setattr(mesh, name, getattr(simple, name))


def _connected(mesh: FrozenMesh) -> bpy.types.Mesh:
    welded = weld(mesh.positions, np.zeros_like(mesh.positions), None)
    data = new_mesh("dnrpipe.simplify", welded.vertices[:, :3], welded.faces)
    for name in mesh.materials:
        data.materials.append(None if name is None else find_material(name))
    data.polygons.foreach_set("material_index", mesh.material_index)
    corners = mesh.positions.reshape(-1, 3, 3).astype(np.float64)
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-30)
    smooth = (np.einsum("tkc,tc->tk", mesh.normals.reshape(-1, 3, 3), face) < FLAT).any(1)
    data.polygons.foreach_set("use_smooth", smooth)
    data.update()
    for name, uv in mesh.uv_layers.items():
        data.uv_layers.new(name=name).uv.foreach_set("vector", uv.ravel())
    for name, color in mesh.colors.items():
        data.color_attributes.new(name, "FLOAT_COLOR", "CORNER").data.foreach_set("color", color.ravel())
    return data

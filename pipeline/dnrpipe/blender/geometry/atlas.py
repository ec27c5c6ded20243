"""One UV atlas for the whole frozen scene: every surface of every instance has a place of its own."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import bpy
import numpy as np

from dnrpipe.core.scene_records import AtlasFacts

from ..baking.regions import doubled_areas, texels_near
from .charts import chart_atlas, count_pieces
from .frozen import ATLAS_LAYER, FrozenMesh
from .local_mesh import new_mesh

SMART_LIMIT = 200_000  # triangles; beyond it island packing takes minutes
SMART_MESHES = 400
SMART_PIECES = 1_000  # unconnected parts: every strand of hair is one
DENSITY_POWER = -1 / 8
"""Texels per unit go with area^(-1/8): a mesh of 10,000 times the area gets 3.2 times coarser texels, 0.1 of its share.

Equal density starves what the picture is about: an artist's ground plane takes nearly the whole atlas.
"""
DENSITY_RANGE = 4.0  # at most this much finer or coarser than the scene's median mesh
ANGLE_LIMIT = math.radians(66)  # Blender's default
MARGIN = 0.003  # of the atlas side: 1.5 texels at 512
EXPECTED_OCCUPANCY = 0.65
MEASURE_SIZE = 512
BELOW_ONE = float(np.nextafter(np.float32(1), np.float32(0)))


def build_atlas(meshes: Sequence[FrozenMesh]) -> AtlasFacts:
    """Fill ``mesh.atlas`` of every mesh and measure the atlas.

    Smart UV project, islands scaled to texel densities (see `texel_density`) and packed; planar charts on
    shelves (see `charts`) when the scene has more than `SMART_LIMIT` triangles or very many meshes.
    """
    started = time.perf_counter()
    total = sum(mesh.triangles for mesh in meshes)
    density = texel_density(meshes)
    simple = total <= SMART_LIMIT and len(meshes) <= SMART_MESHES and count_pieces(meshes) <= SMART_PIECES
    (_smart_atlas if simple else chart_atlas)(meshes, density)
    _fit(meshes)
    numbers = measure_atlas(meshes)
    return AtlasFacts(method="smart" if simple else "charts", seconds=time.perf_counter() - started, **numbers)


def texel_density(meshes: Sequence[FrozenMesh]) -> np.ndarray:
    """Relative texels per world unit of every mesh, float64 [N]: area^DENSITY_POWER about the median, clamped."""
    areas = np.array([world_area(mesh) for mesh in meshes])
    median = float(np.median(areas[areas > 0])) if (areas > 0).any() else 1.0
    relative = np.where(areas > 0, areas, median) / median
    return np.clip(relative**DENSITY_POWER, 1 / DENSITY_RANGE, DENSITY_RANGE)


def world_area(mesh: FrozenMesh) -> float:
    """Area of the mesh, copies not counted, scene units squared."""
    corners = mesh.positions.reshape(-1, 3, 3)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(cross, axis=1).sum(dtype=np.float64)) / 2


def _smart_atlas(meshes: Sequence[FrozenMesh], density: np.ndarray) -> None:
    with _editing(meshes) as objects:
        bpy.ops.uv.smart_project(angle_limit=ANGLE_LIMIT, island_margin=0.0, scale_to_bounds=False)
        bpy.ops.uv.select_all(action="SELECT")
        bpy.ops.uv.average_islands_scale()
        _set_density(objects, meshes, density)
        # By bounding boxes: exact shapes take 1.5 to 3 s more on the example scenes, and fill less on most of them.
        # FRACTION, which searches for the margin, took 17-55 s on a 5,856-triangle cow; ADD takes 1 s.
        # No rotation: occupancy is the same within 1%, quarter turns took 21 s on two cubes and free ones longer.
        bpy.ops.uv.pack_islands(rotate=False, scale=True, margin_method="ADD", margin=MARGIN, shape_method="AABB")
        bpy.ops.object.mode_set(mode="OBJECT")
        for obj, mesh in zip(objects, meshes, strict=True):
            mesh.atlas = _read_uv(obj, mesh)


@contextmanager
def _editing(meshes: Sequence[FrozenMesh]) -> Iterator[list[bpy.types.Object]]:
    """Welded copies of the meshes, all in edit mode with everything selected, in a scene of their own."""
    window = bpy.context.window
    before = window.scene
    scene = bpy.data.scenes.new("dnrpipe.unwrap")
    objects = []
    try:
        for mesh in meshes:
            obj = bpy.data.objects.new("dnrpipe.unwrap", _welded(mesh))
            scene.collection.objects.link(obj)
            objects.append(obj)
        window.scene = scene
        layer = scene.view_layers[0]
        layer.update()
        for obj in objects:
            obj.select_set(True, view_layer=layer)
        layer.objects.active = objects[0]
        scene.tool_settings.use_uv_select_sync = False
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.mesh.select_all(action="SELECT")
        yield objects
    finally:
        if bpy.context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        window.scene = before
        bpy.data.batch_remove([obj.data for obj in objects])
        bpy.data.scenes.remove(scene)


def _welded(mesh: FrozenMesh) -> bpy.types.Mesh:
    """Triangles that share vertices (equal positions), so that Blender sees connected islands."""
    rows = np.ascontiguousarray(mesh.positions + np.float32(0)).view(np.dtype((np.void, 12))).ravel()
    _, first, corner_vertex = np.unique(rows, return_index=True, return_inverse=True)
    data = new_mesh("dnrpipe.unwrap", mesh.positions[first], corner_vertex.astype(np.int32).reshape(-1, 3))
    data.uv_layers.new(name=ATLAS_LAYER)
    return data


def _set_density(objects: Sequence[bpy.types.Object], meshes: Sequence[FrozenMesh], density: np.ndarray) -> None:
    """Scale each mesh's islands to its density, and all to the unit square's area: so ADD's margin counts."""
    bpy.ops.object.mode_set(mode="OBJECT")
    layouts = [
        _read_uv(obj, mesh) * np.float32(factor) for obj, mesh, factor in zip(objects, meshes, density, strict=True)
    ]
    area = sum(_area(uv) for uv in layouts)
    scale = np.float32(math.sqrt(EXPECTED_OCCUPANCY / area) if area > 0 else 1.0)
    for obj, uv in zip(objects, layouts, strict=True):
        obj.data.uv_layers[ATLAS_LAYER].uv.foreach_set("vector", (uv * scale).ravel())
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.uv.select_all(action="SELECT")


def _read_uv(obj: bpy.types.Object, mesh: FrozenMesh) -> np.ndarray:
    data = obj.data
    if len(data.loops) != len(mesh.positions):
        raise RuntimeError(f"unwrapping changed the triangles of '{mesh.name}'")
    uv = np.empty((len(data.loops), 2), np.float32)
    data.uv_layers[ATLAS_LAYER].uv.foreach_get("vector", uv.ravel())
    return uv


def _fit(meshes: Sequence[FrozenMesh]) -> None:
    """Keep the packed layout, whatever its frame, inside [0, 1)."""
    low, high = _span(meshes)
    if (low < 0).any() or (high > 1).any():
        scale = float((high - low).max()) or 1.0
        for mesh in meshes:
            mesh.atlas = (mesh.atlas - low) / np.float32(scale)
    for mesh in meshes:
        mesh.atlas = np.clip(mesh.atlas, 0, BELOW_ONE).astype(np.float32)


def measure_atlas(meshes: Sequence[FrozenMesh], size: int = MEASURE_SIZE) -> dict[str, Any]:
    """The numbers of `AtlasFacts` at ``size``² texels.

    Texels are covered where their centre lies strictly inside a triangle. A mesh has sqrt(texel area / world area)
    texels per unit.
    """
    atlas = np.concatenate([mesh.atlas for mesh in meshes]).astype(np.float64).reshape(-1, 3, 2) * size
    counts, hits = _texel_counts(atlas, size)
    covered = int((counts > 0).sum())
    density = []
    for mesh in meshes:
        density.append(size * math.sqrt(_area(mesh.atlas) / world_area(mesh)))
    return {
        "size": size,
        "occupancy": covered / size**2,
        "overlap": float((counts > 1).sum()) / max(covered, 1),
        "triangles_without_texel": float((hits == 0).mean()),
        "texels_per_unit": {"median": float(np.median(density)), "min": min(density), "max": max(density)},
    }


def _span(meshes: Sequence[FrozenMesh]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest atlas coordinates, [2] each."""
    low = np.min([mesh.atlas.min(0) for mesh in meshes], axis=0)
    return low, np.max([mesh.atlas.max(0) for mesh in meshes], axis=0)


def _area(uv: np.ndarray) -> float:
    """Area of all triangles with these corners [3T, 2]."""
    return np.abs(doubled_areas(uv.astype(np.float64).reshape(-1, 3, 2))).sum() / 2


def _texel_counts(triangles: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """How many triangles [T, 3, 2] (texel units) hold each texel centre, int64 [size²]; and hits per triangle."""
    counts = np.zeros(size * size, np.int64)
    hits = np.zeros(len(triangles), np.int64)
    for owner, x, y in texels_near(triangles, size, 0.0, 1 << 20):
        point = np.stack([x, y], axis=1) + 0.5
        corners = triangles[owner]
        sign = np.sign(doubled_areas(corners))
        inside = np.ones(len(owner), bool)
        for k in range(3):
            a, b = corners[:, k], corners[:, (k + 1) % 3]
            edge = b - a
            side = edge[:, 0] * (point[:, 1] - a[:, 1]) - edge[:, 1] * (point[:, 0] - a[:, 0])
            # Strictly inside by a hair: a centre on an edge two triangles share is no overlap.
            inside &= side * sign > 1e-5 * np.linalg.norm(edge, axis=1)
        counts += np.bincount(y[inside] * size + x[inside], minlength=size * size)
        hits += np.bincount(owner[inside], minlength=len(triangles))
    return counts, hits

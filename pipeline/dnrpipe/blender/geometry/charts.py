"""A UV atlas for scenes too big for Blender's unwrapper: planar charts by direction, shelf-packed. Numpy only.

Every triangle is projected along the axis its normal points to most (box projection). Connected triangles of one
mesh with one direction form a chart; where that makes too many, the small ones of the meshes with the most charts are
joined with their neighbours in space. Charts keep one scale and are packed on shelves by their bounding boxes. A
million polygons take seconds where ``smart_project`` takes minutes. A chart that folds back over itself overlaps; the
atlas' facts say how much.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..bundle.ply import weld
from .frozen import FrozenMesh

MARGIN = 1 / 1024  # of the atlas side, between charts
MOST_CHARTS = 60_000
"""Of a scene: with more, margins take most of the atlas. Toy bricks have 30,000; joined, they have half the texels."""
SMALL_CHART = 64  # triangles; smaller ones may be joined into charts of one grid cell
CELLS = 24  # grid cells along the longest side of a mesh
MAX_ROUNDS = 64
BISECTIONS = 20


def chart_atlas(meshes: Sequence[FrozenMesh], density: np.ndarray, *, most: int = MOST_CHARTS) -> None:
    """Fill ``mesh.atlas`` of every mesh, inside [0, 1).

    density: float64 [N], per mesh, relative texels per world unit. most: charts, before small ones are joined.
    """
    found = [_charts(mesh) for mesh in meshes]
    counts = [int(chart.max()) + 1 for chart, _, _ in found]
    for number in np.argsort(counts, kind="stable")[::-1]:
        if sum(counts) <= most:
            break
        chart, side, plane = found[number]
        found[number] = _joined(meshes[number], chart, side), side, plane
        counts[number] = int(found[number][0].max()) + 1
    layouts, boxes, first = [], [], 0
    for (chart, _, plane), factor in zip(found, density, strict=True):
        corners = plane.reshape(-1, 3, 2) * factor
        order = np.argsort(chart, kind="stable")
        starts = np.flatnonzero(np.diff(chart[order], prepend=-1))
        low = np.minimum.reduceat(corners.min(1)[order], starts, axis=0)
        high = np.maximum.reduceat(corners.max(1)[order], starts, axis=0)
        layouts.append((chart + first, corners - low[chart][:, None]))
        boxes.append(high - low)
        first += len(low)
    sizes = np.concatenate(boxes)
    # Upright boxes make lower shelves' waste smaller: lay every chart with its longer side along U.
    turned = sizes[:, 1] > sizes[:, 0]
    sizes[turned] = sizes[turned][:, ::-1]
    scale, places = _pack(sizes)
    for mesh, (chart, corners) in zip(meshes, layouts, strict=True):
        swap = turned[chart]
        corners[swap] = corners[swap][..., ::-1]
        mesh.atlas = (corners * scale + places[chart][:, None]).reshape(-1, 2).astype(np.float32)


def count_pieces(meshes: Sequence[FrozenMesh]) -> int:
    """Number of connected parts of all meshes."""
    return sum(len(np.unique(_components(_faces(mesh)))) for mesh in meshes)


def _faces(mesh: FrozenMesh) -> np.ndarray:
    """int64 [T, 3]: triangles that share vertices where positions are equal."""
    return weld(mesh.positions, np.zeros_like(mesh.positions), None).faces.astype(np.int64)


def _charts(mesh: FrozenMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(chart of every triangle, int [T], 0 .. C-1; its direction, int [T]; plane coordinates, float64 [3T, 2])."""
    corners = mesh.positions.reshape(-1, 3, 3)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.argmax(np.abs(cross), axis=1)
    side = 2 * axis + (np.take_along_axis(cross, axis[:, None], 1)[:, 0] < 0)
    u, v = np.array([1, 2, 0])[axis], np.array([2, 0, 1])[axis]
    rows = np.arange(len(corners))[:, None]
    plane = np.stack([corners[rows, np.arange(3), u[:, None]], corners[rows, np.arange(3), v[:, None]]], axis=2)
    _, chart = np.unique(_components(_faces(mesh) * 6 + side[:, None]), return_inverse=True)
    return chart, side, plane.reshape(-1, 2).astype(np.float64)


def _joined(mesh: FrozenMesh, chart: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Charts with the small ones of one direction and grid cell in one, int [T], 0 .. C-1."""
    corners, size = mesh.positions.reshape(-1, 3, 3), np.bincount(chart)
    low = mesh.positions.min(0)
    cell = (mesh.positions.max(0) - low).max() / CELLS
    place = np.minimum((corners.mean(1) - low) / max(float(cell), 1e-30), CELLS - 1).astype(np.int64)
    gathered = (side * CELLS + place[:, 0]) * CELLS * CELLS + place[:, 1] * CELLS + place[:, 2]
    return np.unique(np.where(size[chart] < SMALL_CHART, len(size) + gathered, chart), return_inverse=True)[1]


def _components(keys: np.ndarray) -> np.ndarray:
    """Component of every triangle, int [T]; triangles with a key in common [T, 3] are connected.

    Labels spread as minima over keys, with pointer jumping, until nothing changes: about as many rounds as the
    logarithm of the longest way. The number of rounds is limited; a component that is then still in parts does no harm.
    """
    _, key = np.unique(keys.ravel(), return_inverse=True)
    key = key.reshape(-1, 3)
    order = np.argsort(key.ravel(), kind="stable")
    starts = np.flatnonzero(np.diff(key.ravel()[order], prepend=-1))
    label = np.arange(len(keys))
    for _ in range(MAX_ROUNDS):
        lowest = np.minimum.reduceat(np.repeat(label, 3)[order], starts)
        found = lowest[key].min(axis=1)
        # Hook roots too: the representative learns what its members found.
        np.minimum.at(found, label, found.copy())
        found = found[found]
        if (found == label).all():
            break
        label = found
    return label


def _pack(sizes: np.ndarray) -> tuple[float, np.ndarray]:
    """Boxes [C, 2] on shelves in the unit square: (scale, lower corner of each box [C, 2]).

    The largest scale that fits, by bisection. The margin shrinks with very many boxes.
    """
    margin = min(MARGIN, 0.25 / math.sqrt(len(sizes)))
    order = np.argsort(-sizes[:, 1], kind="stable")
    ordered = sizes[order]
    high = (1 - margin) / max(float(sizes.max()), 1e-30)
    area = float(sizes.prod(1).sum())
    if area > 0:
        high = min(high, math.sqrt(1 / area))
    low, best = 0.0, _shelves(np.full_like(ordered, margin))[0]
    for _ in range(BISECTIONS):
        scale = (low + high) / 2
        places, top = _shelves(ordered * scale + margin)
        if top <= 1:
            low, best = scale, places
        else:
            high = scale
    places = np.empty_like(best)
    places[order] = best + margin / 2
    return low, places


def _shelves(sizes: np.ndarray) -> tuple[np.ndarray, float]:
    """Boxes, tallest first, in rows of width 1: (corner of each [C, 2], height of all rows)."""
    ends = np.cumsum(sizes[:, 0])
    places = np.empty_like(sizes)
    first, top, used = 0, 0.0, 0.0
    while first < len(sizes):
        last = max(first + 1, int(np.searchsorted(ends, used + 1.0, side="right")))
        places[first:last, 0] = ends[first:last] - sizes[first:last, 0] - used
        places[first:last, 1] = top
        top += float(sizes[first, 1])
        used, first = float(ends[last - 1]), last
    return places, top

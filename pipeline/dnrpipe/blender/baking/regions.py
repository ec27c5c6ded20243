"""Where each material's surface lies in the scene atlas: texels, the triangles under them, and margins. No bpy here.

A *region* is the set of texels of the ``size``² atlas whose centres lie in a material's triangles. Baked values are
kept as one row per texel of the region ([N, 1, C]): materials share the atlas without sharing memory. Texels count
from the bottom left, row by row, as in `shading.textures`.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..geometry.frozen import FrozenMesh

MARGIN = 8
"""Texels around a region that repeat its rim, so that bilinear lookups at an island's edge stay inside."""
CHUNK = 1 << 22
UNIT_EDGE = 1e-4
UNFOLD_SIZE = 256
UNFOLD_SLACK = 1.02
"""Area of the triangles over area covered, up to which UVs count as free of overlaps."""
EDGE = 1e-5  # texels: a centre this near to an edge counts as inside


@dataclass(frozen=True)
class Part:
    """The triangles of one mesh that carry a material. triangles: int64 [K], rising."""

    mesh: FrozenMesh
    triangles: np.ndarray

    @property
    def corners(self) -> np.ndarray:
        """int64 [3K]: indices into the mesh's per-corner arrays."""
        return (3 * self.triangles[:, None] + np.arange(3)).ravel()


@dataclass(frozen=True)
class Region:
    """Texels of a material and the triangles under them.

    texels: int64 [N], rising. triangle: int32 [N], among the material's stacked ones (parts in order). outline:
    float64 [T, 3, 2], all its triangles in texel units. size: side of the atlas in texels.
    """

    texels: np.ndarray
    triangle: np.ndarray
    outline: np.ndarray
    size: int

    def interpolate(self, corners: np.ndarray) -> np.ndarray:
        """Values float32 [N, C] at the texel centres from values [3T, C] at the stacked corners."""
        result = np.zeros((len(self.texels), corners.shape[1]), np.float32)
        for k in range(3):
            result += self._weights[:, k : k + 1] * corners[3 * self.triangle + k]
        return result

    @functools.cached_property
    def _weights(self) -> np.ndarray:
        points = np.stack([self.texels % self.size, self.texels // self.size], axis=1) + 0.5
        return _barycentric(self.outline[self.triangle], points)


def rasterise(triangles: np.ndarray, size: int) -> Region:
    """The texels of ``triangles`` [T, 3, 2] (atlas coordinates) in an atlas of ``size``² texels.

    A texel belongs to the last triangle that holds its centre. A triangle too small to hold any centre gets the
    texel of its centroid where no other has it.
    """
    corners = triangles.astype(np.float64) * size
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    sign = np.sign(doubled_areas(corners))
    owner = np.full(size * size, -1, np.int32)
    edges = [_distance(p, q, sign) for p, q in ((a, b), (b, c), (c, a))]
    for which, x, y in texels_near(np.where((sign == 0)[:, None, None], -1.0, corners), size, 1e-4, CHUNK):
        inside = np.ones(len(which), bool)
        for along, across, offset in edges:
            inside &= along[which] * (x + 0.5) + across[which] * (y + 0.5) + offset[which] >= -EDGE
        owner[y[inside] * size + x[inside]] = which[inside]
    centre = np.clip(((a + b + c) / 3).astype(np.int64), 0, size - 1)
    flat = centre[:, 1] * size + centre[:, 0]
    lost = np.flatnonzero(owner[flat] < 0)
    owner[flat[lost]] = lost
    texels = np.flatnonzero(owner >= 0)
    return Region(texels, owner[texels], corners, size)


def texels_near(
    corners: np.ndarray, size: int, slack: float, chunk: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(triangle, column, row), int64 [K] each, of the texels whose centres lie in the triangles' boxes.

    corners: [T, 3, 2], texel units. slack: added around the boxes. chunk: texels at a time, about.
    """
    low = np.clip(np.ceil(corners.min(1) - 0.5 - slack), 0, size).astype(np.int64)
    high = np.clip(np.floor(corners.max(1) - 0.5 + slack) + 1, 0, size).astype(np.int64)
    extent = np.maximum(high - low, 0)
    boxes = extent.prod(1)
    todo = np.flatnonzero(boxes)
    starts = np.cumsum(boxes[todo]) - boxes[todo]
    for group in np.unique(starts // chunk):
        part = todo[starts // chunk == group]
        counts = boxes[part]
        which = np.repeat(part, counts)
        row, column = np.divmod(np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts), extent[which, 0])
        yield which, low[which, 0] + column, low[which, 1] + row


def _distance(p: np.ndarray, q: np.ndarray, sign: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Line through p and q [T, 2] as (u, v, w): u x + v y + w is the distance to it, positive inside the triangle."""
    edge = q - p
    length = np.maximum(np.hypot(edge[:, 0], edge[:, 1]), 1e-30)
    along, across = -edge[:, 1] * sign / length, edge[:, 0] * sign / length
    return along, across, -(along * p[:, 0] + across * p[:, 1])


def _barycentric(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Weights clipped to the triangle, summing to 1; the centroid's for a triangle without area."""
    area = doubled_areas(corners)
    usable = np.abs(area) > 1e-12
    weights = np.empty((len(corners), 3))
    for k in range(3):
        a, b = corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]
        weights[:, k] = _cross(b - a, points - a) / np.where(usable, area, 1)
    weights = np.where(usable[:, None], np.clip(weights, 0, 1), 1 / 3)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def doubled_areas(triangles: np.ndarray) -> np.ndarray:
    """[T] of triangles [T, 3, 2]; positive where they run counter-clockwise."""
    return _cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def spread(covered: np.ndarray, size: int, margin: int = MARGIN) -> tuple[np.ndarray, np.ndarray]:
    """Margin texels of a set of covered ones.

    Args:
        covered: int64 [N], texels with a value.
        margin: how far (in steps to one of 8 neighbours) values spread into empty texels.

    Returns:
        (targets, sources): int64 [K] each; texel targets[i] takes the value of the covered texel sources[i].
    """
    nearest = np.full((size, size), -1, np.int32)
    nearest.ravel()[covered] = covered
    steps = [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]
    for _ in range(margin):
        before = nearest.copy()
        for dy, dx in steps:
            target = nearest[_clip(-dy, size), _clip(-dx, size)]
            source = before[_clip(dy, size), _clip(dx, size)]
            np.copyto(target, source, where=(target < 0) & (source >= 0))
    flat = nearest.ravel()
    taken = flat >= 0
    taken[covered] = False
    targets = np.flatnonzero(taken)
    return targets, flat[targets].astype(np.int64)


def _clip(shift: int, size: int) -> slice:
    return slice(max(0, shift), size + min(0, shift))


@dataclass
class Atlas:
    """The regions of all materials of the frozen scene, made when asked for."""

    meshes: Sequence[FrozenMesh]
    size: int
    _parts: dict[str, list[Part]] | None = None
    _regions: dict[str, Region] = field(default_factory=dict)

    def parts(self, material: str) -> list[Part]:
        """The triangles that carry the material, mesh by mesh."""
        if self._parts is None:
            self._parts = {}
            for mesh in self.meshes:
                for slot in np.unique(mesh.material_index):
                    name = mesh.materials[slot]
                    if name is not None:
                        found = Part(mesh, np.flatnonzero(mesh.material_index == slot))
                        self._parts.setdefault(name, []).append(found)
        return self._parts.get(material, [])

    def region(self, material: str) -> Region:
        if material not in self._regions:
            stacked = [part.mesh.atlas[part.corners] for part in self.parts(material)]
            corners = np.concatenate(stacked) if stacked else np.zeros((0, 2), np.float32)
            self._regions[material] = rasterise(corners.reshape(-1, 3, 2), self.size)
        return self._regions[material]

    def is_unfolded(self, material: str, layer: str | None) -> bool:
        """Whether a UV layer (None: the active one) maps each mesh of the material one to one into the unit square."""
        for part in self.parts(material):
            uv = part.mesh.uv_layers.get(layer or part.mesh.active_uv or "")
            if uv is None:
                return False
            triangles = uv[part.corners].reshape(-1, 3, 2)
            if triangles.min(initial=0) < -UNIT_EDGE or triangles.max(initial=1) > 1 + UNIT_EDGE:
                return False
            area = float(np.abs(doubled_areas(triangles.astype(np.float64))).sum()) / 2
            covered = len(rasterise(triangles, UNFOLD_SIZE).texels) / UNFOLD_SIZE**2
            if area > UNFOLD_SLACK * covered:
                return False
        return True

    def stacked(self, material: str, values: Mapping[int, np.ndarray], channels: int) -> np.ndarray:
        """Per-corner values [M, channels] of the material's parts; ``values`` by id of the mesh, else zeros."""
        rows = []
        for part in self.parts(material):
            own = values.get(id(part.mesh))
            empty = np.zeros((3 * len(part.triangles), channels), np.float32)
            rows.append(empty if own is None else own[part.corners, :channels])
        return np.concatenate(rows) if rows else np.zeros((0, channels), np.float32)

    def image(self, materials: Mapping[str, np.ndarray]) -> np.ndarray:
        """Full image [size, size, C] of the materials' region values [N, 1, C], with margins; 0 elsewhere."""
        channels = next(iter(materials.values())).shape[2]
        full = np.zeros((self.size * self.size, channels), np.float32)
        covered = np.zeros(len(full), bool)
        for name, values in materials.items():
            texels = self.region(name).texels
            full[texels] = values[:, 0]
            covered[texels] = True
        targets, sources = spread(np.flatnonzero(covered), self.size)
        full[targets] = full[sources]
        return full.reshape(self.size, self.size, channels)

"""Where what a frame shows is in a frame before or after it, within recorded kernels.

Notation
    P        surface point at a pixel's centre, world space; n its normal
    corners  the four pixels of the other frame around a point's place in it

At edges a pixel shows several surfaces: it goes with the surface in front.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .neighbours import AROUND, Pixels

PLANE = 0.01
"""Distance from P's tangent plane over distance to the camera up to which a point lies on the same surface."""
TURNED = 0.8
"""Least cosine between its normal and P's."""
REACH = 2
"""Pixels that a pixel's neighbourhood reaches to each side."""
LEAST_WEIGHT = 0.2
"""Share of the corners, by their distance, that must lie on the same surface."""
CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))
HALF, TINY = 0.5, 1e-4
"""Pixels: how far a picture goes beyond the centres of its outer ones; what keeps a place off the last."""


@dataclass(frozen=True)
class Surfaces:
    """What a frame sees, an array element per pixel.

    normal, point, mask: n, P, and whether there is one. edge: neighbours lie on other surfaces. front: where the one in
    front is. sight: direction of the pixel's line of sight. distance: of P from the camera.
    """

    normal: Any
    point: Any
    mask: Any
    edge: Any
    front: Any
    sight: Any
    distance: Any

    def holds(self, place: Any, facing: Any) -> Any:
        """Whether points ``place`` with normals ``facing`` lie on the pixels' own surfaces."""
        import drjit as dr

        on = dr.dot(facing, self.normal) > TURNED
        return on & (dr.abs(dr.dot(place - self.point, self.normal)) < PLANE * self.distance)


class Picture(Pixels):
    """What a frame shows at its pixels and about them."""

    def sights(self, camera: Any) -> tuple[Any, Any, Any]:
        """(the camera's place; directions of the lines of sight; lengths along them per depth). camera: see
        `opaque_camera`."""
        import drjit as dr

        (right, up, back, origin), (fl_x, fl_y, cx, cy), _ = camera
        x, y = (self.mi.Float(self.x) + 0.5 - cx) / fl_x, (self.mi.Float(self.y) + 0.5 - cy) / fl_y
        sight = self.mi.Vector3f(right * x - up * y - back)
        return origin, dr.normalize(sight), dr.norm(sight)

    def surfaces(self, camera: Any, normal: Any, mask: Any, depth: Any, *, edges: bool = True) -> Surfaces:
        """camera: see `opaque_camera`. depth: planar. edges: False: none but about surfaces."""
        import drjit as dr

        mi = self.mi
        nearest = mi.Float(dr.inf)  # of the neighbours that see a surface
        for right, below in AROUND:
            index = self.index(right, below)
            beside = dr.select(dr.gather(mi.Bool, mask, index), dr.gather(mi.Float, depth, index), dr.inf)
            nearest = dr.minimum(nearest, beside)
        nearest = dr.select(dr.isfinite(nearest), nearest, 0)
        origin, sight, stretch = self.sights(camera)
        distance, ahead = dr.select(mask, depth, nearest) * stretch, nearest * stretch
        point, front = (mi.Point3f(origin + sight * far) for far in (distance, ahead))
        edge = ~mask & (nearest > 0)
        if edges:
            edge |= mask & self.is_edge(point, normal, distance, mask)
        return Surfaces(normal, point, mask, edge, front, sight, distance)

    def is_edge(self, point: Any, normal: Any, distance: Any, mask: Any) -> Any:
        """Whether some of the eight neighbours lie on another surface."""
        import drjit as dr

        mi, edge = self.mi, self.mi.Bool(False)
        for right, below in AROUND:
            index = self.index(right, below)
            beside, facing = dr.gather(mi.Point3f, point, index), dr.gather(mi.Normal3f, normal, index)
            edge |= ~dr.gather(mi.Bool, mask, index) | (dr.dot(facing, normal) <= TURNED)
            edge |= dr.abs(dr.dot(beside - point, normal)) >= PLANE * distance
        return edge

    def clipped(self, earlier: Any, colour: Any, spread: float) -> Any:
        """``earlier`` brought to what the neighbourhood of each pixel shows of ``colour``: mean and ``spread`` standard
        deviations of nine pixels."""
        import drjit as dr

        mi = self.mi
        total, squares = mi.Color3f(0), mi.Color3f(0)
        for right, below in AROUND:
            beside = dr.gather(mi.Color3f, colour, self.index(REACH * right, REACH * below))
            total, squares = total + beside, squares + beside * beside
        mean = total / 9
        most = spread * dr.sqrt(dr.maximum(squares / 9 - mean * mean, 0))
        return dr.clip(earlier, mean - most, mean + most)


class Places:
    """Where points are in the picture of another frame."""

    def __init__(self, mi: Any, picture: Picture, camera: Any, points: Any) -> None:
        import drjit as dr

        (right, up, back, origin), (fl_x, fl_y, cx, cy), _ = camera
        self.mi, self.width, self.height = mi, picture.width, picture.height
        local = points - origin
        depth = -dr.dot(local, back)
        ahead = depth > 0
        depth = dr.select(ahead, depth, 1)
        x = cx + fl_x * dr.dot(local, right) / depth - 0.5
        y = cy - fl_y * dr.dot(local, up) / depth - 0.5
        last_x, last_y = self.width - 1, self.height - 1
        self.inside = ahead & (x > -HALF) & (y > -HALF) & (x < last_x + HALF) & (y < last_y + HALF)
        x, y = dr.clip(x, 0, last_x - TINY), dr.clip(y, 0, last_y - TINY)
        column, row = dr.floor(x), dr.floor(y)
        self.across, self.down = x - column, y - row
        self.column, self.row = mi.Int32(column), mi.Int32(row)
        self.corners = [self.index(*corner) for corner in CORNERS]

    def index(self, right: int, below: int) -> Any:
        """Of the pixels so far from the upper left corner."""
        import drjit as dr

        column = dr.clip(self.column + right, 0, self.width - 1)
        return dr.clip(self.row + below, 0, self.height - 1) * self.width + column

    def weights(self, same: list[Any]) -> tuple[list[Any], Any]:
        """(weights of the corners, which sum to 1 or are 0; whether enough of them count)."""
        import drjit as dr

        shares = []
        for (right, below), counts in zip(CORNERS, same, strict=True):
            share = (self.across if right else 1 - self.across) * (self.down if below else 1 - self.down)
            shares.append(dr.select(counts, share, 0))
        total = shares[0] + shares[1] + shares[2] + shares[3]
        enough = total > LEAST_WEIGHT
        return [dr.select(enough, share / total, 0) for share in shares], enough

    def bilinear(self, values: Any, weights: list[Any]) -> Any:
        """Values at the places, 0 where nothing counts. values: four a pixel."""
        import drjit as dr

        kind = self.mi.Vector4f
        pairs = zip(self.corners, weights, strict=True)
        return sum((weight * dr.gather(kind, values, index) for index, weight in pairs), kind(0))

    def spline(self, values: Any, active: Any, otherwise: Any, weights: Any = None) -> Any:
        """Values at the places by splines, not below 0, where ``active``. values: four a pixel. weights: of the pixels
        in a row; None: `catmull_rom`."""
        import drjit as dr

        across, down = ((weights or catmull_rom)(part) for part in (self.across, self.down))
        found, first = self.mi.Vector4f(0), 1 - len(across) // 2
        for j in range(len(down)):
            for i in range(len(across)):
                index = self.index(first + i, first + j)
                found += across[i] * down[j] * dr.gather(self.mi.Vector4f, values, index, active)
        return dr.select(active, dr.maximum(found, 0), otherwise)


def catmull_rom(t: Any) -> tuple[Any, Any, Any, Any]:
    """Weights of the pixels at -1, 0, 1 and 2, for t in [0, 1)."""
    first, last = t * (t - 0.5 - 0.5 * t * t), 0.5 * t * t * (t - 1)
    second = 1 + t * t * (1.5 * t - 2.5)
    return first, second, 1 - first - second - last, last

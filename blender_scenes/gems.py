"""Cut stones for `jewels`: convex bodies given by their facets' planes, with the angles of real cuts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from solids import Shape, box_uv, rotation


def polytope(planes: Sequence[tuple[np.ndarray, float]]) -> Shape:
    """Convex body {x : n.x <= d for every (n, d)} about the origin, one face for each plane that touches it."""
    normals = np.array([n / np.linalg.norm(n) for n, _ in planes])
    offsets = np.array([d / np.linalg.norm(n) for n, d in planes])
    count = len(planes)
    i, j, k = np.array([(a, b, c) for a in range(count) for b in range(a) for c in range(b)]).T
    systems = np.stack([normals[i], normals[j], normals[k]], axis=1)
    good = np.abs(np.linalg.det(systems)) > 1e-6
    corners = np.linalg.solve(systems[good], np.stack([offsets[i], offsets[j], offsets[k]], axis=1)[good][..., None])[
        ..., 0
    ]
    corners = corners[(corners @ normals.T <= offsets + 1e-9).all(axis=1)]
    points = np.unique(corners.round(7), axis=0)
    faces = []
    for normal, offset in zip(normals, offsets, strict=True):
        on = np.flatnonzero(np.abs(points @ normal - offset) < 1e-6)
        if len(on) < 3:
            continue
        across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        centred = points[on] - points[on].mean(0)
        order = np.argsort(np.arctan2(centred @ np.cross(normal, across), centred @ across))
        faces.append(tuple(int(v) for v in on[order]))
    return Shape(points, faces, box_uv(points, faces, 1.0))


def _tilted(azimuth: float, tilt: float) -> np.ndarray:
    """Unit vector ``tilt`` degrees from +Z at ``azimuth`` degrees."""
    a, t = np.radians(azimuth), np.radians(tilt)
    return np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])


def _through(azimuth: float, tilt: float, radius: float, height: float) -> tuple[np.ndarray, float]:
    """Plane of that normal through the point at (radius, height) on its own azimuth."""
    normal = _tilted(azimuth, tilt)
    a = np.radians(azimuth)
    return normal, float(normal @ [radius * np.cos(a), radius * np.sin(a), height])


def brilliant(radius: float, stretch: float = 1.0) -> Shape:
    """Round brilliant of the usual proportions (table 0.55, crown 34.5, pavilion 40.75 degrees), girdle at z = 0."""
    girdle, table = 0.02, 0.55
    top = girdle + (1 - table) * np.tan(np.radians(34.5))
    planes = [(np.array([0, 0, 1.0]), top), (np.array([0, 0, -1.0]), 0.86)]
    for k in range(8):
        main = 45.0 * k
        planes.append(_through(main, 34.5, 1.0, girdle))
        planes.append(_through(main + 22.5, 21.0, table * np.cos(np.radians(22.5)), top))
        planes.append(_through(main, 180 - 40.75, 1.0, -girdle))
        for half in (-11.25, 11.25):
            planes.append(_through(main + half, 40.5, 0.995, girdle))
            planes.append(_through(main + half, 180 - 42.2, 0.995, -girdle))
            planes.append(_through(main + half, 90.0, 0.99, 0.0))
    shape = polytope(planes)
    return Shape(shape.points * radius * np.array([stretch, 1, 1]), shape.faces, shape.uv * radius)


def emerald_cut(width: float, depth: float) -> Shape:
    """Step cut with clipped corners: three crown and three pavilion tiers; half sizes."""
    planes = [(np.array([0, 0, 1.0]), 0.42 * depth)]
    reaches = {0: width, 90: depth, 180: width, 270: depth}
    for azimuth in range(0, 360, 45):
        reach = reaches.get(azimuth, (width + depth) * 0.62)
        planes.append(_through(azimuth, 90.0, reach, 0.0))
        for tilt, inset, height in ((48.0, 0.0, 0.04), (38.0, 0.14, 0.19), (27.0, 0.28, 0.30)):
            planes.append(_through(azimuth, tilt, reach - inset * depth, height * depth))
        for tilt, inset, height in ((55.0, 0.0, -0.04), (45.0, 0.22, -0.36), (34.0, 0.50, -0.64)):
            planes.append(_through(azimuth, 180 - tilt, reach - inset * depth, height * depth))
    return polytope(planes)


def resting(shape: Shape, tilt: float, azimuth: float) -> Shape:
    """Tilted from its axis and set down on z = 0."""
    turned = shape.moved(turn=rotation(2, azimuth) @ rotation(1, tilt))
    return turned.moved((0, 0, -turned.points[:, 2].min() + 1e-4))

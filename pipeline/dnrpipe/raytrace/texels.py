"""The scene atlas as points on surfaces: which triangle lies under a point of the atlas, and where it is in space.

Notation
    (U, V)   atlas coordinates in [0, 1)², V up; texel (row j, column i) of a side-n lightmap covers
             [i/n, (i+1)/n) x [j/n, (j+1)/n): row 0 is V = 0
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

ATTRIBUTE = "vertex_atlas"
LIFT = 2e-4
"""Of a size: how far above a surface a ray starts."""
PROBES = 256
"""Rays per side of a mesh that find out whether it can be seen."""
SEEN = 0.02
"""A side can be seen where more of its rays than this share end elsewhere than at the mesh itself."""
SHELL = 0.9
"""Of the scene's extent along each axis: a mesh that has so much of it may be a room, seen from within."""


class AtlasSurface:
    """All meshes of a scene, unfolded: answers (U, V) -> surface point by casting rays onto the unfolded triangles.

    Copies that share a place of the atlas lie on top of each other there: any of them may answer.
    """

    def __init__(self, mi: Any, scene: Any, groups: Sequence[tuple[Path, np.ndarray]]) -> None:
        """groups: the meshes that instances repeat, each with the matrix of its place (`grouped_meshes`)."""
        meshes = [(shape, np.eye(4)) for shape in scene.shapes() if shape.is_mesh()]
        meshes += [(mi.load_dict({"type": "ply", "filename": str(path)}), matrix) for path, matrix in groups]
        corners, places, sides, closed = [], [], [], []
        box = scene.bbox()
        extent = np.array(box.max).ravel() - np.array(box.min).ravel()
        for shape, matrix in meshes:
            if not shape.has_attribute(ATTRIBUTE):
                continue
            faces = np.array(shape.faces_buffer()).reshape(-1, 3)
            vertices = np.array(shape.vertex_positions_buffer()).reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
            if np.linalg.det(matrix[:3, :3]) < 0:  # mirrored: the front stays the front
                faces = faces[:, ::-1]
            atlas = np.array(shape.attribute_buffer(ATTRIBUTE)).reshape(-1, 3) * (1, 1, 0)  # without object numbers
            corners.append(vertices[faces])
            places.append(atlas[faces])
            bsdf = shape.bsdf()
            holes = bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
            shell = bool((np.ptp(vertices, axis=0) >= SHELL * extent).all())
            seen = np.ones(2, bool) if holes or shell else seen_sides(mi, vertices[faces])
            sides.append(np.tile(seen, (len(faces), 1)))
            clear = bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)
            closed.append(np.tile(~seen & (not clear), (len(faces), 1)))
        self.mi = mi
        self.count = sum(map(len, corners))
        if not self.count:
            return
        unfolded = np.concatenate(places).reshape(-1, 3).astype(np.float32)
        mesh = mi.Mesh("atlas", len(unfolded), self.count)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = mi.Float(unfolded.ravel())
        parameters["faces"] = mi.UInt32(np.arange(len(unfolded), dtype=np.uint32))
        parameters.update()
        self.flat = mi.load_dict({"type": "scene", "atlas": mesh})
        self.first, self.copies, self.order = map(mi.UInt32, _copies(np.concatenate(places)))
        self.seen, self.closed = (
            [mi.Float(side) for side in np.concatenate(each).T.astype(np.float32)] for each in (sides, closed)
        )
        self.corners = mi.Float(np.concatenate(corners).astype(np.float32).ravel())

    def points(self, uv: Any, choice: Any = None) -> tuple[Any, Any, Any]:
        """mi.Point2f (U, V) -> (world position, geometric normal of the triangle, whether there is a surface).

        choice: numbers in [0, 1) that pick one of the copies that share the place; None: the first.
        """
        import drjit as dr

        mi = self.mi
        ray = mi.Ray3f(mi.Point3f(uv.x, uv.y, 1), mi.Vector3f(0, 0, -1))
        hit = self.flat.ray_intersect_preliminary(ray)
        found = hit.is_valid()
        number = mi.UInt32(0)
        triangle = hit.prim_index
        copies = dr.gather(mi.UInt32, self.copies, triangle, found)
        if choice is not None:
            number = dr.minimum(mi.UInt32(choice * mi.Float(copies)), dr.maximum(copies, 1) - 1)
        triangle = dr.gather(mi.UInt32, self.order, dr.gather(mi.UInt32, self.first, triangle, found) + number, found)
        first = triangle * 3
        a, b, c = (dr.gather(mi.Point3f, self.corners, first + i, found) for i in range(3))
        place = a + (b - a) * hit.prim_uv.x + (c - a) * hit.prim_uv.y
        normal = dr.cross(b - a, c - a)
        length = dr.norm(normal)
        found &= length > 0
        return place, mi.Normal3f(normal / dr.maximum(length, 1e-30)), found

    def sides(self, uv: Any, *, closed: bool) -> list[Any]:
        """Whether the front (the side that the normal points to) and the back of the surface at (U, V) can be seen;
        with ``closed``, whether they are the inside of a closed mesh that lets no light through."""
        import drjit as dr

        mi = self.mi
        hit = self.flat.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(uv.x, uv.y, 1), mi.Vector3f(0, 0, -1)))
        found = hit.is_valid()
        sides = self.closed if closed else self.seen
        return [found & (dr.gather(mi.Float, side, hit.prim_index, found) > 0.5) for side in sides]


def _copies(places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles [T, 3, 3] that lie at the same place: (where a triangle's copies begin in the order, how many they
    are, the order), uint32 [T] each."""
    keys = np.ascontiguousarray(places[..., :2], np.float32).reshape(len(places), -1).view(np.dtype((np.void, 24)))
    _, group, count = np.unique(keys.ravel(), return_inverse=True, return_counts=True)
    start = np.cumsum(count) - count
    order = np.argsort(group, kind="stable")
    return start[group].astype(np.uint32), count[group].astype(np.uint32), order.astype(np.uint32)


def grouped_meshes(bundle: Path) -> list[tuple[Path, np.ndarray]]:
    """Meshes of the bundle's shape groups, each with the matrix [4, 4] of its first instance.

    All instances share a place in the atlas, and so the light of the first.
    """
    root = ET.parse(bundle).getroot()
    placed: dict[str, np.ndarray] = {}
    for instance in root.findall("shape[@type='instance']"):
        (reference,), (matrix,) = instance.findall("ref"), instance.findall("transform/matrix")
        numbers = [float(part) for part in matrix.attrib["value"].split()]
        placed.setdefault(reference.attrib["id"], np.array(numbers).reshape(4, 4))
    found = []
    for group in root.findall("shape[@type='shapegroup']"):
        for name in group.findall("shape/string[@name='filename']"):
            if group.attrib["id"] in placed:
                found.append((bundle.parent / name.attrib["value"], placed[group.attrib["id"]]))
    return found


def seen_sides(mi: Any, triangles: np.ndarray) -> np.ndarray:
    """Whether rays leave the front and the back of a mesh [T, 3, 3] without meeting it again -> bool [2].

    The inside of a closed mesh keeps them. Which side that is, its normals do not tell: Blender shows both alike, and
    many a mesh is inside out.
    """
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]).astype(np.float64)
    area = np.linalg.norm(cross, axis=1)
    if not area.sum() > 0:
        return np.ones(2, bool)
    random = np.random.default_rng(0)
    chosen = random.choice(len(area), PROBES, p=area / area.sum())
    u, v = np.sort(random.random((2, PROBES)), axis=0)
    weights = np.stack([u, v - u, 1 - v], axis=1)
    origin = (weights[:, :, None] * triangles[chosen]).sum(axis=1)
    normal = cross[chosen] / area[chosen, None]
    around = random.normal(size=(PROBES, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    lift = LIFT * np.linalg.norm(np.ptp(triangles.reshape(-1, 3), axis=0))
    mesh = mi.Mesh("alone", 3 * len(triangles), len(triangles))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(triangles.astype(np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.arange(3 * len(triangles), dtype=np.uint32))
    parameters.update()
    alone = mi.load_dict({"type": "scene", "mesh": mesh})
    shares = []
    for side in (1, -1):
        up = normal * side
        start, direction = (origin + lift * up).T, (up + 0.999 * around).T  # cosine-weighted
        ray = mi.Ray3f(mi.Point3f(start.astype(np.float32)), mi.Vector3f(direction.astype(np.float32)))
        shares.append(1 - np.array(alone.ray_test(ray)).mean())
    return np.array(shares) > SEEN

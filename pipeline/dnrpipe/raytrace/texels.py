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
OPEN_MESH = 1e-3
"""A surface whose area vectors sum to more than this share of its area has a rim."""


class AtlasSurface:
    """All meshes of a scene, unfolded: answers (U, V) -> surface point by casting rays onto the unfolded triangles.

    Copies that share a place of the atlas lie on top of each other there: any of them may answer.
    """

    def __init__(self, mi: Any, scene: Any, groups: Sequence[tuple[Path, np.ndarray]] = ()) -> None:
        """groups: the meshes that instances repeat, each with the matrix of its place (`grouped_meshes`)."""
        meshes = [(shape, np.eye(4)) for shape in scene.shapes() if shape.is_mesh()]
        meshes += [(mi.load_dict({"type": "ply", "filename": str(path)}), matrix) for path, matrix in groups]
        corners, places, open_ = [], [], []
        for shape, matrix in meshes:
            if not shape.has_attribute(ATTRIBUTE):
                continue
            faces = np.array(shape.faces_buffer()).reshape(-1, 3)
            vertices = np.array(shape.vertex_positions_buffer()).reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
            atlas = np.array(shape.attribute_buffer(ATTRIBUTE)).reshape(-1, 3)
            corners.append(vertices[faces])
            places.append(atlas[faces])
            open_.append(np.full(len(faces), _has_rim(vertices[faces])))
        self.mi = mi
        self.count = sum(map(len, corners))
        if not self.count:
            return
        unfolded = np.concatenate(places).reshape(-1, 3).astype(np.float32)
        unfolded[:, 2] = 0
        mesh = mi.Mesh("atlas", len(unfolded), self.count)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = mi.Float(unfolded.ravel())
        parameters["faces"] = mi.UInt32(np.arange(len(unfolded), dtype=np.uint32))
        parameters.update()
        self.flat = mi.load_dict({"type": "scene", "atlas": mesh})
        self.first, self.copies, self.order = map(mi.UInt32, _copies(np.concatenate(places)))
        self.open = mi.Float(np.concatenate(open_).astype(np.float32))
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

    def thin(self, uv: Any) -> Any:
        """Whether the surface at (U, V) has a rim, so that its back can be seen."""
        import drjit as dr

        mi = self.mi
        hit = self.flat.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(uv.x, uv.y, 1), mi.Vector3f(0, 0, -1)))
        return hit.is_valid() & (dr.gather(mi.Float, self.open, hit.prim_index, hit.is_valid()) > 0.5)


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


def _has_rim(triangles: np.ndarray) -> bool:
    """Of a closed surface [T, 3, 3] the area vectors sum to nothing (divergence theorem)."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]).astype(np.float64)
    return bool(np.linalg.norm(cross.sum(axis=0)) > OPEN_MESH * max(np.linalg.norm(cross, axis=1).sum(), 1e-20))

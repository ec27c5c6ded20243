"""A thing: one body with its parts' roles, resting on z = 0, ready to be painted and placed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import bpy
import numpy as np
from solids import Shape, box_uv, rotation


@dataclass
class Thing:
    """``roles`` name what the faces of slot 0, 1, ... are made of; see ``finishes.Finishes``.

    smooth: edges sharper than this many degrees stay sharp; None is flat shading.
    modifier: left live on the object, as artists leave it: "bevel" or "subdivide".
    top: (x, y, z, radius) of a level place where something small can stand.
    """

    name: str
    shape: Shape
    roles: tuple[str, ...] = ("thing",)
    smooth: float | None = 40.0
    modifier: str = ""
    top: tuple[float, float, float, float] | None = None

    @property
    def size(self) -> np.ndarray:
        return np.ptp(self.shape.points, axis=0)

    @property
    def radius(self) -> float:
        """Of the circle about the origin that holds it, seen from above."""
        return float(np.hypot(*self.shape.points[:, :2].T).max())

    def scaled(self, factor: float) -> Thing:
        s = self.shape
        top = None if self.top is None else tuple(factor * c for c in self.top)
        return replace(self, shape=Shape(s.points * factor, s.faces, s.uv, s.slots), top=top)

    def fitted(self, radius: float, height: float) -> Thing:
        """As large as fits a cylinder."""
        return self.scaled(min(radius / max(self.radius, 1e-6), height / max(float(self.size[2]), 1e-6)))


def resting(shape: Shape, *turns: tuple[int, float]) -> Shape:
    """Turned by (axis, degrees) in this order, centred over the origin, set down on z = 0."""
    for axis, degrees in turns:
        shape = shape.moved(turn=rotation(axis, degrees))
    low, high = shape.points.min(0), shape.points.max(0)
    return shape.moved((-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]))


def shape_of(mesh: bpy.types.Mesh) -> Shape:
    """The data of a Blender mesh, which is removed. Without a UV map, faces are projected along their axis."""
    points = np.array([v.co for v in mesh.vertices])
    faces = [tuple(p.vertices) for p in mesh.polygons]
    if mesh.uv_layers:
        uv = np.empty(2 * len(mesh.loops), dtype=np.float32)
        mesh.uv_layers[0].data.foreach_get("uv", uv)
    else:
        uv = box_uv(points, faces, 1.0)
    bpy.data.meshes.remove(mesh)
    return Shape(points, faces, uv)

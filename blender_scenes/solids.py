"""Solids as plain data, to be joined, moved and painted before they become one mesh.

A `Shape` is points, faces and UVs; `place` hands it to Blender. `shapes` makes objects one
by one instead. Lengths are scene units, UVs texture repeats, faces wind counter-clockwise seen from outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import bpy
import numpy as np
from frames import minimal_frame, tangents
from shapes import ball_profile, grid_uv

Point = tuple[float, float, float]
Face = tuple[int, ...]


@dataclass
class Shape:
    """Polygons: ``points`` [V, 3]; ``faces`` of vertex indices; ``uv`` [corners, 2] in the order of the faces' corners.

    ``slots`` holds the material slot of each face.
    """

    points: np.ndarray
    faces: list[Face]
    uv: np.ndarray
    slots: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.points = np.asarray(self.points, dtype=float).reshape(-1, 3)
        self.uv = np.asarray(self.uv, dtype=float).reshape(-1, 2)
        self.slots = self.slots or [0] * len(self.faces)

    def moved(self, offset: Sequence[float] = (0, 0, 0), *, turn: np.ndarray | None = None) -> Shape:
        """Turned by a 3 x 3 matrix (of positive determinant), then moved."""
        points = self.points if turn is None else self.points @ np.asarray(turn).T
        return Shape(points + np.asarray(offset), list(self.faces), self.uv.copy(), list(self.slots))

    def painted(self, slot: int) -> Shape:
        """All faces in one material slot."""
        return Shape(self.points, list(self.faces), self.uv, [slot] * len(self.faces))


def join(parts: Sequence[Shape]) -> Shape:
    """One shape of several; vertices are not merged."""
    faces: list[Face] = []
    slots: list[int] = []
    start = 0
    for part in parts:
        faces += [tuple(i + start for i in face) for face in part.faces]
        slots += part.slots
        start += len(part.points)
    return Shape(np.concatenate([p.points for p in parts]), faces, np.concatenate([p.uv for p in parts]), slots)


def mesh_of(name: str, shape: Shape, *, smooth: float | None = 40.0) -> bpy.types.Mesh:
    """Blender mesh; smooth-shaded with edges sharper than ``smooth`` degrees kept, or flat where None."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(shape.points.tolist(), [], shape.faces)
    mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", shape.uv.astype(np.float32).ravel())
    mesh.polygons.foreach_set("material_index", np.asarray(shape.slots, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.full(len(shape.faces), smooth is not None))
    if smooth is not None:
        mesh.set_sharp_from_angle(angle=np.radians(smooth))
    mesh.update()
    return mesh


def place(
    name: str,
    shape: Shape | bpy.types.Mesh,
    *materials: bpy.types.Material,
    at: Point = (0, 0, 0),
    turn: Point = (0, 0, 0),
    smooth: float | None = 40.0,
) -> bpy.types.Object:
    """Add an object at ``at``, turned by Euler angles in degrees; ``materials`` fill a fresh mesh's slots."""
    mesh = mesh_of(name, shape, smooth=smooth) if isinstance(shape, Shape) else shape
    if not mesh.materials:
        for material in materials:
            mesh.materials.append(material)
    body = bpy.data.objects.new(name, mesh)
    body.location, body.rotation_euler = at, np.radians(turn).tolist()
    bpy.context.scene.collection.objects.link(body)
    return body


def rotation(axis: int, degrees: float) -> np.ndarray:
    """Rotation about a coordinate axis, 3 x 3."""
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    out = np.eye(3)
    out[a, a], out[a, b], out[b, a], out[b, b] = cosine, -sine, sine, cosine
    return out


# ---------------------------------------------------------------- grids, lathes, tubes


def grid(points: np.ndarray, uv: np.ndarray, *, wrap: bool = False, close: bool = False) -> Shape:
    """Quads over points [R, C, 3]; ``wrap`` joins the last column to the first, ``close`` the last row to the first.

    uv is [R + close, C + wrap, 2]: seams have coordinates of their own. Columns run to the right and rows up
    when seen from outside. Rows that shrink to a point become one vertex, their quads triangles.
    """
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    for r in range(rows):
        if np.ptp(points[r], axis=0).max() < 1e-9:
            index[r] = index[r, 0]
    used, flat = np.unique(index, return_inverse=True)
    index = flat.reshape(rows, columns)
    faces: list[Face] = []
    corners: list[np.ndarray] = []
    for r in range(rows if close else rows - 1):
        for c in range(columns if wrap else columns - 1):
            face: list[int] = []
            for i, j in ((r, c), (r, c + 1), (r + 1, c + 1), (r + 1, c)):
                vertex = int(index[i % rows, j % columns])
                if vertex not in face:
                    face.append(vertex)
                    corners.append(uv[i, j])
            faces.append(tuple(face))
    return Shape(points.reshape(-1, 3)[used], faces, np.asarray(corners))


def lathe(profile: Sequence[tuple[float, float]], segments: int = 64, repeats: tuple[float, float] = (1, 1)) -> Shape:
    """Surface of revolution about Z of (radius, height); outside is on the right going along the profile.

    u runs once around, v along the profile by arc length; both times ``repeats``.
    """
    outline = np.asarray(profile, dtype=float)
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    points = np.stack(
        [outline[:, :1] * np.cos(turn), outline[:, :1] * np.sin(turn), np.repeat(outline[:, 1:], segments, axis=1)],
        axis=-1,
    )
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    u, v = np.meshgrid(np.linspace(0, repeats[0], segments + 1), arc / arc[-1] * repeats[1])
    return grid(points, np.stack([u, v], axis=-1), wrap=True)


def ball(radius: float, rows: int = 32, segments: int = 64, repeats: tuple[float, float] = (1, 1)) -> Shape:
    """Sphere about the origin."""
    return lathe([(r, z - radius) for r, z in ball_profile(radius, rows)], segments, repeats)


def loop_spline(knots: Sequence[Sequence[float]], per_span: int = 8) -> np.ndarray:
    """Closed Catmull-Rom curve through knots [K, D]: [K per_span, D]."""
    k = np.asarray(knots, dtype=float)
    t = np.linspace(0, 1, per_span, endpoint=False)[:, None]
    a, c, d = np.roll(k, 1, 0), np.roll(k, -1, 0), np.roll(k, -2, 0)
    spans = [
        0.5 * (2 * q + (r - p) * t + (2 * p - 5 * q + 4 * r - s) * t**2 + (3 * q - p - 3 * r + s) * t**3)
        for p, q, r, s in zip(a, k, c, d, strict=True)
    ]
    return np.concatenate(spans)


def tube(
    path: np.ndarray,
    radius: float | np.ndarray,
    sides: int = 8,
    *,
    closed: bool = False,
    capped: bool = True,
    repeats: tuple[float, float] = (1, 1),
) -> Shape:
    """Round tube along a path [N, 3] (radius constant or [N]), by a rotation-minimising frame.

    ``closed`` joins the ends (the frame's leftover twist is spread evenly); otherwise flat caps close it.
    """
    path = np.asarray(path, dtype=float)
    count = len(path)
    tangent = tangents(path, closed)
    frame, twist = minimal_frame(tangent, np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))]), closed)
    other = np.cross(tangent, frame)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)[None, :] + twist[:, None]
    reach = np.broadcast_to(np.asarray(radius, dtype=float), (count,))[:, None, None]
    around = np.cos(angle)[..., None] * frame[:, None] + np.sin(angle)[..., None] * other[:, None]
    rings = path[:, None] + reach * around
    body = grid(rings, grid_uv(count + closed, sides + 1, *repeats), wrap=True, close=closed)
    if closed or not capped:
        return body
    disc = np.stack([np.cos(angle[0]), np.sin(angle[0])], axis=-1) * 0.5 + 0.5
    cap = [tuple(range(sides))]
    return join([body, Shape(rings[0][::-1], cap, disc[::-1]), Shape(rings[-1], cap, disc)])


# ---------------------------------------------------------------- boxes and prisms


def box_uv(points: np.ndarray, faces: Sequence[Sequence[int]], scale: float) -> np.ndarray:
    """UVs [corners, 2] by projecting each face along the axis nearest to its normal; ``scale`` repeats per unit."""
    out: list[np.ndarray] = []
    for face in faces:
        corners = points[list(face)]
        axis = int(np.argmax(np.abs(_normal(corners))))
        out.append(corners[:, [(1, 2), (0, 2), (0, 1)][axis]] * scale)
    return np.concatenate(out)


def _normal(corners: np.ndarray) -> np.ndarray:
    """Unnormalised normal of a polygon [N, 3]."""
    centred = corners - corners.mean(0)
    return np.cross(centred, np.roll(centred, -1, 0)).sum(0)


def _outward(points: np.ndarray, ring: Sequence[int]) -> Face:
    """The ring, reversed where it winds clockwise seen from outside a convex body about the origin."""
    corners = points[list(ring)]
    return tuple(ring) if _normal(corners) @ corners.mean(0) > 0 else tuple(reversed(ring))


def convex(points: np.ndarray, faces: Sequence[Sequence[int]], scale: float = 1.0) -> Shape:
    """Convex body about the origin from faces of either winding, with box-projected UVs."""
    points = np.asarray(points, dtype=float)
    turned = [_outward(points, face) for face in faces]
    return Shape(points, turned, box_uv(points, turned, scale))


def box(size: Point, *, bevel: float = 0.0, scale: float = 1.0, at: Point = (0, 0, 0)) -> Shape:
    """Box about ``at`` with chamfered edges (none where ``bevel`` is 0) and box-projected UVs."""
    half = np.asarray(size, dtype=float) / 2
    signs = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)])
    if bevel <= 0:
        sides = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
        return convex(signs * half, sides, scale).moved(at)
    # Each corner is cut into three vertices, one on each face that meets there: vertex 3 corner + axis.
    points = np.repeat(signs, 3, axis=0) * (half - bevel + bevel * np.tile(np.eye(3), (8, 1)))
    corner = {tuple(sign): 3 * i for i, sign in enumerate(signs.tolist())}
    rings: list[list[int]] = [[start, start + 1, start + 2] for start in corner.values()]
    for axis in range(3):
        a, b = [(1, 2), (2, 0), (0, 1)][axis]

        def at_corner(s: int, ta: int, tb: int, axis: int = axis, a: int = a, b: int = b) -> int:
            sign = [0, 0, 0]
            sign[axis], sign[a], sign[b] = s, ta, tb
            return corner[tuple(sign)]

        for s in (-1, 1):
            rings.append([at_corner(s, ta, tb) + axis for ta, tb in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
            for ta in (-1, 1):  # the edge between this face and the next axis'
                low, high = at_corner(s, ta, -1), at_corner(s, ta, 1)
                rings.append([low + axis, high + axis, high + a, low + a])
    return convex(points, rings, scale).moved(at)


def extruded(outline: Sequence[tuple[float, float]], depth: float, scale: float = 1.0) -> Shape:
    """Prism over a counter-clockwise outline in XY (may be concave), from z = -depth/2 to depth/2."""
    flat = np.asarray(outline, dtype=float)
    count = len(flat)
    points = np.concatenate([np.c_[flat, np.full(count, z)] for z in (-depth / 2, depth / 2)])
    faces: list[Face] = [tuple(reversed(range(count))), tuple(range(count, 2 * count))]
    faces += [(i, (i + 1) % count, (i + 1) % count + count, i + count) for i in range(count)]
    return Shape(points, faces, box_uv(points, faces, scale))

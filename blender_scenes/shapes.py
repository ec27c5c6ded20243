"""Meshes with real UVs: lathes, sweeps, grids, boxes, cushions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from frames import minimal_frame, tangents

Rgb = tuple[float, float, float]


def link(
    name: str, mesh: bpy.types.Mesh, material: bpy.types.Material, *, smooth: bool = True, angle: float = 40.0
) -> bpy.types.Object:
    """Add ``mesh`` to the scene as an object with one material; smooth below ``angle`` degrees, or flat."""
    mesh.materials.clear()
    mesh.materials.append(material)
    mesh.polygons.foreach_set("use_smooth", np.full(len(mesh.polygons), smooth))
    if smooth:
        mesh.set_sharp_from_angle(angle=np.radians(angle))
    return place(name, mesh)


def place(name: str, mesh: bpy.types.Mesh) -> bpy.types.Object:
    """One more object that uses ``mesh`` (a linked duplicate where others use it too)."""
    body = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(body)
    return body


def mesh_from(name: str, vertices: Sequence[Any], faces: Sequence[Sequence[int]], uv: np.ndarray) -> bpy.types.Mesh:
    """Mesh with UV corners [sum of face sizes, 2] in the order of the faces."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(v) for v in vertices], [], [list(f) for f in faces])
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", np.asarray(uv, dtype=np.float32).ravel())
    mesh.validate()
    return mesh


def grid_mesh(
    name: str, points: np.ndarray, uv: np.ndarray, *, wrap_rows: bool = False, wrap_columns: bool = True
) -> bpy.types.Mesh:
    """Mesh of quads from a grid of points [R, C, 3], which may close around its columns and rows.

    uv is [R + wrap_rows, C + wrap_columns, 2]: a seam's corners have their own coordinates. Quads that
    collapse at a pole become triangles. Columns run to the right when rows go up, seen from outside.
    """
    rows, columns = points.shape[:2]
    vertices: list[tuple[float, ...]] = []
    index = np.zeros((rows, columns), dtype=int)
    for r in range(rows):
        pole = np.ptp(points[r], axis=0).max() < 1e-9
        for c in range(columns):
            if pole and c:
                index[r, c] = index[r, 0]
            else:
                index[r, c] = len(vertices)
                vertices.append(tuple(points[r, c]))
    faces: list[list[int]] = []
    corners: list[tuple[float, float]] = []
    for r in range(rows if wrap_rows else rows - 1):
        for c in range(columns if wrap_columns else columns - 1):
            ring = [(r, c), (r, c + 1), (r + 1, c + 1), (r + 1, c)]
            face: list[int] = []
            for i, j in ring:
                vertex = int(index[i % rows, j % columns])
                if vertex not in face:
                    face.append(vertex)
                    corners.append((float(uv[i, j, 0]), float(uv[i, j, 1])))
            faces.append(face)
    return mesh_from(name, vertices, faces, np.asarray(corners))


def grid_uv(rows: int, columns: int, width: float = 1.0, height: float = 1.0) -> np.ndarray:
    """UVs [rows, columns, 2] that run over (0, 0)-(width, height)."""
    return np.stack(np.meshgrid(np.linspace(0, width, columns), np.linspace(0, height, rows)), axis=-1)


def lathe(
    name: str, profile: Sequence[tuple[float, float]], segments: int = 96, turns: float = 1.0, rise: float | None = None
) -> bpy.types.Mesh:
    """Surface of revolution about Z; ``profile`` is (radius, height), outside on its right going up.

    u runs to ``turns`` around, v along the profile by arc length, to 1 or at ``rise`` a unit of length.
    """
    outline = np.asarray(profile, dtype=float)
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    points = np.stack(
        [
            outline[:, :1] * np.cos(turn),
            outline[:, :1] * np.sin(turn),
            np.repeat(outline[:, 1:], segments, axis=1),
        ],
        axis=-1,
    )
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    along = arc / arc[-1] if rise is None else arc * rise
    uv = np.stack(np.meshgrid(np.linspace(0, turns, segments + 1), along), axis=-1)
    return grid_mesh(name, points, uv)


def curve_profile(knots: Sequence[tuple[float, float]], per_span: int = 10) -> list[tuple[float, float]]:
    """Catmull-Rom curve through ``knots`` (radius, height)."""
    points = spline(np.asarray(knots, dtype=float), per_span)
    points[:-1, 0] = np.maximum(points[:-1, 0], 0.0)
    return [(float(r), float(z)) for r, z in points]


def spline(knots: np.ndarray, per_span: int = 10) -> np.ndarray:
    """Catmull-Rom curve through ``knots`` [N, D]; (N - 1) per_span + 1 points."""
    k = np.asarray(knots, dtype=float)
    k = np.vstack([2 * k[0] - k[1], k, 2 * k[-1] - k[-2]])
    out: list[np.ndarray] = []
    for i in range(1, len(k) - 2):
        for t in np.linspace(0, 1, per_span, endpoint=False):
            a, b, c, d = k[i - 1], k[i], k[i + 1], k[i + 2]
            out.append(
                0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
            )
    return np.array([*out, k[-2]])


def rounded_disc(radius: float, bottom: float, top: float, bevel: float) -> list[tuple[float, float]]:
    """Profile of a cylinder with round edges, from the lower to the upper pole."""
    angles = np.linspace(-np.pi / 2, 0, 9)
    lower = [(radius - bevel + bevel * np.cos(a), bottom + bevel + bevel * np.sin(a)) for a in angles]
    upper = [(radius - bevel + bevel * np.cos(a), top - bevel + bevel * np.sin(a)) for a in angles + np.pi / 2]
    return [(0.0, bottom), *lower, *upper, (0.0, top)]


def ball_profile(radius: float, rows: int = 48) -> list[tuple[float, float]]:
    """Profile of a sphere standing on z = 0."""
    lat = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)
    out = [(float(radius * np.cos(a)), float(radius + radius * np.sin(a))) for a in lat]
    out[0], out[-1] = (0.0, 0.0), (0.0, 2 * radius)
    return out


def planar_uv(mesh: bpy.types.Mesh, scale: float) -> None:
    """Replace the UV map by a projection along Z where a face looks up or down, around the axis elsewhere."""
    layer = mesh.uv_layers[0].data
    for polygon in mesh.polygons:
        flat = abs(polygon.normal.z) > 0.7
        for loop in polygon.loop_indices:
            x, y, z = mesh.vertices[mesh.loops[loop].vertex_index].co
            u = layer[loop].uv[0]
            layer[loop].uv = (x * scale, y * scale) if flat else (u * 4, z * scale)


def circle(radius: float = 1.0, count: int = 12) -> np.ndarray:
    """Section [count, 2], counterclockwise."""
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def rounded_rectangle(width: float, height: float, bevel: float, per_corner: int = 4) -> np.ndarray:
    """Section [4 per_corner, 2], counterclockwise."""
    out = []
    for k, (sx, sy) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        for a in np.linspace(0, np.pi / 2, per_corner) + k * np.pi / 2:
            out.append(
                (
                    sx * (width / 2 - bevel) + bevel * np.cos(a),
                    sy * (height / 2 - bevel) + bevel * np.sin(a),
                )
            )
    return np.array(out)


def sweep(
    name: str,
    path: np.ndarray,
    section: np.ndarray,
    *,
    scale: np.ndarray | None = None,
    closed: bool = False,
    up: Rgb = (0.0, 0.0, 1.0),
    metric: float = 1.0,
    turns: float = 1.0,
) -> bpy.types.Mesh:
    """Sweep ``section`` [M, 2] along ``path`` [N, 3]; ends are capped by a pole, unless closed.

    The frame turns as little as it can; its first side is perpendicular to ``up`` and the path. ``scale``
    [N] sizes the section at each station. u runs to ``turns`` around the section, v is length times ``metric``.
    """
    path = np.asarray(path, dtype=float)
    count = len(path)
    tangent = tangents(path, closed)
    side = np.cross(up, tangent[0])
    if np.linalg.norm(side) < 1e-6:
        side = np.cross((1.0, 0.0, 0.0), tangent[0])
    frame, twist = minimal_frame(tangent, side, closed)
    other = np.cross(tangent, frame)
    c, s = np.cos(twist)[:, None, None], np.sin(twist)[:, None, None]
    size = np.ones(count) if scale is None else np.asarray(scale, dtype=float)
    x, y = section[None, :, 0, None], section[None, :, 1, None]
    points = path[:, None] + size[:, None, None] * ((x * c - y * s) * frame[:, None] + (x * s + y * c) * other[:, None])
    steps = np.linalg.norm(np.diff(path, axis=0, append=path[:1] if closed else path[-1:]), axis=1)
    length = np.concatenate([[0], np.cumsum(steps)])
    rows = length if closed else length[:-1]
    if not closed:
        ends = [np.repeat(path[k][None], len(section), 0)[None] for k in (0, -1)]
        points = np.concatenate([ends[0], points, ends[1]])
        rows = np.concatenate([[rows[0]], rows, [rows[-1]]])
    uv = np.stack(np.meshgrid(np.linspace(0, turns, len(section) + 1), rows * metric), axis=-1)
    return grid_mesh(name, points, uv, wrap_rows=closed)


def box_mesh(name: str, size: Rgb, *, metric: float | None = None, centred: bool = False) -> bpy.types.Mesh:
    """Box on z = 0 (or centred), all faces outward. Each face's UVs are 0-1, or lengths times ``metric``."""
    x, y = size[0] / 2, size[1] / 2
    low, high = (-size[2] / 2, size[2] / 2) if centred else (0.0, size[2])
    vertices = [(sx * x, sy * y, h) for h in (low, high) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    faces = [(3, 2, 1, 0), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    spans = [(size[0], size[1])] * 2 + [(size[0], size[2]), (size[1], size[2])] * 2
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=float)
    uv = np.concatenate([corners * (1.0 if metric is None else np.array(span) * metric) for span in spans])
    return mesh_from(name, vertices, faces, uv)


def rounded_box(
    name: str, size: Rgb, material: bpy.types.Material, bevel: float = 0.02, *, metric: float | None = None
) -> bpy.types.Object:
    """Box standing on z = 0 with a bevel modifier (left live: the pipeline must evaluate it)."""
    body = link(name, box_mesh(name, size, metric=metric), material)
    modifier: Any = body.modifiers.new("Bevel", "BEVEL")
    modifier.width, modifier.segments = bevel, 4
    modifier.harden_normals = True
    return body


def block(
    name: str, low: Rgb, high: Rgb, material: bpy.types.Material, *, metric: float = 1.0, bevel: float = 0.0
) -> bpy.types.Object:
    """Box between two corners; UVs are world lengths times ``metric``, so that neighbours continue each other."""
    corners = np.array([(x, y, z) for z in (low[2], high[2]) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=float)
    corners[:, 0] = np.where(corners[:, 0] > 0, high[0], low[0])
    corners[:, 1] = np.where(corners[:, 1] > 0, high[1], low[1])
    faces = [(3, 2, 1, 0), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    axes = [(0, 1), (0, 1), (0, 2), (1, 2), (0, 2), (1, 2)]
    uv = np.concatenate([corners[list(face)][:, list(axis)] * metric for face, axis in zip(faces, axes, strict=True)])
    body = link(name, mesh_from(name, corners.tolist(), faces, uv), material)
    if bevel:
        modifier: Any = body.modifiers.new("Bevel", "BEVEL")
        modifier.width, modifier.segments = bevel, 2
        modifier.harden_normals = True
    return body


def cushion(name: str, size: Rgb, radius: float, puff: float, cells: int = 12, metric: float = 1.0) -> bpy.types.Mesh:
    """Stuffed box centred on the origin: round edges, top and bottom bulging by ``puff``. UVs in lengths."""
    half = np.array(size) / 2
    core = half - radius
    vertices: list[tuple[float, ...]] = []
    known: dict[tuple[float, ...], int] = {}
    faces: list[list[int]] = []
    corners: list[np.ndarray] = []
    t = np.sin(np.linspace(-np.pi / 2, np.pi / 2, cells + 1))  # denser towards the edges, where it bends
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            grid = np.zeros((cells + 1, cells + 1, 3))
            grid[..., a], grid[..., b] = np.meshgrid(t * half[a], t * half[b])
            grid[..., axis] = sign * half[axis]
            inner = np.clip(grid, -core, core)
            away = grid - inner
            away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
            points = inner + radius * away
            bulge = np.prod(1 - np.clip(np.abs(points[..., :2]) / half[:2], 0, 1) ** 2.5, axis=-1)
            points[..., 2] += puff * bulge * points[..., 2] / half[2]
            index = np.zeros((cells + 1, cells + 1), dtype=int)
            for i in range(cells + 1):
                for j in range(cells + 1):
                    key = tuple(np.round(points[i, j], 6))
                    if key not in known:
                        known[key] = len(vertices)
                        vertices.append(tuple(points[i, j]))
                    index[i, j] = known[key]
            for i in range(cells):
                for j in range(cells):
                    ring = [(i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)]
                    ring = ring if sign > 0 else ring[::-1]
                    faces.append([int(index[p]) for p in ring])
                    corners += [grid[p][[a, b]] * metric for p in ring]
    return mesh_from(name, vertices, faces, np.array(corners))

"""Hair and point clouds as triangles: particle hair, Curves objects, PointCloud objects -> `LocalMesh`.

Every part of the pipeline then sees the same surface: strands are tubes, points are small spheres. Beyond a budget
strands and points are thinned out evenly and thickened to keep their area.

Few strands get many sides and round normals. Many get three flat sides, each strand turned by chance: about such
prisms scatter, on average, what round strands do, while round normals on three sides lose a tenth (light that comes
from below a side, and views at which the normal looks away).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import bpy
import numpy as np

from ..findings import Findings
from .local_mesh import LocalMesh, slot_names

BUDGET = 600_000  # triangles of one hair system or point cloud
FLAT_SIDES, ROUND_SIDES, MAX_SIDES = 3, 6, 8
ROUND_BUDGET = 300_000
"""Triangles of one hair system up to which strands get more than `FLAT_SIDES`."""
MAX_SEGMENTS = 16
DEFAULT_RADIUS = 0.005  # Cycles' radius of curves without one
DEFAULT_POINT_RADIUS = 0.01


@dataclass
class Strands:
    """Polylines in object space: points float64 [N, S, 3], radii float64 [N, S], uv float32 [N, 2] or None."""

    points: np.ndarray
    radii: np.ndarray
    uv: np.ndarray | None = None
    uv_name: str = "UVMap"


Reader = Callable[[], LocalMesh | None]


def hair_systems(obj: bpy.types.Object, findings: Findings) -> list[tuple[str, Reader]]:
    """(name, reader) of each particle system of an evaluated object that Cycles renders as strands."""
    found: list[tuple[str, Reader]] = []
    for modifier in obj.modifiers:
        if modifier.type != "PARTICLE_SYSTEM" or not modifier.show_render:
            continue
        system = modifier.particle_system
        settings = system.settings
        if settings.type == "HAIR" and settings.render_type == "PATH":
            found.append((system.name, functools.partial(_read_particles, obj, modifier, findings)))
        elif settings.render_type in {"HALO", "LINE"}:
            shown = settings.render_type.lower()
            findings.add("ignored", f"particles shown as {shown}", "not rendered", object=obj.name)
    return found


def _read_particles(obj: bpy.types.Object, modifier: bpy.types.Modifier, findings: Findings) -> LocalMesh | None:
    names, system = slot_names(obj), modifier.particle_system
    slot = min(max(system.settings.material - 1, 0), len(names) - 1)
    return _tubes(_particle_strands(obj, system, modifier), names, slot, obj.name, findings)


def read_curves(obj: bpy.types.Object, findings: Findings) -> LocalMesh | None:
    """Tubes of an evaluated Curves object (the hair of Blender 3.3 and later)."""
    data = obj.data
    count = len(data.curves)
    if count == 0:
        return None
    offsets = np.empty(count + 1, np.int32)
    data.curve_offset_data.foreach_get("value", offsets)
    positions, radius = _attribute(data, "position", 3), _attribute(data, "radius", 1)
    if positions is None:
        return None
    if radius is None:
        radius = np.full((len(positions), 1), DEFAULT_RADIUS)
    lengths = np.diff(offsets)
    steps = int(np.clip(lengths.max(), 2, MAX_SEGMENTS + 1))
    # Sample every curve at the same number of points, evenly by index.
    at = offsets[:-1, None] + np.linspace(0, 1, steps)[None] * np.maximum(lengths - 1, 0)[:, None]
    lower = np.floor(at).astype(int)
    upper = np.minimum(lower + 1, np.maximum(offsets[1:, None] - 1, 0))
    weight = (at - lower)[..., None]
    points = positions[lower] * (1 - weight) + positions[upper] * weight
    radii = (radius[lower] * (1 - weight) + radius[upper] * weight)[..., 0]
    uv = _attribute(data, "surface_uv_coordinate", 2)
    keep = lengths >= 2
    strands = Strands(points[keep], radii[keep], uv[keep].astype(np.float32) if uv is not None else None)
    return _tubes(strands, slot_names(obj), 0, obj.name, findings)


def read_points(obj: bpy.types.Object, findings: Findings) -> LocalMesh | None:
    """Small spheres of an evaluated PointCloud object."""
    centers = _attribute(obj.data, "position", 3)
    if centers is None or not len(centers):
        return None
    radius = _attribute(obj.data, "radius", 1)
    if radius is None:
        radius = np.full((len(centers), 1), DEFAULT_POINT_RADIUS)
    ball = _icosahedron() if len(centers) * 20 <= BUDGET else _octahedron()
    kept = _thinned(len(centers), BUDGET // (len(ball) // 3))
    # Of a polyhedron inscribed in a sphere, a little too small: scaled to the sphere's mean width.
    grow = (1.09 if len(ball) == 60 else 1.22) * math.sqrt(len(centers) / len(kept))
    positions = centers[kept, None] + ball[None] * radius[kept, None] * grow
    findings.add("approximated", "point cloud", _note("points", len(centers), len(kept), "spheres"), object=obj.name)
    normals = np.broadcast_to(ball, positions.shape)
    return _local_mesh(positions, normals, slot_names(obj), 0)


def _particle_strands(obj: bpy.types.Object, system: bpy.types.ParticleSystem, modifier: bpy.types.Modifier) -> Strands:
    """Strands as Cycles takes them: the children where there are any, else the parents; 2^render_step segments."""
    settings = system.settings
    parents, children = len(system.particles), len(system.child_particles)
    first = parents if settings.child_type != "NONE" and children else 0
    numbers = np.arange(first, parents + children)
    steps = (1 << settings.render_step) + 1
    if len(numbers) * FLAT_SIDES * 2 * (steps - 1) > BUDGET:
        numbers = numbers[_thinned(len(numbers), BUDGET // (FLAT_SIDES * 2 * (min(steps, 5) - 1)))]
    taken = np.unique(np.linspace(0, steps - 1, min(steps, MAX_SEGMENTS + 1)).round().astype(int))
    if len(numbers) * FLAT_SIDES * 2 * (len(taken) - 1) > BUDGET:
        taken = np.unique(np.linspace(0, steps - 1, 5).round().astype(int))
    points = np.array(
        [[system.co_hair(object=obj, particle_no=int(n), step=int(s)) for s in taken] for n in numbers], np.float64
    ).reshape(len(numbers), len(taken), 3)
    inverse = np.linalg.pinv(np.array(obj.matrix_world, np.float64))
    points = points @ inverse[:3, :3].T + inverse[:3, 3]
    scale = settings.radius_scale / 2 * ((parents + children - first) / max(len(numbers), 1))
    along = (taken / (steps - 1)) ** _shape_power(settings.shape)
    radii = scale * (settings.root_radius + (settings.tip_radius - settings.root_radius) * along)
    if settings.use_close_tip:
        radii[-1] = 0
    uv, name = None, "UVMap"
    layers = obj.data.uv_layers if isinstance(obj.data, bpy.types.Mesh) else []
    for index, layer in enumerate(layers):
        if layer.active_render and parents:
            name = layer.name
            uv = np.array(
                [
                    system.uv_on_emitter(
                        modifier, particle=system.particles[int(n) % parents], particle_no=int(n), uv_no=index
                    )
                    for n in numbers
                ],
                np.float32,
            ).reshape(-1, 2)
    return Strands(points, np.broadcast_to(radii, points.shape[:2]).astype(np.float64), uv, name)


def _shape_power(shape: float) -> float:
    """Exponent of a strand's radius along its length (Particle settings, Strand Shape): 1 is a cone."""
    return 1 + shape if shape < 0 else 1 / (1 - min(shape, 0.999))


def _tubes(strands: Strands, materials: list[str | None], slot: int, name: str, findings: Findings) -> LocalMesh | None:
    points, radii = strands.points, strands.radii
    total, steps = points.shape[:2]
    if total == 0 or steps < 2:
        return None
    kept = _thinned(total, BUDGET // (FLAT_SIDES * 2 * (steps - 1)))
    points, radii = points[kept], radii[kept] * (total / len(kept))
    sides = int(np.clip(ROUND_BUDGET // (len(kept) * 2 * (steps - 1)), FLAT_SIDES, MAX_SIDES))
    findings.add("approximated", "hair", _note("strands", total, len(kept), f"tubes of {sides} sides"), object=name)
    tangent = np.gradient(points, axis=1)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=2, keepdims=True), 1e-20)
    # One side direction per strand, made perpendicular at every point: no twist to speak of along a hair.
    mean = tangent.mean(1)
    helper = np.eye(3)[np.abs(mean).argmin(1)][:, None]
    side = np.cross(tangent, np.broadcast_to(helper, tangent.shape))
    side /= np.maximum(np.linalg.norm(side, axis=2, keepdims=True), 1e-20)
    other = np.cross(tangent, side)
    turn = np.random.default_rng(0).uniform(0, 2 * np.pi, (len(kept), 1, 1, 1))
    angles = turn + (2 * np.pi * np.arange(sides) / sides)[:, None]
    round_ = np.cos(angles) * side[:, :, None] + np.sin(angles) * other[:, :, None]
    # A convex outline's mean width is its perimeter / pi: a tube's corners lie a little outside of the strand.
    mean_width = math.pi / (sides * math.sin(math.pi / sides))
    rings = points[:, :, None] + round_ * (radii * mean_width)[..., None, None]
    k, s = np.arange(sides), np.arange(steps - 1)
    lower = s[:, None] * sides + k
    ahead = s[:, None] * sides + (k + 1) % sides
    faces = np.stack([lower, ahead, ahead + sides, lower, ahead + sides, lower + sides], axis=-1).reshape(-1)
    positions = rings.reshape(len(kept), -1, 3)[:, faces]
    if sides >= ROUND_SIDES:
        normals = round_.reshape(len(kept), -1, 3)[:, faces]
    else:
        flat = (round_ + np.roll(round_, -1, axis=2))[:, :-1].reshape(len(kept), -1, 3)
        normals = np.repeat(flat / np.linalg.norm(flat, axis=-1, keepdims=True), 6, axis=1)
    mesh = _local_mesh(positions, normals, materials, slot)
    mesh.strands = True
    if strands.uv is not None:
        mesh.uv_layers = {strands.uv_name: np.repeat(strands.uv[kept], len(faces), axis=0)}
        mesh.active_uv = strands.uv_name
    return mesh


def _local_mesh(positions: np.ndarray, normals: np.ndarray, materials: list[str | None], slot: int) -> LocalMesh:
    """Positions and normals of corners, [..., 3], as a mesh of one material."""
    corners = positions.reshape(-1, 3).astype(np.float32)
    index = np.full(len(corners) // 3, slot, np.int32)
    return LocalMesh(corners, normals.reshape(-1, 3).astype(np.float32), index, materials)


def _note(what: str, total: int, kept: int, shape: str) -> str:
    thinned = f"; {kept:,} of {total:,} kept, thicker, to stay within {BUDGET:,} triangles" if kept < total else ""
    return f"{total:,} {what} as {shape}{thinned}"


def _thinned(total: int, limit: int) -> np.ndarray:
    """Indices of at most ``limit`` of ``total`` items, evenly spread."""
    return np.arange(total) if total <= limit else np.linspace(0, total - 1, max(limit, 1)).round().astype(int)


def _attribute(data: bpy.types.ID, name: str, width: int) -> np.ndarray | None:
    """A float attribute [N, width] of a Curves or PointCloud data-block, float64; None when it has none."""
    attribute = data.attributes.get(name)
    if attribute is None:
        return None
    values = np.empty(len(attribute.data) * width, np.float32)
    attribute.data.foreach_get("value" if width == 1 else "vector", values)
    return values.reshape(-1, width).astype(np.float64)


def _octahedron() -> np.ndarray:
    """Corners [24, 3] of 8 triangles on the unit sphere, counter-clockwise seen from outside."""
    corners = []
    for x, y, z in np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).reshape(3, -1).T:
        triangle = [[x, 0, 0], [0, y, 0], [0, 0, z]]
        corners += triangle if x * y * z > 0 else triangle[::-1]
    return np.array(corners, np.float64)


def _icosahedron() -> np.ndarray:
    """Corners [60, 3] of 20 triangles on the unit sphere, counter-clockwise seen from outside."""
    golden = (1 + math.sqrt(5)) / 2
    vertices = []
    for a in (1, -1):
        for b in (golden, -golden):
            vertices += [[0, a, b], [a, b, 0], [b, 0, a]]
    points = np.array(vertices, np.float64) / math.hypot(1, golden)
    edge = min(float(np.linalg.norm(points[0] - p)) for p in points[1:]) * 1.01
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < edge
    corners = []
    for i in range(12):
        for j in range(i + 1, 12):
            for k in range(j + 1, 12):
                if near[i, j] and near[j, k] and near[i, k]:
                    a, b, c = points[i], points[j], points[k]
                    corners += [a, b, c] if np.dot(np.cross(b - a, c - a), a) > 0 else [a, c, b]
    return np.array(corners)

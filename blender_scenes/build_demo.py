"""Build the demo scene: a still life on a round plinth, everything procedural, nothing downloaded.

    python blender_scenes/build_demo.py demo.blend [--preview preview.png]

Runs with the ``bpy`` module. Every image (glaze, globe, terrazzo, orange peel, cloth, sky) is computed here
with numpy from fixed seeds and packed into the file, so that the .blend is self-contained and reproducible.
The light is one soft HDRI, so that a neural renderer can learn the scene from some 25 views.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

TABLE_TOP = 0.16
Rgb = tuple[float, float, float]


# ---------------------------------------------------------------- noise and images


def lattice_noise(points: np.ndarray, frequency: float, octaves: int, seed: int) -> np.ndarray:
    """Fractal value noise in [0, 1] at ``points`` [..., 3], trilinear with smoothstep, period 64."""
    total = np.zeros(points.shape[:-1])
    weight = 0.0
    for octave in range(octaves):
        lattice = np.random.default_rng(seed + octave).random((64, 64, 64))
        scaled = points * frequency * 2**octave + 17.3 * octave
        base = np.floor(scaled).astype(int)
        t = scaled - base
        t = t * t * (3 - 2 * t)
        value = np.zeros(points.shape[:-1])
        for dx in (0, 1):
            for dy in (0, 1):
                for dz in (0, 1):
                    corner = lattice[(base[..., 0] + dx) % 64, (base[..., 1] + dy) % 64, (base[..., 2] + dz) % 64]
                    share = np.ones(points.shape[:-1])
                    for axis, d in enumerate((dx, dy, dz)):
                        share = share * (t[..., axis] if d else 1 - t[..., axis])
                    value += corner * share
        total += value * 0.5**octave
        weight += 0.5**octave
    return total / weight


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Hermite step from 0 at ``low`` to 1 at ``high``."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def plain(height: int, width: int, colour: Rgb) -> np.ndarray:
    """An image of one colour, [H, W, 3]."""
    return np.broadcast_to(np.asarray(colour), (height, width, 3)).copy()


def mix(a: np.ndarray, b: np.ndarray | Rgb, t: np.ndarray) -> np.ndarray:
    """Blend colours [..., 3] by ``t`` [...]."""
    return a + (np.asarray(b) - a) * t[..., None]


def make_image(name: str, pixels: np.ndarray, *, data: bool = False, is_float: bool = False) -> bpy.types.Image:
    """Packed image from rows bottom first, [H, W, 3]; display-encoded for colour, linear for float."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=is_float, is_data=data)
    if is_float:
        image.colorspace_settings.name = "Linear Rec.709"
    rgba = np.ones((height, width, 4), dtype=np.float32)
    rgba[..., :3] = pixels
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    if not is_float:
        image.pack()
        return image
    return pack_half_float(image)


def pack_half_float(image: bpy.types.Image) -> bpy.types.Image:
    """Replace a float image by a half-float EXR of itself; Blender would pack four times the bytes."""
    name = image.name
    settings = bpy.context.scene.render.image_settings
    settings.file_format, settings.color_mode = "OPEN_EXR", "RGB"
    settings.color_depth, settings.exr_codec = "16", "PIZ"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.exr"
        image.save_render(str(path), scene=bpy.context.scene)
        bpy.data.images.remove(image)
        loaded = bpy.data.images.load(str(path))
        loaded.colorspace_settings.name = "Linear Rec.709"
        loaded.pack()
    loaded.name = name
    loaded.filepath_raw = f"//{name}.exr"
    settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGBA", "8"
    return loaded


def equirect_grid(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Longitude in [0, 2 pi) and latitude in (-pi/2, pi/2) of texel centres, rows bottom first."""
    u = (np.arange(width) + 0.5) / width
    v = (np.arange(height) + 0.5) / height
    return np.meshgrid(u * 2 * np.pi, (v - 0.5) * np.pi)


def globe_maps(width: int = 1024, height: int = 512) -> tuple[np.ndarray, np.ndarray]:
    """Colour and roughness of an invented planet: continents, shallows, deserts, ice caps."""
    lon, lat = equirect_grid(width, height)
    points = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    shape = lattice_noise(points, 1.6, 6, seed=41)
    detail = lattice_noise(points, 7.0, 4, seed=73)
    land = smoothstep(0.515, 0.525, shape)
    ocean = plain(height, width, (0.07, 0.27, 0.42))
    ocean = mix(ocean, (0.28, 0.60, 0.66), smoothstep(0.44, 0.515, shape))
    ground = plain(height, width, (0.80, 0.68, 0.44))
    ground = mix(ground, (0.42, 0.55, 0.30), smoothstep(0.40, 0.62, detail))
    ground = mix(ground, (0.55, 0.38, 0.26), smoothstep(0.56, 0.68, shape))
    colour = mix(ocean, ground, land)
    coast = np.exp(-(((shape - 0.518) / 0.0045) ** 2))
    colour = mix(colour, (0.16, 0.20, 0.24), 0.7 * coast)
    ice = smoothstep(1.20, 1.25, np.abs(lat) + 0.35 * (detail - 0.5))
    colour = mix(colour, (0.76, 0.83, 0.87), ice)
    grid = np.minimum(np.abs((lon * 12 / np.pi) % 2 - 1), np.abs((lat * 12 / np.pi) % 2 - 1))
    colour = mix(colour, (0.95, 0.90, 0.75), 0.22 * (1 - smoothstep(0.02, 0.06, grid)))
    roughness = 0.18 + 0.37 * np.maximum(land, ice)
    return colour, np.repeat(roughness[..., None], 3, axis=-1)


def glaze_map(width: int = 768, height: int = 768) -> np.ndarray:
    """Blue-and-white ceramic: petal rosettes between banded borders, periodic around the vase."""
    u = (np.arange(width) + 0.5) / width
    v = (np.arange(height) + 0.5) / height
    grid_u, grid_v = np.meshgrid(u, v)
    ink = np.zeros((height, width))
    columns, rows, low, high = 8, 3, 0.27, 0.80
    row = (grid_v - low) / (high - low) * rows
    shift = 0.5 * (np.floor(row) % 2)
    x = ((grid_u * columns + shift) % 1 - 0.5) * 2
    y = (row % 1 - 0.5) * 2
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    petals = 0.62 + 0.20 * np.cos(8 * angle)
    flower = smoothstep(0.03, -0.03, radius - petals) * smoothstep(0.16, 0.22, radius)
    flower *= 1 - 0.75 * smoothstep(0.05, -0.05, np.abs(radius - 0.42) - 0.04)
    ring = smoothstep(0.03, 0.0, np.abs(radius - 0.90) - 0.025)
    dots = smoothstep(0.03, -0.02, np.hypot(np.abs(x) - 1, np.abs(y) - 1) - 0.16)
    inside = ((grid_v > low) & (grid_v < high)).astype(float)
    ink = np.maximum(ink, inside * np.maximum.reduce([flower, ring, dots, smoothstep(0.05, 0, radius - 0.08)]))
    wave = 0.012 * np.sin(grid_u * 2 * np.pi * 24)
    for centre, half in ((0.245, 0.008), (0.825, 0.008), (0.12, 0.010), (0.93, 0.010)):
        ink = np.maximum(ink, smoothstep(0.002, -0.002, np.abs(grid_v - centre) - half))
    for centre in (0.185, 0.877):
        ink = np.maximum(ink, 0.85 * smoothstep(0.002, -0.002, np.abs(grid_v - centre - wave) - 0.012))
    ink = np.maximum(ink, smoothstep(0.095, 0.085, grid_v))
    tone = lattice_noise(np.stack([np.cos(grid_u * 2 * np.pi), np.sin(grid_u * 2 * np.pi), grid_v * 4], -1), 3, 2, 9)
    blue = mix(plain(height, width, (0.07, 0.17, 0.52)), (0.16, 0.34, 0.72), tone)
    white = plain(height, width, (0.93, 0.93, 0.89))
    return white * (1 - ink[..., None]) + blue * ink[..., None]


def terrazzo_map(size: int = 1024, chips: int = 520) -> np.ndarray:
    """Pale terrazzo: nearest-chip cells shrunk to islands in cement."""
    rng = np.random.default_rng(5)
    centres = rng.random((chips, 2))
    palette = np.array(
        [(0.70, 0.42, 0.30), (0.38, 0.46, 0.44), (0.86, 0.82, 0.74), (0.22, 0.25, 0.28), (0.52, 0.44, 0.36)]
    )
    colours = palette[rng.integers(0, len(palette), chips)] * rng.uniform(0.92, 1.05, (chips, 1))
    reach = rng.uniform(0.006, 0.022, chips)
    axis = (np.arange(size) + 0.5) / size
    grid = np.stack(np.meshgrid(axis, axis), axis=-1)
    image = plain(size, size, (0.74, 0.71, 0.66))
    angles = rng.uniform(0, np.pi, chips)
    stretch = rng.uniform(0.6, 1.0, chips)
    for centre, colour, r, angle, squeeze in zip(centres, colours, reach, angles, stretch, strict=True):
        span = int(np.ceil(r * size * 1.5)) + 2
        cx, cy = (centre * size).astype(int)
        ys = np.arange(cy - span, cy + span) % size
        xs = np.arange(cx - span, cx + span) % size
        window = grid[np.ix_(ys, xs)]
        delta = (window - centre + 0.5) % 1 - 0.5
        turned = delta @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        # A superellipse with a few facets reads as broken stone.
        theta = np.arctan2(turned[..., 1], turned[..., 0])
        facet = 1 + 0.16 * np.cos(5 * theta + 7 * angle) + 0.08 * np.cos(3 * theta)
        distance = np.hypot(turned[..., 0], turned[..., 1] / squeeze) / facet
        cover = smoothstep(r + 0.6 / size, r - 0.6 / size, distance)
        image[np.ix_(ys, xs)] = mix(image[np.ix_(ys, xs)], tuple(colour), cover)
    return image


def peel_normals(size: int = 256) -> np.ndarray:
    """Tangent-space normal map of orange peel: many smooth pits, tileable."""
    rng = np.random.default_rng(11)
    frequencies = np.fft.fftfreq(size) * size
    radius = np.hypot(*np.meshgrid(frequencies, frequencies))
    band = np.exp(-(((radius - 26) / 8) ** 2))
    height = np.fft.ifft2(np.fft.fft2(rng.standard_normal((size, size))) * band).real
    height = -(np.maximum(height / height.std(), 0.0) ** 1.5)
    dx = np.roll(height, -1, 1) - np.roll(height, 1, 1)
    dy = np.roll(height, -1, 0) - np.roll(height, 1, 0)
    normal = np.stack([-dx, -dy, np.full_like(dx, 1.6)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return normal * 0.5 + 0.5


def sky_map(width: int = 512, height: int = 256) -> np.ndarray:
    """Linear radiance of a soft studio sky: gradient, and three blurred soft boxes.

    Directions follow Blender's equirectangular map: u = 0.5 - atan2(y, x) / 2 pi.
    """
    u = (np.arange(width) + 0.5) / width
    v = (np.arange(height) + 0.5) / height
    grid_u, grid_v = np.meshgrid(u, v)
    azimuth = (0.5 - grid_u) * 2 * np.pi
    elevation = (grid_v - 0.5) * np.pi
    sky = plain(height, width, (0.62, 0.66, 0.74))
    sky = mix(sky, (0.34, 0.50, 0.80), smoothstep(0.0, 1.2, elevation))
    sky = mix(sky, (0.42, 0.37, 0.32), smoothstep(0.05, -0.35, elevation))
    sky *= 0.36
    boxes = [  # azimuth, elevation, half width, half height (degrees), radiance
        (-150.0, 42.0, 24.0, 17.0, (9.6, 8.5, 7.0)),
        (-25.0, 30.0, 11.0, 22.0, (2.6, 2.8, 3.1)),
        (75.0, 48.0, 20.0, 12.0, (2.4, 2.8, 3.5)),
    ]
    for centre, lift, half_width, half_height, radiance in boxes:
        turn = (azimuth - np.radians(centre) + np.pi) % (2 * np.pi) - np.pi
        x = np.abs(turn) * np.cos(elevation) / np.radians(half_width)
        y = np.abs(elevation - np.radians(lift)) / np.radians(half_height)
        inside = smoothstep(1.12, 0.88, x) * smoothstep(1.12, 0.88, y)
        sky = sky + inside[..., None] * np.array(radiance)
    return sky


# ---------------------------------------------------------------- meshes


def link(name: str, mesh: bpy.types.Mesh, material: bpy.types.Material) -> bpy.types.Object:
    """Add ``mesh`` to the scene as a smooth-shaded object with one material."""
    mesh.materials.clear()
    mesh.materials.append(material)
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), dtype=bool))
    mesh.set_sharp_from_angle(angle=np.radians(40.0))
    body = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(body)
    return body


def grid_mesh(name: str, points: np.ndarray, uv: np.ndarray, *, wrap_rows: bool) -> bpy.types.Mesh:
    """Mesh of quads from a grid of points [R, C, 3] that closes around its columns.

    uv is [R + wrap_rows, C + 1, 2]: the seam's corners have their own coordinates.
    Quads that collapse at a pole become triangles.
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
        for c in range(columns):
            ring = [(r, c), (r, c + 1), (r + 1, c + 1), (r + 1, c)]
            face: list[int] = []
            for i, j in ring:
                vertex = int(index[i % rows, j % columns])
                if vertex not in face:
                    face.append(vertex)
                    corners.append((float(uv[i, j, 0]), float(uv[i, j, 1])))
            faces.append(face)
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces)
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", np.asarray(corners, dtype=np.float32).ravel())
    mesh.validate()
    return mesh


def lathe(name: str, profile: Sequence[tuple[float, float]], segments: int = 96) -> bpy.types.Mesh:
    """Surface of revolution about Z; ``profile`` is (radius, height), outside on its right going up.

    u runs once around, v along the profile by arc length.
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
    uv = np.stack(np.meshgrid(np.linspace(0, 1, segments + 1), arc / arc[-1]), axis=-1)
    return grid_mesh(name, points, uv, wrap_rows=False)


def curve_profile(knots: Sequence[tuple[float, float]], per_span: int = 10) -> list[tuple[float, float]]:
    """Catmull-Rom curve through ``knots`` (radius, height)."""
    k = np.asarray(knots, dtype=float)
    k = np.vstack([2 * k[0] - k[1], k, 2 * k[-1] - k[-2]])
    out: list[tuple[float, float]] = []
    for i in range(1, len(k) - 2):
        for t in np.linspace(0, 1, per_span, endpoint=False):
            a, b, c, d = k[i - 1], k[i], k[i + 1], k[i + 2]
            p = 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
            out.append((max(float(p[0]), 0.0), float(p[1])))
    out.append((float(k[-2][0]), float(k[-2][1])))
    return out


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


def torus_knot(name: str, radius: float, tube: float, rows: int = 360, columns: int = 28) -> bpy.types.Mesh:
    """(2, 3) torus knot, tube swept with a rotation-minimising frame closed by an even twist."""
    t = np.linspace(0, 2 * np.pi, rows, endpoint=False)
    ring = 2 + np.cos(3 * t)
    path = radius / 3 * np.stack([ring * np.cos(2 * t), ring * np.sin(2 * t), 1.35 * np.sin(3 * t)], axis=-1)
    tangent = np.roll(path, -1, 0) - np.roll(path, 1, 0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frame = np.zeros_like(path)
    side = np.cross(tangent[0], (0, 0, 1.0))
    for i in range(rows):
        side = side - tangent[i] * (side @ tangent[i])
        side /= np.linalg.norm(side)
        frame[i] = side
    last = frame[-1] - tangent[0] * (frame[-1] @ tangent[0])
    gap = np.arctan2(np.cross(last, frame[0]) @ tangent[0], last @ frame[0])
    other = np.cross(tangent, frame)
    twist = gap * np.arange(rows) / rows
    around = np.linspace(0, 2 * np.pi, columns, endpoint=False)[None, :] + twist[:, None]
    points = path[:, None] + tube * (
        np.cos(around)[..., None] * frame[:, None] + np.sin(around)[..., None] * other[:, None]
    )
    uv = np.stack(np.meshgrid(np.linspace(0, 2, columns + 1), np.linspace(0, 24, rows + 1)), axis=-1)
    # Rows run along the tangent and columns turn positively about it: swap to keep the winding outward.
    points = points[:, ::-1]
    return grid_mesh(name, points, uv, wrap_rows=True)


def rounded_box(name: str, size: Rgb, material: bpy.types.Material, bevel: float = 0.02) -> bpy.types.Object:
    """Box standing on z = 0 with a bevel modifier (left live: the pipeline must evaluate it)."""
    x, y, z = size[0] / 2, size[1] / 2, size[2]
    vertices = [(sx * x, sy * y, h) for h in (0, z) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    faces = [(3, 2, 1, 0), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces)
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", np.tile([0, 0, 1, 0, 1, 1, 0, 1], 6).astype(np.float32))
    body = link(name, mesh, material)
    modifier: Any = body.modifiers.new("Bevel", "BEVEL")
    modifier.width, modifier.segments = bevel, 4
    modifier.harden_normals = True
    return body


# ---------------------------------------------------------------- materials


def material(name: str, colour: Rgb, **inputs: float) -> bpy.types.Material:
    """Principled material; ``colour`` linear, ``inputs`` by socket name with _ for a space."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    shader = made.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    made.diffuse_color = (*colour, 1.0)
    return made


def texture(made: bpy.types.Material, image: bpy.types.Image, socket: str) -> bpy.types.Node:
    """Connect an image to an input of the Principled shader."""
    nodes = made.node_tree.nodes
    node: Any = nodes.new("ShaderNodeTexImage")
    node.image = image
    made.node_tree.links.new(node.outputs["Color"], nodes["Principled BSDF"].inputs[socket])
    return node


def normal_texture(made: bpy.types.Material, image: bpy.types.Image, strength: float, repeat: float) -> None:
    """Connect a tangent-space normal map, repeated by a Mapping node."""
    nodes, links = made.node_tree.nodes, made.node_tree.links
    shader = nodes["Principled BSDF"]
    coordinates, mapping = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
    mapping.inputs["Scale"].default_value = (repeat, repeat / 2, 1)
    picture: Any = nodes.new("ShaderNodeTexImage")
    picture.image = image
    bend = nodes.new("ShaderNodeNormalMap")
    bend.inputs["Strength"].default_value = strength
    links.new(coordinates.outputs["UV"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], picture.inputs["Vector"])
    links.new(picture.outputs["Color"], bend.inputs["Color"])
    links.new(bend.outputs["Normal"], shader.inputs["Normal"])


# ---------------------------------------------------------------- the scene


def build_objects() -> None:
    """Plinth and still life, standing around the origin within a radius of 1.4."""
    terrazzo = material("Terrazzo", (0.7, 0.68, 0.62), Roughness=0.35)
    texture(terrazzo, make_image("terrazzo", terrazzo_map()), "Base Color")
    top = lathe("Plinth", rounded_disc(1.3, 0.0, TABLE_TOP, 0.035), 128)
    planar_uv(top, 0.5)
    link("Plinth", top, terrazzo)

    brass = material("Brass", (0.83, 0.56, 0.22), Metallic=1.0, Roughness=0.28)
    steel = material("Brushed steel", (0.62, 0.64, 0.66), Metallic=1.0, Roughness=0.42)

    glaze = material("Blue and white glaze", (0.85, 0.85, 0.82), Roughness=0.12)
    texture(glaze, make_image("glaze", glaze_map()), "Base Color")
    outer = [(0.0, 0.0), (0.17, 0.0), (0.19, 0.015), (0.185, 0.05), (0.27, 0.22), (0.385, 0.50), (0.37, 0.74)]
    outer += [(0.24, 0.94), (0.135, 1.06), (0.125, 1.14), (0.175, 1.235)]
    # A shallow well: deep white cavities cost many bounces and show little.
    lip = [(0.18, 1.25), (0.168, 1.256), (0.155, 1.24), (0.115, 1.17), (0.06, 1.13), (0.0, 1.12)]
    vase = link("Vase", lathe("Vase", curve_profile(outer[1:], 8)), glaze)
    vase.location = (-0.42, 0.45, TABLE_TOP)
    well = link(
        "Vase inside",
        lathe("Vase inside", [outer[-1], *curve_profile(lip, 6)], 96),
        material("White glaze", (0.84, 0.84, 0.80), Roughness=0.12),
    )
    well.location = vase.location

    colour, roughness = globe_maps()
    planet = material("Globe", (0.3, 0.4, 0.5), Roughness=0.3)
    texture(planet, make_image("globe", colour), "Base Color")
    texture(planet, make_image("globe roughness", roughness, data=True), "Roughness")
    globe = link("Globe", lathe("Globe", [(r, z - 0.34) for r, z in ball_profile(0.34)], 96), planet)
    globe.location = (0.55, 0.42, TABLE_TOP + 0.56)
    globe.rotation_euler = (np.radians(23.4), 0.0, np.radians(300))
    stand = [(0.0, 0.0), (0.25, 0.0), (0.26, 0.012), (0.255, 0.03), (0.12, 0.06), (0.05, 0.10), (0.045, 0.15)]
    stand += [(0.09, 0.19), (0.165, 0.235), (0.17, 0.25), (0.155, 0.255)]
    foot = link("Globe stand", lathe("Globe stand", curve_profile(stand, 6), 72), brass)
    foot.location = (0.55, 0.42, TABLE_TOP)

    lacquer = material("Red lacquer", (0.52, 0.018, 0.022), Roughness=0.08)
    pot = [(0.0, 0.0), (0.15, 0.0), (0.165, 0.012), (0.17, 0.03), (0.24, 0.10), (0.275, 0.20), (0.265, 0.275)]
    body = link("Lacquer pot", lathe("Lacquer pot", [*curve_profile(pot, 7), (0.0, 0.275)], 96), lacquer)
    body.location = (-0.02, -0.18, TABLE_TOP)
    lid = [
        (0.0, 0.278),
        (0.27, 0.278),
        (0.282, 0.285),
        (0.28, 0.30),
        (0.22, 0.345),
        (0.10, 0.375),
        (0.0, 0.38),
    ]
    cover = link("Lacquer lid", lathe("Lacquer lid", curve_profile(lid, 7), 96), lacquer)
    cover.location = body.location
    knob = link("Lid knob", lathe("Lid knob", ball_profile(0.052, 24), 48), brass)
    knob.location = (-0.02, -0.18, TABLE_TOP + 0.37)

    clay = material("Sage clay", (0.36, 0.44, 0.33), Roughness=0.9, Specular_IOR_Level=0.2)
    bpy.ops.mesh.primitive_monkey_add(size=0.70)
    monkey = bpy.context.object
    assert monkey is not None
    monkey.name, monkey.data.name = "Suzanne", "Suzanne"
    monkey.data.materials.append(clay)
    monkey.data.polygons.foreach_set("use_smooth", np.ones(len(monkey.data.polygons), dtype=bool))
    smooth: Any = monkey.modifiers.new("Subdivision", "SUBSURF")
    smooth.levels = smooth.render_levels = 2
    monkey.location = (-0.74, -0.27, TABLE_TOP + 0.341)
    monkey.rotation_euler = (np.radians(-36), 0.0, np.radians(20))
    cloths = [
        ("Book, ochre", (0.62, 0.34, 0.07), (0.60, 0.44, 0.09), 0.0, 14.0),
        ("Book, petrol", (0.03, 0.14, 0.17), (0.52, 0.40, 0.08), 0.09, -6.0),
    ]
    for name, tint, size, lift, turn in cloths:
        book = rounded_box(name, size, material(f"Cloth, {name}", tint, Roughness=0.8), 0.014)
        book.location = (-0.72, -0.34, TABLE_TOP + lift)
        book.rotation_euler = (0, 0, np.radians(turn))

    knot = link("Torus knot", torus_knot("Torus knot", 0.30, 0.062), steel)
    knot.location = (0.80, -0.30, TABLE_TOP + 0.325)
    knot.rotation_euler = (np.radians(78), 0.0, np.radians(38))

    glass = material("Glass", (0.96, 0.985, 0.98), Roughness=0.0, IOR=1.45, Transmission_Weight=1.0)
    ball = link("Glass ball", lathe("Glass ball", ball_profile(0.17), 96), glass)
    ball.location = (0.34, -0.78, TABLE_TOP)

    peel = material("Orange peel", (0.86, 0.29, 0.02), Roughness=0.42)
    normal_texture(peel, make_image("orange peel", peel_normals(), data=True), 0.6, 2.0)
    orange = link("Orange", lathe("Orange", [(r, 0.95 * z) for r, z in ball_profile(0.165)], 72), peel)
    orange.location = (-0.16, -0.85, TABLE_TOP)
    orange.rotation_euler = (np.radians(6), np.radians(-4), 0)


def build_light() -> None:
    """World: the soft studio sky, packed as a float image."""
    world = bpy.data.worlds.new("Studio sky")
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    environment: Any = nodes.new("ShaderNodeTexEnvironment")
    environment.image = make_image("studio sky", sky_map(), is_float=True)
    links.new(environment.outputs["Color"], nodes["Background"].inputs["Color"])
    bpy.context.scene.world = world


def build_camera() -> None:
    """Front view from the lower right, 50 mm, square."""
    scene = bpy.context.scene
    data = bpy.data.cameras.new("Camera")
    data.lens = 60
    camera = bpy.data.objects.new("Camera", data)
    scene.collection.objects.link(camera)
    camera.location = (1.35, -4.95, 2.35)
    aim = Vector((0.0, 0.0, 0.50)) - camera.location
    camera.rotation_euler = aim.to_track_quat("-Z", "Y").to_euler()
    scene.camera = camera


def configure(scene: bpy.types.Scene) -> None:
    """Cycles, square frame, plain sRGB display, transparent background."""
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 256
    scene.cycles.use_denoising = True
    scene.render.resolution_x = scene.render.resolution_y = 800
    scene.render.resolution_percentage = 100
    scene.render.film_transparent = True
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"


def main(arguments: Sequence[str]) -> None:
    """Build and save; ``--preview`` also renders a 400 x 400 picture over white."""
    parser = argparse.ArgumentParser(description="Build the demo scene")
    parser.add_argument("output", type=Path)
    parser.add_argument("--preview", type=Path)
    parser.add_argument("--samples", type=int, default=64)
    options = parser.parse_args(arguments)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build_objects()
    build_light()
    build_camera()
    configure(bpy.context.scene)
    bpy.context.preferences.filepaths.save_version = 0
    bpy.ops.wm.save_as_mainfile(filepath=str(options.output.resolve()), compress=True)
    if options.preview:
        scene = bpy.context.scene
        scene.render.resolution_percentage = 50
        scene.cycles.samples = options.samples
        scene.render.filepath = str(options.preview.resolve())
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])

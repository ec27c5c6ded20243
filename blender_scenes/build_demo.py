"""Build the demo scene: a still life on a round plinth, everything procedural, nothing downloaded.

    python blender_scenes/build_demo.py demo.blend [--preview preview.png]

Runs with the ``bpy`` module. Every image (glaze, globe, terrazzo, orange peel, cloth, sky) is computed here
with numpy from fixed seeds and packed into the file, so that the .blend is self-contained and reproducible.
The light is one soft HDRI, so that a neural renderer can learn the scene from some 25 views.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from building import camera, image_world, main, make_image, material, normal_picture, picture
from patterns import lattice_noise, mix, plain, smoothstep, studio_sky, texel_grid
from shapes import ball_profile, curve_profile, grid_mesh, lathe, link, planar_uv, rounded_box, rounded_disc

TABLE_TOP = 0.16


# ---------------------------------------------------------------- images


def equirect_grid(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Longitude in [0, 2 pi) and latitude in (-pi/2, pi/2) of texel centres, rows bottom first."""
    u, v = texel_grid(height, width)
    return u * 2 * np.pi, (v - 0.5) * np.pi


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


# ---------------------------------------------------------------- meshes


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


# ---------------------------------------------------------------- the scene


def build_objects() -> None:
    """Plinth and still life, standing around the origin within a radius of 1.4."""
    terrazzo = material("Terrazzo", (0.7, 0.68, 0.62), Roughness=0.35)
    picture(terrazzo, make_image("terrazzo", terrazzo_map()), "Base Color")
    top = lathe("Plinth", rounded_disc(1.3, 0.0, TABLE_TOP, 0.035), 128)
    planar_uv(top, 0.5)
    link("Plinth", top, terrazzo)

    brass = material("Brass", (0.83, 0.56, 0.22), Metallic=1.0, Roughness=0.28)
    steel = material("Brushed steel", (0.62, 0.64, 0.66), Metallic=1.0, Roughness=0.42)

    glaze = material("Blue and white glaze", (0.85, 0.85, 0.82), Roughness=0.12)
    picture(glaze, make_image("glaze", glaze_map()), "Base Color")
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
    picture(planet, make_image("globe", colour), "Base Color")
    picture(planet, make_image("globe roughness", roughness, data=True), "Roughness")
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
    normal_picture(peel, make_image("orange peel", peel_normals(), data=True), strength=0.6, repeat=(2.0, 1.0))
    orange = link("Orange", lathe("Orange", [(r, 0.95 * z) for r, z in ball_profile(0.165)], 72), peel)
    orange.location = (-0.16, -0.85, TABLE_TOP)
    orange.rotation_euler = (np.radians(6), np.radians(-4), 0)


def build() -> None:
    """Still life, light and camera."""
    build_objects()
    boxes = [  # the key light, a strip, a fill
        (-150.0, 42.0, 24.0, 17.0, (9.6, 8.5, 7.0)),
        (-25.0, 30.0, 11.0, 22.0, (2.6, 2.8, 3.1)),
        (75.0, 48.0, 20.0, 12.0, (2.4, 2.8, 3.5)),
    ]
    image_world("Studio sky", studio_sky(boxes, width=512))
    camera((1.35, -4.95, 2.35), (0.0, 0.0, 0.50), 60)


if __name__ == "__main__":
    main("demo", build)

"""Build `jewels`: a jeweller's table under small lamps; cut gems, gold, mirrors, lenses.

    python blender_scenes/build_jewels.py [out.blend]

Hard light: almost all of it arrives through caustics (small bulbs seen through glass) and long specular chains
(gems on a mirror tray, gold reflecting gold). Dark world. Flat-shaded dielectrics of several refractive indices.
"""

from __future__ import annotations

from itertools import pairwise

import bpy
import numpy as np
import shapes
from building import camera, flat_world, main, make_image, material, normal_picture, picture, point_light, principled
from gems import brilliant, emerald_cut, resting
from patterns import mix, normals_from_height, plain, smoothstep, spectral_noise, texel_grid, wood
from shapes import rounded_disc, spline
from solids import Shape, ball, box, grid, join, lathe, loop_spline, place, rotation, tube

# ---------------------------------------------------------------- goldsmith's work


def band(radius: float, wide: float, thick: float) -> Shape:
    """Finger ring about Z: flat inside, rounded outside."""
    half = wide / 2
    section = [(radius, -half), (radius + 0.4 * thick, -half)]
    section += [(radius + thick * (0.4 + 0.6 * np.cos(a)), half * np.sin(a)) for a in np.linspace(-1.3, 1.3, 9)]
    section += [(radius + 0.4 * thick, half), (radius, half), (radius, -half)]
    return lathe(section, 64, (6, 1))


def solitaire(radius: float, stone: float) -> tuple[Shape, Shape]:
    """Upright ring, standing on z = 0 with its axis along Y, and the stone that its prongs hold: (metal, stone)."""
    ring = band(radius, 0.055, 0.030).moved((0, 0, radius + 0.030), turn=rotation(0, 90.0))
    seat = 2 * (radius + 0.030) + 0.80 * stone
    metal = [
        ring,
        lathe(
            [(0.035, 0.0), (0.045, 0.012), (0.55 * stone, 0.52 * stone), (0.50 * stone, 0.56 * stone), (0.02, 0.01)], 24
        ).moved((0, 0, seat - 0.82 * stone)),
    ]
    for k in range(4):
        a = np.radians(90 * k + 45)
        knots = [(0.40, -0.40), (0.90, -0.12), (1.06, 0.04), (0.99, 0.15)]
        path = np.array([(r * stone * np.cos(a), r * stone * np.sin(a), seat + z * stone) for r, z in knots])
        metal.append(tube(spline(path, 3), 0.010, 8))
    return join(metal), brilliant(stone).moved((0, 0, seat))


def chain(path: np.ndarray, radius: float, thick: float) -> Shape:
    """Links along a path [N, 3], every other one turned a quarter about the path."""
    links = []
    for i, (a, b) in enumerate(pairwise(path)):
        along = (b - a) / np.linalg.norm(b - a)
        side = np.cross(along, (0, 0, 1.0))
        side /= np.linalg.norm(side)
        up = np.cross(side, along)
        lean = np.radians(35 if i % 2 else -55)
        other = np.cos(lean) * side + np.sin(lean) * up
        turn = np.stack([along, other, np.cross(along, other)], axis=1)
        oval = loop_spline(
            [(1.35 * radius * np.cos(t), 0.8 * radius * np.sin(t), 0) for t in np.arange(8) * np.pi / 4], 3
        )
        links.append(tube(oval, thick, 7, closed=True, repeats=(1, 3)).moved((a + b) / 2, turn=turn))
    return join(links)


def arc_points(path: np.ndarray, step: float) -> np.ndarray:
    """Points at equal distances along a polyline."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.arange(0, length[-1], step)
    return np.stack([np.interp(at, length, path[:, i]) for i in range(3)], axis=-1)


# ---------------------------------------------------------------- pictures


def leather(size: int = 512) -> tuple[np.ndarray, np.ndarray]:
    """Bottle-green desk leather with a gold-tooled border: colour [N, N, 3] and tileable height [N, N]."""
    u, v = texel_grid(size, size)
    grain = np.abs(spectral_noise(size, size, 71, slope=0.9, lowest=30))
    image = plain(size, size, (0.12, 0.27, 0.21)) * (1 + 0.10 * spectral_noise(size, size, 72, slope=1.6))[..., None]
    image = mix(image, (0.06, 0.15, 0.12), smoothstep(0.35, 0.0, grain) * 0.6)
    radius = np.hypot(u - 0.5, v - 0.5) * 2
    angle = np.arctan2(v - 0.5, u - 0.5)
    tooling = smoothstep(0.006, 0.003, np.abs(radius - 0.93)) + smoothstep(0.006, 0.003, np.abs(radius - 0.83))
    leaf = np.abs(radius - 0.88 - 0.025 * np.sin(40 * angle))
    tooling += smoothstep(0.007, 0.003, leaf)
    return np.clip(mix(image, (0.85, 0.68, 0.32), np.clip(tooling, 0, 1) * 0.9), 0, 1), grain


# ---------------------------------------------------------------- the scene


def gem(name: str, colour: tuple[float, float, float], ior: float) -> bpy.types.Material:
    """Clear coloured stone."""
    return material(name, colour, Roughness=0.0, IOR=ior, Transmission_Weight=1.0)


def build_table() -> None:
    """Round walnut table with an inlaid leather top at z = 0."""
    walnut = material("Walnut", (0.2, 0.1, 0.05), Roughness=0.22, Coat_Weight=0.6, Coat_Roughness=0.08)
    grain = wood(512, 512, 73, (0.16, 0.08, 0.045), (0.38, 0.22, 0.12))
    picture(walnut, make_image("walnut", grain, jpeg=92), "Base Color")
    rim = [
        (0.0, -0.10),
        (1.06, -0.10),
        (1.10, -0.08),
        (1.12, -0.04),
        (1.10, 0.0),
        (1.06, 0.012),
        (1.02, 0.008),
        (1.01, -0.004),
        (0.0, -0.004),
    ]
    table = shapes.lathe("Table", rim, 128)
    shapes.planar_uv(table, 0.5)
    shapes.link("Table", table, walnut)
    hide = material("Green leather", (0.05, 0.1, 0.07), Roughness=0.5)
    colour, height = leather()
    picture(hide, make_image("leather", colour, jpeg=93), "Base Color")
    bumps = normals_from_height(height, 0.8)
    normal_picture(hide, make_image("leather normal", bumps, data=True, jpeg=95), strength=0.5, repeat=(3.0, 3.0))
    turn = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    reach = np.linspace(1.015, 0, 9)
    top = np.stack([reach[:, None] * np.cos(turn), reach[:, None] * np.sin(turn), np.zeros((9, 96))], axis=-1)
    uv = np.concatenate([top, top[:, :1]], axis=1)[..., :2] / 2.03 + 0.5
    place("Leather top", grid(top, uv, wrap=True), hide)


def build_lamp(brass: bpy.types.Material) -> None:
    """Brass desk lamp whose bare bulb is a small, strong emitter."""
    foot = [*rounded_disc(0.17, 0.0, 0.045, 0.018)[:-1], (0.05, 0.055), (0.03, 0.09), (0.0, 0.09)]
    place("Lamp foot", lathe(foot, 64), brass, at=(-0.62, 0.50, 0.0))
    arm = np.array(
        [(-0.62, 0.50, 0.08), (-0.66, 0.53, 0.40), (-0.60, 0.49, 0.72), (-0.40, 0.32, 0.86), (-0.30, 0.23, 0.84)]
    )
    place("Lamp arm", tube(spline(arm, 8), 0.016, 12), brass)
    inside = [(0.0, 0.098), (0.055, 0.095), (0.165, -0.05)]
    outside = [(0.176, -0.05), (0.066, 0.108), (0.0, 0.112)]
    shade = lathe([*inside, *outside], 64)
    place("Lamp shade", shade, brass, at=(-0.30, 0.23, 0.76), turn=(-14.0, -16.0, 0.0), smooth=30.0)
    bulb = material("Bulb", (0.0, 0.0, 0.0), Emission_Strength=1000.0)
    principled(bulb).inputs["Emission Color"].default_value = (1.0, 0.78, 0.50, 1.0)
    place("Bulb", ball(0.032, 12, 20), bulb, at=(-0.30, 0.23, 0.77))


def build_stones() -> None:
    """Loose cut stones, each lying on a facet."""
    diamond = gem("Diamond", (1.0, 1.0, 1.0), 2.417)
    stones = [
        ("Ruby", brilliant(0.15), gem("Ruby", (0.90, 0.03, 0.07), 1.77), 40.75, 200, (-0.34, -0.36)),
        ("Emerald", emerald_cut(0.19, 0.14), gem("Emerald", (0.10, 0.80, 0.32), 1.58), 0.0, 30, (-0.02, -0.60)),
        ("Sapphire", brilliant(0.12, 1.35), gem("Sapphire", (0.07, 0.14, 0.85), 1.77), 180.0, 70, (-0.66, -0.10)),
        ("Amethyst", emerald_cut(0.11, 0.10), gem("Amethyst", (0.55, 0.18, 0.85), 1.55), 180.0, 10, (-0.62, -0.50)),
        ("Topaz", brilliant(0.115), gem("Topaz", (1.0, 0.62, 0.16), 1.62), 40.75, 20, (0.18, -0.30)),
    ]
    for name, shape, made, tilt, azimuth, (x, y) in stones:
        if name == "Emerald":  # on its pavilion it would stand on a point: leant on a tier
            tilt = 146.0
        place(name, resting(shape, tilt, azimuth), made, at=(x, y, 0), smooth=None)
    rng = np.random.default_rng(23)
    for i in range(9):
        angle, radius = 2 * np.pi * i / 9 + 0.3, 0.11 + 0.07 * (i % 3)
        size = float(rng.uniform(0.038, 0.062))
        shape = resting(brilliant(size), 180.0 if i % 4 == 0 else 40.75, float(rng.uniform(0, 360)))
        place(
            f"Diamond {i + 1}",
            shape,
            diamond,
            at=(-0.12 + radius * np.cos(angle), -0.08 + radius * np.sin(angle), 0),
            smooth=None,
        )


def build_tray(gold: bpy.types.Material, silver: bpy.types.Material) -> None:
    """Mirror tray with three rings and a flask."""
    at = (0.50, 0.10)
    tray = [
        (0.0, 0.0005),
        (0.40, 0.0005),
        (0.43, 0.008),
        (0.452, 0.037),
        (0.444, 0.041),
        (0.42, 0.016),
        (0.40, 0.010),
        (0.0, 0.010),
    ]
    place("Mirror tray", lathe(tray, 96), silver, at=(*at, 0))
    diamond = bpy.data.materials["Diamond"]
    rose = material("Rose gold", (0.93, 0.52, 0.38), Metallic=1.0, Roughness=0.08)
    for name, metal, stone, size, (x, y), turn in (
        ("Diamond ring", gold, diamond, 0.085, (-0.05, -0.17), 35.0),
        ("Ruby ring", rose, bpy.data.materials["Ruby"], 0.070, (0.22, 0.02), -50.0),
    ):
        body, jewel = solitaire(0.13, size)
        place(name, body, metal, at=(at[0] + x, at[1] + y, 0.011), turn=(0, 0, turn))
        place(f"{name}, stone", jewel, stone, at=(at[0] + x, at[1] + y, 0.011), turn=(0, 0, turn), smooth=None)
    place("Wedding band", band(0.115, 0.07, 0.022), gold, at=(at[0] - 0.22, at[1] + 0.06, 0.046))
    place(
        "Wedding band, leaning",
        band(0.105, 0.05, 0.020),
        rose,
        at=(at[0] - 0.205, at[1] + 0.075, 0.125),
        turn=(24, 12, 0),
    )
    glass = material("Flask glass", (0.72, 0.90, 1.0), Roughness=0.0, IOR=1.52, Transmission_Weight=1.0)
    flask = [
        (0.0, 0.0),
        (0.10, 0.0),
        (0.115, 0.02),
        (0.115, 0.15),
        (0.05, 0.23),
        (0.035, 0.235),
        (0.035, 0.27),
        (0.0, 0.27),
    ]
    place("Flask", lathe(flask, 8), glass, at=(at[0] + 0.06, at[1] + 0.20, 0.011), turn=(0, 0, 10), smooth=None)
    place("Stopper", brilliant(0.06).moved((0, 0, 0.33)), glass, at=(at[0] + 0.06, at[1] + 0.20, 0.011), smooth=None)
    place(
        "Stopper neck", lathe(rounded_disc(0.022, 0.271, 0.30, 0.006), 16), gold, at=(at[0] + 0.06, at[1] + 0.20, 0.011)
    )


def build_lens(brass: bpy.types.Material) -> None:
    """Loupe on a stand: a biconvex lens that throws the bulb's image on the leather; and a crystal ball."""
    glass = material("Optical glass", (1.0, 1.0, 1.0), Roughness=0.0, IOR=1.52, Transmission_Weight=1.0)
    radius, curve = 0.17, 0.34
    drop = np.sqrt(curve**2 - radius**2)
    angles = np.linspace(0, np.arcsin(radius / curve), 9)
    lower = [(curve * np.sin(a), drop - curve * np.cos(a)) for a in angles]
    upper = [(r, -z) for r, z in lower[::-1]]
    lens = lathe([*lower, *upper[1:]], 64)
    at, turn = (0.30, -0.62, 0.26), (18.0, 8.0, 0.0)
    place("Loupe lens", lens, glass, at=at, turn=turn, smooth=60.0)
    rim = [
        (radius - 0.004, -0.018),
        (radius + 0.016, -0.018),
        (radius + 0.020, 0.0),
        (radius + 0.016, 0.018),
        (radius - 0.004, 0.018),
        (radius - 0.004, -0.018),
    ]
    place("Loupe rim", lathe(rim, 64), brass, at=at, turn=turn)
    post = np.array([(0.56, -0.56, 0.012), (0.56, -0.57, 0.12), (0.545, -0.575, 0.21), (0.478, -0.607, 0.245)])
    place("Loupe post", tube(spline(post, 6), 0.012, 10), brass)
    place("Loupe foot", lathe(rounded_disc(0.085, 0.0, 0.022, 0.008), 40), brass, at=(0.56, -0.56, 0.0))
    place("Crystal ball", ball(0.13, 28, 56), glass, at=(-0.18, 0.52, 0.155))
    place(
        "Ball stand",
        lathe([(0.06, 0.0), (0.10, 0.0), (0.10, 0.012), (0.075, 0.045), (0.066, 0.045), (0.06, 0.0)], 40),
        brass,
        at=(-0.18, 0.52, 0.0),
    )


def build_strings(gold: bpy.types.Material) -> None:
    """Pearls (linked duplicates of one mesh) and a gold chain."""
    pearl = material("Pearl", (0.82, 0.76, 0.70), Roughness=0.28, Coat_Weight=0.7, Coat_Roughness=0.06)
    bead = ball(0.034, 14, 24)
    knots = [(-0.86, 0.22), (-0.62, 0.22), (-0.46, 0.05), (-0.52, -0.20), (-0.80, -0.28), (-0.90, -0.02), (-0.78, 0.10)]
    path = np.c_[spline(np.array(knots), 12), np.full(6 * 12 + 1, 0.035)]
    mesh: bpy.types.Mesh | None = None
    for i, at in enumerate(arc_points(path, 0.0685)):
        body = place(
            f"Pearl {i + 1}", mesh or bead, pearl, at=(float(at[0]), float(at[1]), 0.035), turn=(17.0 * i, 31.0 * i, 0)
        )
        mesh = body.data
    curve = [(0.86, -0.28), (0.72, -0.36), (0.66, -0.22), (0.78, -0.42), (0.90, -0.12), (0.80, -0.50), (0.66, -0.70)]
    lying = np.c_[spline(np.array(curve), 12), np.full(6 * 12 + 1, 0.02)]
    place("Gold chain", chain(arc_points(lying, 0.036), 0.021, 0.0055), gold)
    box_hinge = box((0.30, 0.22, 0.10), bevel=0.012, scale=3, at=(0, 0, 0.05))
    velvet = material("Velvet box", (0.10, 0.008, 0.02), Roughness=0.9, Sheen_Weight=0.8, Sheen_Roughness=0.3)
    place("Ring box", box_hinge, velvet, at=(0.16, 0.68, 0.0), turn=(0, 0, -12), smooth=None)
    body, jewel = solitaire(0.10, 0.075)
    place("Sapphire ring", body, gold, at=(0.16, 0.68, 0.06), turn=(0, 0, 20))
    place(
        "Sapphire ring, stone",
        jewel,
        bpy.data.materials["Sapphire"],
        at=(0.16, 0.68, 0.06),
        turn=(0, 0, 20),
        smooth=None,
    )


def build() -> None:
    """Table, lamp, stones, tray, lens, strings; two pin lights; a nearly dark room."""
    gold = material("Gold", (1.0, 0.73, 0.30), Metallic=1.0, Roughness=0.06)
    brass = material("Brass", (0.80, 0.56, 0.22), Metallic=1.0, Roughness=0.16)
    silver = material("Silver", (0.95, 0.94, 0.91), Metallic=1.0, Roughness=0.015)
    build_table()
    build_lamp(brass)
    build_stones()
    build_tray(gold, silver)
    build_lens(brass)
    build_strings(gold)
    point_light("Pin light, cool", (0.75, -0.85, 1.25), 34.0, 0.03, (0.80, 0.90, 1.0))
    point_light("Pin light, warm", (0.15, 0.95, 1.05), 16.0, 0.03, (1.0, 0.80, 0.58))
    flat_world((0.13, 0.145, 0.18), 1.0)
    # Cycles' defaults blur and clamp away most of a caustic.
    cycles = bpy.context.scene.cycles
    cycles.blur_glossy, cycles.sample_clamp_indirect = 0.0, 0.0
    cycles.max_bounces = cycles.glossy_bounces = cycles.transmission_bounces = 24
    camera((1.0, -2.9, 2.1), (0.0, -0.02, 0.12), lens=52)


if __name__ == "__main__":
    main("jewels", build)

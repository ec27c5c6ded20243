"""Build `microphone`: a studio microphone in a shock mount on a desk stand; thin wires, a woven grille, a cable.

    python blender_scenes/build_microphone.py [out.blend]

Exercises: geometry thinner than a pixel (wires, cords, a grille that one sees through), brushed and polished metal,
a Bezier curve with bevel (the cable), images on colour, roughness and normals, a printed badge, a sun and a sky.
"""

from __future__ import annotations

import bpy
import numpy as np
import shapes
from building import camera, image_world, main, make_image, material, normal_picture, picture, sun_light
from mathutils import Matrix, Vector
from patterns import mix, normals_from_height, plain, smoothstep, spectral_noise, studio_sky, texel_grid, wood
from shapes import grid_uv, rounded_disc, spline
from solids import Shape, ball, box, grid, join, lathe, loop_spline, place, rotation, tube

TOP = 0.08  # of the desk disc
HEAD = (0.0, -0.04, 1.02)  # centre of the microphone
TILT = 14.0  # degrees, towards the speaker
BODY = 0.17  # radius


# ---------------------------------------------------------------- pictures


def brushed(size: int = 256) -> np.ndarray:
    """Roughness of turned metal: rings along u, [N, N]."""
    return np.clip(0.30 + 0.07 * spectral_noise(size, size, 51, slope=0.5, stretch=20.0).T, 0.05, 1)


def wrinkle(size: int = 256) -> np.ndarray:
    """Height of wrinkle paint, tileable."""
    noise = spectral_noise(size, size, 52, slope=0.9, lowest=18)
    return np.abs(noise)


def badge(size: int = 128) -> np.ndarray:
    """A red enamel badge with a cream sound wave, [N, N, 3]."""
    u, v = texel_grid(size, size)
    x, y = u * 2 - 1, v * 2 - 1
    image = plain(size, size, (0.55, 0.07, 0.08))
    wave = np.abs(y - 0.42 * np.sin(7.5 * x) * np.exp(-3.2 * x**2))
    image = mix(image, (0.96, 0.90, 0.76), smoothstep(0.09, 0.06, wave))
    return mix(image, (0.80, 0.66, 0.36), smoothstep(0.86, 0.90, np.maximum(np.abs(x), np.abs(y))))


def felt(size: int = 128) -> np.ndarray:
    """Grey felt, [N, N, 3]."""
    tone = 0.20 + 0.035 * spectral_noise(size, size, 53, slope=0.6)
    return np.stack([tone * 1.0, tone * 1.02, tone * 1.08], axis=-1)


# ---------------------------------------------------------------- parts


def woven(profile: np.ndarray, wires: int, turn: float, thick: float, steps: int = 44, sides: int = 5) -> Shape:
    """Diamond weave over a surface of revolution: two families of helical wires over and under one another.

    ``profile`` [N, 2] is (radius, height) by arc length; ``turn`` the angle in radians that a wire goes round.
    """
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    s = np.linspace(0, arc[-1], steps)
    radius, height = np.interp(s, arc, profile[:, 0]), np.interp(s, arc, profile[:, 1])
    slope_r, slope_z = np.gradient(radius, s), np.gradient(height, s)
    normal_r, normal_z = slope_z, -slope_r
    parts = []
    for sign in (1, -1):
        for k in range(wires):
            angle = 2 * np.pi * k / wires + sign * turn * s / s[-1]
            # Wires of the other family are met every turn / wires; up at one crossing, down at the next.
            lift = sign * thick * np.cos(wires * turn * s / s[-1])
            r, z = radius + normal_r * lift, height + normal_z * lift
            path = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)
            parts.append(tube(path, thick, sides, capped=False, repeats=(1, 8)))
    return join(parts)


def ring(radius: float, thick: float, height: float, segments: int = 48, sides: int = 10) -> Shape:
    """Torus about Z."""
    knots = [(radius * np.cos(a), radius * np.sin(a), height) for a in np.arange(8) * np.pi / 4]
    return tube(loop_spline(knots, segments // 8), thick, sides, closed=True, repeats=(1, 24))


def cords(inner: float, outer: float, low: float, high: float, count: int) -> Shape:
    """Elastic cords zigzag between an inner and an outer ring."""
    parts = []
    for k in range(count):
        a, b = 2 * np.pi * k / count, 2 * np.pi * (k + 0.5) / count
        for start, end in (
            ((outer, low, a), (inner, high, b)),
            ((inner, high, b), (outer, low, a + 4 * np.pi / (2 * count))),
        ):
            ends = np.array([[r * np.cos(t), r * np.sin(t), z] for r, z, t in (start, end)])
            parts.append(tube(np.linspace(ends[0], ends[1], 3), 0.0055, 6, repeats=(1, 6)))
    return join(parts)


def knurled(radius: float, low: float, high: float, ridges: int = 24) -> Shape:
    """Knob with ridges along Z."""
    turn = np.linspace(0, 2 * np.pi, ridges * 2, endpoint=False)
    reach = radius * (1 - 0.07 * (np.arange(ridges * 2) % 2))
    rings = []
    for scale, z in ((0.0, low), (0.86, low), (1.0, low + 0.012), (1.0, high - 0.012), (0.86, high), (0.0, high)):
        rings.append(
            np.stack([scale * reach * np.cos(turn), scale * reach * np.sin(turn), np.full(len(turn), z)], axis=-1)
        )
    return grid(np.array(rings), grid_uv(6, ridges * 2 + 1, 4, 1), wrap=True)


# ---------------------------------------------------------------- the scene


def build_microphone(metals: dict[str, bpy.types.Material]) -> None:
    """Body, grille, capsule and shock mount, tilted about the head's centre."""
    head = Matrix.Translation(HEAD) @ Matrix.Rotation(np.radians(TILT), 4, "X")

    def add(name: str, shape: Shape, made: bpy.types.Material, **options: float | None) -> None:
        place(name, shape, made, **options).matrix_world = head

    outline = [(0.0, -0.46), (0.060, -0.46), (0.075, -0.45), (0.09, -0.40), (BODY - 0.012, -0.34), (BODY, -0.32)]
    add("Body", lathe([*outline, (BODY, 0.02), (BODY - 0.02, 0.03), (0.0, 0.03)], 64, (2, 2)), metals["nickel"])
    for name, z in (("Collar, lower", -0.30), ("Collar, upper", 0.03)):
        shape = lathe(
            [(BODY - 0.01, z - 0.018), (BODY + 0.008, z - 0.012), (BODY + 0.008, z + 0.012), (BODY - 0.01, z + 0.018)],
            64,
        )
        add(name, shape, metals["gold"])
    knots = np.array([(0.162, 0.04), (0.176, 0.12), (0.178, 0.24), (0.165, 0.34), (0.125, 0.41), (0.060, 0.445)])
    profile = spline(knots, 8)
    add("Grille", woven(profile, 44, 1.15, 0.0032), metals["chrome"])
    add("Grille band", ring(0.1805, 0.009, 0.20, 64), metals["chrome"])
    add(
        "Grille button",
        lathe([(0.0, 0.430), (0.066, 0.432), (0.070, 0.440), (0.060, 0.450), (0.0, 0.456)], 40),
        metals["chrome"],
    )
    bars = []
    for k in range(4):
        turned = rotation(2, 90.0 * k + 45)
        path = np.c_[profile[:, 0] + 0.002, np.zeros(len(profile)), profile[:, 1]] @ turned.T
        bars.append(tube(path, 0.007, 8, repeats=(1, 8)))
    add("Grille ribs", join(bars), metals["chrome"])

    # The capsule: a gold membrane in a black ring, on a small post.
    upright = rotation(0, 90.0)
    membrane = lathe(rounded_disc(0.095, -0.012, 0.012, 0.006), 48).moved((0, 0, 0.25), turn=upright)
    add("Membrane", membrane, metals["gold"])
    rim = [(0.095, -0.03), (0.115, -0.03), (0.12, -0.02), (0.12, 0.02), (0.115, 0.03), (0.095, 0.03)]
    add("Capsule rim", lathe(rim, 48).moved((0, 0, 0.25), turn=upright), metals["black"])
    add("Capsule post", tube(np.array([[0, 0, 0.03], [0, 0, 0.10], [0, 0, 0.14]]), 0.022, 12), metals["black"])

    # Two rings hold the body by cords.
    outer = join([ring(0.30, 0.014, z, 64) for z in (-0.28, -0.04)])
    posts = [
        tube(np.array([[0.30 * np.cos(a), 0.30 * np.sin(a), z] for z in (-0.28, -0.16, -0.04)]), 0.010, 8)
        for a in np.radians((0, 90, 180, 270))
    ]
    add("Shock mount", join([outer, *posts]), metals["black"])
    add("Inner clamps", join([ring(BODY + 0.012, 0.010, z, 48) for z in (-0.22, -0.10)]), metals["black"])
    lower = cords(BODY + 0.02, 0.295, -0.28, -0.22, 8)
    add("Cords", join([lower, cords(BODY + 0.02, 0.295, -0.04, -0.10, 8)]), metals["cord"])

    # Badge, screwed to the body's front, bent round it.
    s, t = np.meshgrid(np.linspace(-0.35, 0.35, 9), np.linspace(-0.155, -0.075, 2))
    reach = BODY + 0.004
    front = np.stack([reach * np.sin(s), -reach * np.cos(s), t - 0.075], axis=-1)
    add("Badge", grid(front, grid_uv(2, 9)), metals["badge"])
    switch = [
        box((0.018, 0.02, 0.05), bevel=0.003, at=(0, -BODY, -0.02)),
        ball(0.012, 8, 12).moved((0.0, -BODY - 0.008, -0.012)),
    ]
    add("Switch", join(switch), metals["black"])

    plug = [
        (0.0, -0.66),
        (0.030, -0.66),
        (0.036, -0.64),
        (0.040, -0.56),
        (0.052, -0.55),
        (0.052, -0.47),
        (0.044, -0.455),
        (0.0, -0.455),
    ]
    add("Plug", lathe(plug, 32), metals["nickel"])


def build_stand(metals: dict[str, bpy.types.Material]) -> None:
    """Weighted base, chrome column, hinge and a bracket that reaches the shock mount."""
    base = [*rounded_disc(0.46, 0.0, 0.075, 0.028)[:-1], (0.10, 0.090), (0.085, 0.12), (0.0, 0.12)]
    place("Base", lathe(base, 96, (6, 2)), metals["wrinkle"], at=(0, 0.30, TOP))
    place(
        "Base felt",
        lathe([(0.40, -0.001), (0.47, -0.001), (0.47, 0.004), (0.40, 0.004)], 64),
        metals["black"],
        at=(0, 0.30, TOP),
    )
    knots = [(0, 0.30, TOP + 0.10), (0, 0.31, 0.42), (0, 0.335, 0.62), (0, 0.335, 0.78)]
    place("Column", tube(spline(np.array(knots), 10), 0.026, 20, repeats=(2, 6)), metals["chrome"])
    place("Column collar", lathe(rounded_disc(0.040, 0.0, 0.07, 0.010), 32), metals["black"], at=(0, 0.305, 0.30))
    arm = [(0, 0.335, 0.76), (0, 0.33, 0.85), (0, 0.285, 0.92), (0, 0.25, 0.95)]
    place("Bracket", tube(spline(np.array(arm), 8), 0.020, 14), metals["chrome"])
    for name, side in (("Hinge knob, left", -1), ("Hinge knob, right", 1)):
        shape = knurled(0.055, 0.0, 0.06).moved(turn=rotation(1, 90.0 * side))
        place(name, shape, metals["black"], at=(0.024 * side, 0.335, 0.78), smooth=None)
    place("Hinge", ball(0.045, 16, 24), metals["chrome"], at=(0, 0.335, 0.78))


def build_cable(made: bpy.types.Material) -> None:
    """Cable from the plug down to the desk, round the base and away: a Bezier curve with a bevel, left live."""
    head = Matrix.Translation(HEAD) @ Matrix.Rotation(np.radians(TILT), 4, "X")
    plug, on = head @ Vector((0, 0, -0.64)), TOP + 0.018
    below = head @ Vector((0, 0, -0.76))
    points = [
        tuple(plug),
        tuple(below),
        (0.06, -0.10, 0.19),
        (0.24, -0.22, on + 0.012),
        (0.52, -0.10, on),
        (0.66, 0.24, on),
    ]
    points += [
        (0.52, 0.62, on),
        (0.10, 0.87, on),
        (-0.40, 0.72, on),
        (-0.70, 0.34, on),
        (-0.70, -0.06, on),
        (-0.48, -0.30, on),
    ]
    points += [
        (-0.30, -0.46, on),
        (-0.42, -0.66, on),
        (-0.62, -0.56, on),
        (-0.52, -0.36, on + 0.034),
        (-0.33, -0.34, on + 0.036),
    ]
    points += [(-0.14, -0.52, on), (0.10, -0.72, on), (0.38, -0.78, on), (0.62, -0.62, on)]
    data = bpy.data.curves.new("Cable", "CURVE")
    data.dimensions, data.bevel_depth, data.bevel_resolution, data.resolution_u = "3D", 0.018, 2, 6
    data.use_fill_caps = True
    line = data.splines.new("BEZIER")
    line.bezier_points.add(len(points) - 1)
    for knot, place_ in zip(line.bezier_points, points, strict=True):
        knot.co = place_
        knot.handle_left_type = knot.handle_right_type = "AUTO"
    data.materials.append(made)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Cable", data))


def build() -> None:
    """Microphone, stand and cable on a walnut disc."""
    turned = make_image("brushed", brushed(), data=True)
    metals = {
        "nickel": material("Satin nickel", (0.58, 0.56, 0.53), Metallic=1.0),
        "chrome": material("Chrome", (0.80, 0.80, 0.81), Metallic=1.0, Roughness=0.10),
        "gold": material("Gold plate", (0.95, 0.68, 0.30), Metallic=1.0, Roughness=0.2),
        "black": material("Black nylon", (0.018, 0.018, 0.02), Roughness=0.4),
        "cord": material("Elastic cord", (0.42, 0.035, 0.03), Roughness=0.8),
        "wrinkle": material("Wrinkle paint", (0.035, 0.036, 0.04), Roughness=0.45),
        "badge": material("Enamel badge", (0.5, 0.1, 0.1), Roughness=0.12),
    }
    picture(metals["nickel"], turned, "Roughness")
    bumps = normals_from_height(wrinkle(), 1.2)
    normal_picture(metals["wrinkle"], make_image("wrinkle normal", bumps, data=True), strength=0.8)
    picture(metals["badge"], make_image("badge", badge()), "Base Color")
    desk = material("Walnut", (0.2, 0.1, 0.05), Roughness=0.32)
    walnut = make_image("walnut", wood(512, 512, 9, (0.20, 0.105, 0.055), (0.43, 0.26, 0.15)), jpeg=92)
    picture(desk, walnut, "Base Color")
    top = shapes.lathe("Desk", rounded_disc(1.05, 0.0, TOP, 0.03), 96)
    shapes.planar_uv(top, 0.55)
    shapes.link("Desk", top, desk)
    build_microphone(metals)
    build_stand(metals)
    build_cable(material("Cable rubber", (0.022, 0.022, 0.025), Roughness=0.55))
    boxes = [
        (-130.0, 38.0, 16.0, 22.0, (6.0, 5.6, 5.0)),
        (-15.0, 22.0, 7.0, 26.0, (4.0, 4.4, 5.2)),
        (95.0, 40.0, 14.0, 14.0, (2.0, 2.3, 2.8)),
    ]
    image_world("Studio sky", studio_sky(boxes, strength=0.34), 0.8)
    sun_light("Window", (0.55, 0.75, -0.8), 2.0, 4.0, (1.0, 0.93, 0.82))
    camera((1.3, -3.6, 2.0), (0.0, 0.0, 0.66), lens=52)


if __name__ == "__main__":
    main("microphone", build)

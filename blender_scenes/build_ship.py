"""Build `ship`: a three-masted ship in a round basin of water that one sees into.

    python blender_scenes/build_ship.py [out.blend]

Exercises: a refractive surface with waves, absorption inside (a homogeneous volume in a dielectric), opaque bodies
half in and half out of it, thin rigging, sails as single sheets seen from both sides, image textures throughout.
"""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from building import camera, image_world, main, make_image, material, node, normal_picture, picture, wire
from patterns import lattice_noise, normals_from_height, smoothstep, studio_sky, wood
from shapes import grid_uv
from ship_hull import LENGTH, deck_height, half_beam, hull, keel, sheer
from ship_images import hull_planks, marble, sailcloth, sand, stern_gallery
from solids import Shape, ball, box, grid, join, lathe, place, tube

FLOOR = -0.34  # of the basin
BASIN = 1.22  # inner radius


# ---------------------------------------------------------------- masts, sails, rigging

MASTS = ((0.40, 1.02, 0.92), (-0.04, 1.20, 1.0), (-0.47, 0.90, 0.72))  # x, height, size of its sails


def spar(start: Sequence[float], end: Sequence[float], thick: float, tip: float) -> Shape:
    """Round pole that tapers from ``thick`` to ``tip``."""
    path = np.linspace(start, end, 7)
    return tube(path, np.linspace(thick, tip, 7), 10, repeats=(1, 6))


def yard(x: float, z: float, length: float) -> Shape:
    """Horizontal pole across the ship, thickest in the middle."""
    y = np.linspace(-length, length, 9)
    path = np.stack([np.full(9, x), y, np.full(9, z)], axis=-1)
    return tube(path, 0.011 * (1 - 0.55 * np.abs(y / length)), 8, repeats=(1, 6))


def sail(x: float, low: float, high: float, bottom: float, top: float, belly: float) -> Shape:
    """Square sail filled by wind from astern; half widths at foot and head."""
    s, t = np.meshgrid(np.linspace(-1, 1, 17), np.linspace(0, 1, 13))
    width = bottom + (top - bottom) * t
    depth = belly * (1 - 0.72 * s**2) * np.sin(np.pi * (0.12 + 0.80 * (1 - t))) + 0.012
    foot = 0.045 * (1 - s**2) * (1 - t) ** 2
    return grid(np.stack([x + depth, width * s, low + (high - low) * t + foot], axis=-1), grid_uv(13, 17))


def staysail(corners: np.ndarray, belly: float) -> Shape:
    """Three-cornered sail between tack, clew and head [3, 3], bellied to port."""
    s, t = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 11))
    tack, clew, head = corners
    points = (1 - t)[..., None] * ((1 - s)[..., None] * tack + s[..., None] * clew) + t[..., None] * head
    points[..., 1] += belly * np.sin(np.pi * s) * np.sin(np.pi * np.sqrt(t)) * (1 - t)
    return grid(points, grid_uv(11, 9))


def build_rig(made: dict[str, bpy.types.Material]) -> None:
    """Masts with yards, sails, tops, shrouds with ratlines, stays and flags."""
    poles, lines, tops = [], [], []
    for k, (x, height, size) in enumerate(MASTS):
        deck = float(deck_height(np.array(x / LENGTH)))
        poles.append(spar((x, 0, deck - 0.05), (x - 0.01, 0, height * 0.62), 0.020, 0.016))
        poles.append(spar((x + 0.012, 0, height * 0.56), (x + 0.004, 0, height + 0.16), 0.013, 0.005))
        tops.append(
            lathe(
                [(0.014, -0.02), (0.055, 0.0), (0.060, 0.022), (0.054, 0.022), (0.050, 0.004), (0.014, 0.004)], 20
            ).moved((x, 0, height * 0.60))
        )
        levels = [0.28, 0.60, 0.86, 1.04] if k < 2 else [0.34, 0.62, 0.88, 1.06]
        for i in range(3):
            low, high = height * levels[i] + 0.02, height * levels[i + 1] - 0.02
            half = [0.33, 0.27, 0.19, 0.12]
            poles.append(yard(x + 0.018, high, (half[i + 1] + 0.03) * size))
            if i == 0:
                poles.append(yard(x + 0.018, low - 0.01, (half[0] + 0.02) * size))
            cloth = sail(x + 0.022, low, high, half[i] * size, half[i + 1] * size, (0.12, 0.095, 0.06)[i] * size)
            place(f"Sail {k + 1}.{i + 1}", cloth, made["emblem" if (k, i) == (1, 0) else "canvas"], smooth=60.0)
        rail = float(sheer(np.array(x / LENGTH)))
        for side in (-1, 1):
            feet = [
                np.array([x - 0.10 + 0.033 * j, side * float(half_beam(np.array((x - 0.05) / LENGTH))) * 0.9, rail])
                for j in range(5)
            ]
            head = np.array([x, side * 0.02, height * 0.60])
            lines += [tube(np.linspace(foot, head, 2 + 1), 0.0028, 5, capped=False, repeats=(1, 12)) for foot in feet]
            for step in np.linspace(0.08, 0.82, 11):
                ends = [foot + (head - foot) * step for foot in (feet[0], feet[-1])]
                lines.append(tube(np.linspace(ends[0], ends[1], 3), 0.0018, 4, capped=False))
            lines.append(
                tube(np.linspace((x - 0.18, feet[0][1], rail), (x, 0, height + 0.02), 3), 0.0022, 5, capped=False)
            )
        flag(f"Pennant {k + 1}", (x + 0.004, 0, height + 0.15), made["flag"])
    bow = (LENGTH + 0.02, 0, 0.22)
    tip = (LENGTH + 0.46, 0, 0.40)
    poles.append(spar(bow, tip, 0.016, 0.006))
    stays = [
        ((0.40, 0, 1.10), tip), ((0.40, 0, 0.62), (1.0, 0, 0.30)), ((-0.04, 0, 1.25), (0.40, 0, 0.66)),
        ((-0.04, 0, 0.72), (0.38, 0, 0.24)), ((-0.47, 0, 0.98), (-0.04, 0, 0.66)), ((-0.47, 0, 0.86), (-0.84, 0, 0.42)),
    ]  # fmt: skip
    lines += [tube(np.linspace(a, b, 3), 0.0026, 5, capped=False, repeats=(1, 20)) for a, b in stays]
    jibs = [
        np.array([(1.20, 0, 0.40), (0.66, 0.03, 0.36), (0.50, 0, 0.98)]),
        np.array([(0.98, 0, 0.31), (0.56, 0.03, 0.29), (0.46, 0, 0.60)]),
    ]
    for i, corners in enumerate(jibs):
        place(f"Jib {i + 1}", staysail(corners, 0.07), made["canvas"], smooth=60.0)
    gaff, boom = (-0.78, 0.02, 0.60), (-0.86, 0.03, 0.37)
    poles += [spar((-0.49, 0, 0.50), gaff, 0.008, 0.005), spar((-0.49, 0, 0.36), boom, 0.009, 0.006)]
    s, t = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9))
    corners = [np.array(c) for c in ((-0.50, 0, 0.375), (-0.84, 0.03, 0.385), (-0.50, 0, 0.49), (-0.76, 0.02, 0.59))]
    spanker = (1 - t)[..., None] * ((1 - s)[..., None] * corners[0] + s[..., None] * corners[1])
    spanker += t[..., None] * ((1 - s)[..., None] * corners[2] + s[..., None] * corners[3])
    spanker[..., 1] += 0.05 * np.sin(np.pi * s) * np.sin(np.pi * t)
    place("Spanker", grid(spanker, grid_uv(9, 9)), made["canvas"], smooth=60.0)
    place("Masts and yards", join(poles), made["spar"])
    place("Rigging", join(lines), made["rope"])
    place("Tops", join(tops), made["deck"])


def flag(name: str, at: tuple[float, float, float], made: bpy.types.Material) -> None:
    """Swallow-tailed pennant, blowing ahead as the sails do."""
    s, t = np.meshgrid(np.linspace(0, 1, 13), np.linspace(-1, 1, 5))
    height = 0.035 * (1 - 0.5 * s) + 0.02 * s * np.abs(t)
    points = np.stack(
        [0.17 * s * (1 - 0.25 * s * (1 - np.abs(t))), 0.02 * np.sin(7 * s), height * t - 0.01 * s], axis=-1
    )
    place(name, grid(points, grid_uv(5, 13)), made, at=at, smooth=60.0)


def build_fittings(made: dict[str, bpy.types.Material]) -> None:
    """Hatches, cabin fronts, capstan, boat, lanterns, guns, rudder and a figurehead."""
    wood_parts, gold, iron = [], [], []
    waist = float(deck_height(np.array(0.15)))
    wood_parts.append(box((0.12, 0.11, 0.022), bevel=0.004, scale=3, at=(0.16, 0, waist + 0.008)))
    wood_parts.append(box((0.09, 0.09, 0.020), bevel=0.004, scale=3, at=(-0.20, 0, waist + 0.004)))
    wood_parts.append(
        lathe(
            [(0.0, 0.0), (0.028, 0.0), (0.018, 0.02), (0.018, 0.04), (0.03, 0.045), (0.03, 0.055), (0.0, 0.058)], 16
        ).moved((0.02, 0, waist))
    )
    stern = float(deck_height(np.array(-0.9)))
    wood_parts.append(
        box((0.13, 0.16, 0.05), bevel=0.006, scale=3, at=(-0.62, 0, float(deck_height(np.array(-0.8))) + 0.0))
    )
    wood_parts.append(box((0.05, 0.012, 0.30), bevel=0.003, scale=3, at=(-LENGTH - 0.024, 0, -0.02)))
    for y in (-0.085, 0.0, 0.085):
        gold.append(
            lathe([(0.0, 0.0), (0.012, 0.004), (0.016, 0.03), (0.010, 0.05), (0.0, 0.06)], 12).moved(
                (-LENGTH - 0.015, y, stern + 0.055)
            )
        )
    gold.append(ball(0.026, 10, 14).moved((LENGTH + 0.115, 0, 0.185)))
    gold.append(
        tube(
            np.array([(LENGTH + 0.03, 0, 0.10), (LENGTH + 0.07, 0, 0.14), (LENGTH + 0.105, 0, 0.17)]),
            np.array([0.02, 0.022, 0.016]),
            10,
        )
    )
    for u in (np.arange(15) + 0.5) / 15:
        t = 2 * u - 1
        if not 0.13 < u < 0.87:
            continue
        beam, top, low = float(half_beam(np.array(t))), float(sheer(np.array(t))), float(keel(np.array(t)))
        w = 0.692
        z = low + (top - low) * w**1.35
        y = beam * np.sin(w * np.pi / 2) ** 0.75
        for side in (-1, 1):
            path = np.array(
                [
                    (LENGTH * t, side * (y - 0.02), z),
                    (LENGTH * t, side * (y + 0.012), z),
                    (LENGTH * t, side * (y + 0.026), z),
                ]
            )
            iron.append(tube(path, np.array([0.008, 0.0075, 0.009]), 8))
    place("Deck fittings", join(wood_parts), made["deck"])
    place("Gilding", join(gold), made["gold"])
    place("Guns", join(iron), made["iron"])


# ---------------------------------------------------------------- water and basin


def wave_height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Swell, ripples, and the wake behind the bow."""
    height = 0.014 * np.sin(5.1 * x + 2.2 * y) + 0.009 * np.sin(-7.3 * x + 6.4 * y + 1.0)
    height += 0.005 * np.sin(17 * x + 9 * y + 2.0) + 0.004 * np.sin(-11 * x + 21 * y) + 0.003 * np.sin(29 * x - 17 * y)
    behind = LENGTH - x
    spread = np.abs(np.abs(y) - 0.36 * behind)
    wake = np.exp(-((spread / 0.06) ** 2)) * smoothstep(0.0, 0.3, behind) * smoothstep(1.9, 0.8, behind)
    return height + 0.020 * wake * np.cos(26 * (behind - np.abs(y)))


def water() -> Shape:
    """Closed disc with waves on top; its rim and bottom stand inside the basin's wall and floor."""
    segments, reach = 144, BASIN + 0.03
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    rows = [(0.0, FLOOR - 0.03), (0.6, FLOOR - 0.03), (reach, FLOOR - 0.03)]
    rings = [np.stack([r * np.cos(turn), r * np.sin(turn), np.full(segments, z)], axis=-1) for r, z in rows]
    for r in np.linspace(reach, 0, 64):
        x, y = r * np.cos(turn), r * np.sin(turn)
        rings.append(np.stack([x, y, wave_height(x, y)], axis=-1))
    points = np.array(rings)
    uv = np.concatenate([points[..., :2], points[:, :1, :2]], axis=1) / (2 * reach) + 0.5
    return grid(points, uv, wrap=True)


def build_sea(made: dict[str, bpy.types.Material]) -> None:
    """Basin, sea bed with stones, water."""
    profile = [
        (0.0, FLOOR - 0.10),
        (1.14, FLOOR - 0.10),
        (1.27, FLOOR - 0.085),
        (1.30, -0.05),
        (1.345, 0.06),
        (1.33, 0.085),
    ]
    profile += [(1.26, 0.085), (BASIN, 0.07), (BASIN, -0.02), (BASIN, FLOOR - 0.001), (0.0, FLOOR - 0.001)]
    place("Basin", lathe(profile, 128, (3, 1)), made["marble"], smooth=50.0)
    rings = []
    turn = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    for r in np.linspace(BASIN + 0.01, 0, 28):
        points = np.stack([r * np.cos(turn), r * np.sin(turn), np.zeros(96)], axis=-1)
        points[:, 2] = FLOOR + 0.01 + 0.09 * (lattice_noise(points + 4.0, 2.2, 3, 5) - 0.35) * min(1.0, 3 * r + 0.3)
        rings.append(points)
    bed = np.array(rings)
    bed[-1] = bed[-1].mean(0)
    place(
        "Sea bed",
        grid(bed, np.concatenate([bed, bed[:, :1]], axis=1)[..., :2] * 0.6, wrap=True),
        made["sand"],
        smooth=60.0,
    )
    rng = np.random.default_rng(14)
    stones = []
    for _ in range(26):
        radius, angle, size = np.sqrt(rng.random()) * 1.1, rng.random() * 2 * np.pi, rng.uniform(0.025, 0.08)
        stone = ball(size, 10, 16)
        stone.points *= 0.75 + 0.5 * lattice_noise(stone.points / size * 0.6 + rng.random(3) * 9, 1.0, 2, 3)[:, None]
        stones.append(stone.moved((radius * np.cos(angle), radius * np.sin(angle), FLOOR + 0.02)))
    place("Stones", join(stones), made["stone"], smooth=60.0)
    place("Water", water(), made["water"], smooth=80.0)


def build_materials() -> dict[str, bpy.types.Material]:
    """All materials by a short name."""

    def textured(name: str, image: bpy.types.Image, roughness: float, **inputs: float) -> bpy.types.Material:
        made = material(name, (0.5, 0.5, 0.5), Roughness=roughness, **inputs)
        picture(made, image, "Base Color")
        return made

    planks = make_image("planks", wood(256, 256, 68, (0.36, 0.22, 0.12), (0.62, 0.44, 0.27), rings=8.0), jpeg=92)
    colour, ripple = sand()
    made = {
        "hull": textured("Painted hull", make_image("hull", hull_planks(), jpeg=93), 0.45),
        "rail": material("Red rail", (0.22, 0.02, 0.016), Roughness=0.4),
        "deck": textured("Deck planks", planks, 0.6),
        "stern": textured("Stern gallery", make_image("stern", stern_gallery(), jpeg=93), 0.3),
        "canvas": textured("Canvas", make_image("canvas", sailcloth(False), jpeg=92), 0.9, Specular_IOR_Level=0.2),
        "emblem": textured(
            "Canvas with emblem", make_image("emblem", sailcloth(True), jpeg=92), 0.9, Specular_IOR_Level=0.2
        ),
        "flag": material("Pennants", (0.60, 0.03, 0.03), Roughness=0.8),
        "spar": textured("Spars", planks, 0.4),
        "rope": material("Tarred rope", (0.055, 0.042, 0.032), Roughness=0.8),
        "gold": material("Gilding", (0.95, 0.68, 0.26), Metallic=1.0, Roughness=0.25),
        "iron": material("Gun iron", (0.06, 0.06, 0.065), Metallic=1.0, Roughness=0.4),
        "marble": textured("Marble", make_image("marble", marble(), jpeg=92), 0.15),
        "sand": textured("Sand", make_image("sand", colour, jpeg=90), 0.9, Specular_IOR_Level=0.1),
        "stone": material("Stones", (0.14, 0.15, 0.15), Roughness=0.6),
        "water": material("Sea water", (1.0, 1.0, 1.0), Roughness=0.0, IOR=1.33, Transmission_Weight=1.0),
    }
    bumps = normals_from_height(ripple, 2.0)
    normal_picture(made["sand"], make_image("sand normal", bumps, data=True), strength=0.6)
    absorb = node(made["water"], "VolumeAbsorption", inputs={"Color": (0.10, 0.72, 0.78, 1.0), "Density": 1.5})
    output = next(n for n in made["water"].node_tree.nodes if n.type == "OUTPUT_MATERIAL")
    wire(made["water"], absorb.outputs["Volume"], output.inputs["Volume"])
    return made


def build() -> None:
    """Ship, sea and sky."""
    made = build_materials()
    place("Hull", hull(), made["hull"], made["rail"], made["deck"], made["stern"], smooth=35.0)
    build_rig(made)
    build_fittings(made)
    build_sea(made)
    boxes = [
        (-65.0, 46.0, 20.0, 16.0, (10.0, 9.0, 7.4)),
        (150.0, 30.0, 16.0, 16.0, (1.8, 2.2, 3.0)),
        (40.0, 20.0, 10.0, 10.0, (3.2, 2.6, 2.0)),
    ]
    image_world("Sea sky", studio_sky(boxes, zenith=(0.30, 0.48, 0.85), horizon=(0.72, 0.72, 0.74), strength=0.5), 0.85)
    camera((2.9, -3.6, 1.9), (0.0, 0.0, 0.36), lens=52)


if __name__ == "__main__":
    main("ship", build)

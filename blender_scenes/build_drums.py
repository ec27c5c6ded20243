"""Build ``drums.blend``: a drum kit on a round riser.

    python blender_scenes/build_drums.py [OUT.blend] [--preview PREVIEW.png]

Lathe-grooved bronze, hammered steel, chrome, sparkle wraps under a clear coat, coated skins with stick marks, a
printed front skin, and many parts that share a mesh. Lit by one HDRI with strip lights, which metal needs.
"""

from __future__ import annotations

import bpy
import numpy as np
from bpy.types import Material, Object
from building import camera, image_world, main, make_image, material, normal_picture, picture
from drums_images import bronze, front_skin, grooves, hammered, skin, sparkle
from patterns import (
    planks,
    studio_sky,
    wood,
)
from shapes import (
    Rgb,
    box_mesh,
    circle,
    curve_profile,
    lathe,
    link,
    place,
    planar_uv,
    rounded_disc,
    spline,
    sweep,
)

RISER = 0.06  # its top


# ---------------------------------------------------------------- materials


class Finishes:
    """The kit's materials."""

    def __init__(self) -> None:
        self.wrap = material("Red sparkle", (0.4, 0.02, 0.03), Roughness=0.45, Coat_Weight=1.0, Coat_Roughness=0.03)
        picture(self.wrap, make_image("sparkle", sparkle(), jpeg=92), "Base Color", repeat=(3.0, 1.0))
        self.chrome = material("Chrome", (0.72, 0.73, 0.75), Metallic=1.0, Roughness=0.07)
        self.steel = material("Hammered steel", (0.60, 0.60, 0.62), Metallic=1.0, Roughness=0.18)
        normal_picture(self.steel, make_image("hammered", hammered(), data=True), strength=0.8, repeat=(5.0, 1.0))
        self.bronze = material("Cymbal bronze", (0.8, 0.6, 0.3), Metallic=1.0, Roughness=0.28)
        picture(self.bronze, make_image("bronze", bronze(), jpeg=90), "Base Color")
        normal_picture(self.bronze, make_image("grooves", grooves(), data=True))
        self.skin = material("Coated skin", (0.8, 0.8, 0.78), Roughness=0.6)
        picture(self.skin, make_image("skin", skin(384, 1, 1.0), jpeg=88), "Base Color")
        self.front = material("Front skin", (0.9, 0.86, 0.75), Roughness=0.25)
        picture(self.front, make_image("front skin", front_skin(), jpeg=90), "Base Color")
        self.rubber = material("Rubber", (0.012, 0.012, 0.013), Roughness=0.65)
        self.leather = material("Black leather", (0.018, 0.016, 0.016), Roughness=0.38)
        self.hickory = material("Hickory", (0.62, 0.40, 0.19), Roughness=0.4)
        grain = make_image("maple", wood(512, 512, 9, (0.42, 0.26, 0.14), (0.74, 0.54, 0.33), 5), jpeg=85)
        picture(self.hickory, grain, "Base Color")
        self.riser = material("Maple riser", (0.6, 0.4, 0.2), Roughness=0.32, Coat_Weight=0.4, Coat_Roughness=0.12)
        boards = planks(512, 19, (0.38, 0.24, 0.13), (0.70, 0.51, 0.32))
        picture(self.riser, make_image("boards", boards, jpeg=87), "Base Color")


# ---------------------------------------------------------------- parts


def group(name: str, parts: list[Object], location: Rgb, rotation: Rgb = (0.0, 0.0, 0.0)) -> None:
    """Hang ``parts`` (built about the origin) on one empty; rotation in degrees."""
    holder = bpy.data.objects.new(name, None)
    bpy.context.scene.collection.objects.link(holder)
    for part in parts:
        part.parent = holder
    holder.location, holder.rotation_euler = location, tuple(np.radians(rotation))


def disc_uv(mesh: bpy.types.Mesh, radius: float) -> None:
    """UVs by projection along Z, the disc of ``radius`` filling the unit square."""
    for loop, corner in zip(mesh.loops, mesh.uv_layers[0].data, strict=True):
        x, y, _ = mesh.vertices[loop.vertex_index].co
        corner.uv = (0.5 + 0.5 * x / radius, 0.5 + 0.5 * y / radius)


def drum(
    name: str,
    radius: float,
    depth: float,
    lugs: int,
    shell: Material,
    top: Material,
    bottom: Material,
    finish: Finishes,
) -> list[Object]:
    """Shell, two skins, two hoops, lugs and rods, along +Z from the origin."""
    wall = lathe(f"{name} shell", [(radius, 0.0), (radius, depth * 0.5), (radius, depth)], 56)
    parts = [link(f"{name} shell", wall, shell)]
    for word, made, turned in (("top skin", top, False), ("bottom skin", bottom, True)):
        crown = [
            (radius * 1.005, -0.004),
            (radius * 0.985, 0.004),
            (radius * 0.93, 0.003),
            (radius * 0.5, 0.003),
            (0.0, 0.003),
        ]
        mesh = lathe(f"{name} {word}", crown, 56)
        disc_uv(mesh, radius)
        part = link(f"{name} {word}", mesh, made)
        part.location.z = 0.0 if turned else depth
        part.rotation_euler.x = np.pi if turned else 0.0
        parts.append(part)
    section = [(0.002, -0.016), (0.009, -0.016), (0.009, -0.012), (0.005, -0.010), (0.005, 0.008), (0.008, 0.011)]
    section += [(0.006, 0.015), (0.001, 0.014), (0.001, -0.006), (0.002, -0.016)]
    hoop = lathe(f"{name} hoop", [(radius + 0.003 + r, z) for r, z in section], 56)
    upper = link(f"{name} hoop, upper", hoop, finish.chrome)
    lower = place(f"{name} hoop, lower", hoop)
    upper.location.z, lower.rotation_euler.x = depth, np.pi
    parts += [upper, lower]
    rod = lathe(f"{name} rod", [(0.0, -0.012), (0.004, -0.012), (0.004, depth + 0.012), (0.0, depth + 0.012)], 10)
    body = [(0.0, 0.0), (0.011, 0.002), (0.013, 0.012), (0.009, 0.022), (0.009, 0.05), (0.013, 0.06), (0.011, 0.07)]
    lug = lathe(f"{name} lug", curve_profile([*body, (0.0, 0.072)], 2), 10)
    for mesh, made, reach, height in (
        (rod, finish.chrome, 0.0075, 0.0),
        (lug, finish.chrome, 0.004, depth / 2 - 0.036),
    ):
        mesh.materials.append(made)
        mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), dtype=bool))
        for k in range(lugs):
            turn = 2 * np.pi * (k + 0.5) / lugs
            part = place(f"{mesh.name} {k + 1}", mesh)
            part.location = ((radius + reach) * np.cos(turn), (radius + reach) * np.sin(turn), height)
            parts.append(part)
    return parts


def cymbal(name: str, radius: float, finish: Finishes) -> Object:
    """Bell and bow with a thin rim, centred on its hole."""
    top = [
        (radius, -0.034),
        (radius * 0.7, -0.014),
        (radius * 0.36, 0.0),
        (radius * 0.26, 0.006),
        (radius * 0.2, 0.022),
    ]
    top += [(radius * 0.1, 0.034), (0.006, 0.036)]
    upper = curve_profile(top, 4)
    lower = [(r, z - 0.003) for r, z in upper[::-1]]
    return link(name, lathe(name, [*lower, *upper], 64), finish.bronze)


def tripod(name: str, height: float, finish: Finishes, spread: float = 0.2) -> list[Object]:
    """Chrome stand on three rubber feet, along +Z."""
    tube = [(0.0, 0.08), (0.013, 0.08), (0.013, 0.5 * height), (0.018, 0.5 * height), (0.018, 0.5 * height + 0.05)]
    tube += [(0.009, 0.5 * height + 0.05), (0.009, height), (0.0, height)]
    parts = [link(f"{name} tube", lathe(f"{name} tube", tube, 24), finish.chrome)]
    knots = np.array([(0.014, 0.0, 0.34), (0.5 * spread, 0.0, 0.18), (spread, 0.0, 0.015)])
    leg = sweep(f"{name} leg", spline(knots, 6), circle(0.008, 10))
    brace = sweep(f"{name} brace", np.linspace((0.013, 0, 0.10), (0.56 * spread, 0, 0.16), 4), circle(0.006, 8))
    foot = lathe(
        f"{name} foot", curve_profile([(0.0, 0.0), (0.014, 0.002), (0.016, 0.016), (0.009, 0.03), (0.0, 0.032)], 3), 14
    )
    for mesh, made in ((leg, finish.chrome), (brace, finish.chrome), (foot, finish.rubber)):
        mesh.materials.append(made)
        mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), dtype=bool))
        for k in range(3):
            part = place(f"{mesh.name} {k + 1}", mesh)
            turn = 2 * np.pi * k / 3 + 0.4
            part.rotation_euler.z = turn
            if mesh is foot:
                part.location = (spread * np.cos(turn), spread * np.sin(turn), 0.0)
            parts.append(part)
    return parts


def rod(name: str, start: Rgb, end: Rgb, radius: float, made: Material) -> Object:
    """Straight round bar."""
    return link(name, sweep(name, np.linspace(start, end, 3), circle(radius, 12), up=(0.3, 0.9, 0.1)), made)


def stick(name: str, location: Rgb, rotation: Rgb, mesh: bpy.types.Mesh) -> None:
    """One drumstick; rotation in degrees."""
    part = place(name, mesh)
    part.location, part.rotation_euler = location, tuple(np.radians(rotation))


# ---------------------------------------------------------------- the scene


def build_drums(finish: Finishes) -> None:
    """Kick, two rack toms, floor tom and snare. The drummer looks along -Y."""
    kick = drum("Kick", 0.29, 0.38, 10, finish.wrap, finish.skin, finish.front, finish)
    # The far end of its axis looks at the drummer, the printed one at the audience.
    group("Kick drum", kick, (0.0, -0.34, RISER + 0.305), (-90, 0, 0))
    for side in (-1, 1):
        word = "left" if side < 0 else "right"
        start, end = (0.27 * side, -0.26, RISER + 0.18), (0.40 * side, -0.33, RISER + 0.006)
        rod(f"Kick spur, {word}", start, end, 0.008, finish.chrome)
    for word, x, radius in (("left", -0.175, 0.15), ("right", 0.165, 0.135)):
        name = f"Tom, {word}"
        parts = drum(name, radius, 0.19, 6, finish.wrap, finish.skin, finish.skin, finish)
        group(name, parts, (x, -0.23, RISER + 0.66), (-22, 4 if x < 0 else -4, 0))
        rod(f"{name} arm", (0.35 * x, -0.17, RISER + 0.58), (0.5 * x, -0.20, RISER + 0.78), 0.010, finish.chrome)
    rod("Tom post", (0.0, -0.17, RISER + 0.58), (0.0, -0.17, RISER + 0.78), 0.013, finish.chrome)
    floor = drum("Floor tom", 0.20, 0.32, 8, finish.wrap, finish.skin, finish.skin, finish)
    for k in range(3):
        turn = 2 * np.pi * k / 3 + 0.3
        x, y = 0.218 * np.cos(turn), 0.218 * np.sin(turn)
        floor.append(rod(f"Floor tom leg {k + 1}", (x, y, 0.16), (x, y, -0.15), 0.007, finish.chrome))
    group("Floor tom", floor, (-0.52, 0.16, RISER + 0.155), (-3, 2, 0))
    snare = drum("Snare", 0.175, 0.13, 10, finish.steel, finish.skin, finish.skin, finish)
    group("Snare drum", snare, (0.38, 0.20, RISER + 0.47), (-4, -3, 0))
    group("Snare stand", tripod("Snare stand", 0.47, finish), (0.38, 0.205, RISER))


def build_hardware(finish: Finishes) -> None:
    """Cymbals on stands, throne, sticks."""
    places = [  # name, radius, x, y, height, tilts
        ("Crash", 0.22, 0.50, -0.22, 1.02, (-14, -14)),
        ("Ride", 0.27, -0.50, -0.20, 0.93, (-16, 12)),
    ]
    for name, radius, x, y, height, tilt in places:
        group(f"{name} stand", tripod(f"{name} stand", height, finish, 0.24), (x, y, RISER))
        group(name, [cymbal(f"{name} cymbal", radius, finish)], (x, y, RISER + height - 0.025), (*tilt, 0))
        knob = lathe(
            f"{name} wing nut", curve_profile([(0.0, 0.0), (0.012, 0.004), (0.012, 0.02), (0.0, 0.026)], 4), 16
        )
        link(f"{name} wing nut", knob, finish.chrome).location = (x, y, RISER + height)
    group("Hi-hat stand", tripod("Hi-hat stand", 0.86, finish), (0.70, 0.22, RISER))
    lower = cymbal("Hi-hat, lower", 0.175, finish)
    upper = place("Hi-hat, upper", lower.data)
    group("Hi-hat", [lower, upper], (0.70, 0.22, RISER + 0.74), (-3, 4, 0))
    lower.rotation_euler.x, upper.location.z = np.pi, 0.072
    seat = [(0.0, 0.0), (0.15, 0.0), (0.175, 0.02), (0.178, 0.06), (0.15, 0.085), (0.0, 0.092)]
    throne = link("Throne seat", lathe("Throne seat", curve_profile(seat, 5), 48), finish.leather)
    throne.location = (0.02, 0.68, RISER + 0.46)
    group("Throne stand", tripod("Throne stand", 0.47, finish, 0.22), (0.02, 0.68, RISER))
    outline = [(0.0, 0.0), (0.0072, 0.004), (0.0075, 0.1), (0.0072, 0.28), (0.004, 0.375), (0.0035, 0.383)]
    outline += [(0.0058, 0.392), (0.0048, 0.401), (0.0, 0.404)]
    mesh = lathe("Drumstick", curve_profile(outline, 4), 16)
    mesh.materials.append(finish.hickory)
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), dtype=bool))
    stick("Drumstick, left", (0.24, 0.34, RISER + 0.627), (90, 0, 70), mesh)
    stick("Drumstick, right", (0.31, 0.36, RISER + 0.629), (90, 0, 28), mesh)
    board = link("Kick pedal", box_mesh("Kick pedal", (0.09, 0.26, 0.012), metric=4.0), finish.steel, smooth=False)
    board.location, board.rotation_euler = (0.0, 0.24, RISER + 0.03), (np.radians(9), 0, 0)
    rod("Kick beater", (0.0, 0.13, RISER + 0.06), (0.0, 0.07, RISER + 0.30), 0.006, finish.chrome)
    felt = link("Beater felt", lathe("Beater felt", rounded_disc(0.032, -0.02, 0.02, 0.008), 24), finish.leather)
    felt.location, felt.rotation_euler = (0.0, 0.07, RISER + 0.30), (np.radians(90), 0, 0)


def build() -> None:
    """Kit and riser around the origin."""
    finish = Finishes()
    build_drums(finish)
    build_hardware(finish)
    stage = lathe("Riser", rounded_disc(0.99, 0.0, RISER, 0.012), 96)
    planar_uv(stage, 1.0)
    link("Riser", stage, finish.riser)
    boxes = [(-120.0, 50.0, 14.0, 24.0, (9.5, 8.6, 7.4)), (-50.0, 25.0, 7.0, 30.0, (4.0, 4.2, 4.6))]
    boxes += [(60.0, 35.0, 8.0, 32.0, (3.0, 3.4, 4.2)), (150.0, 40.0, 18.0, 12.0, (3.2, 3.0, 2.8))]
    image_world("Strip lights", studio_sky(boxes, zenith=(0.30, 0.38, 0.52), strength=0.30))
    camera((1.2, -3.4, 1.65), (0.0, 0.0, 0.48), 60)


if __name__ == "__main__":
    main("drums", build)

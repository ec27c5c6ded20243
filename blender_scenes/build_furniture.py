"""Build ``furniture.blend``: an upholstered armchair with a pillow and a throw, a leather pouf, a round rug.

    python blender_scenes/build_furniture.py [OUT.blend] [--preview PREVIEW.png]

Diffuse and woven image textures with tangent-space normal maps and sheen, planed wood, and procedural leather
(Noise and Voronoi through ColorRamp and Bump), lit by one soft HDRI.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from building import (
    camera,
    image_world,
    main,
    make_image,
    material,
    node,
    normal_picture,
    picture,
    principled,
    ramp,
    wire,
)
from furniture_images import damask, kilim, knit, rug
from patterns import normals_from_height, studio_sky, weave, wood
from shapes import (
    circle,
    curve_profile,
    cushion,
    grid_mesh,
    grid_uv,
    lathe,
    link,
    place,
    planar_uv,
    rounded_box,
    rounded_disc,
    rounded_rectangle,
    spline,
    sweep,
)

FLOOR = 0.022  # top of the rug


# ---------------------------------------------------------------- materials


def cloth(
    name: str, image: bpy.types.Image, bumps: bpy.types.Image, repeat: float, threads: float
) -> bpy.types.Material:
    """Woven cloth: a pattern every 1/``repeat`` units, its threads in a finer normal map, a little sheen."""
    made = material(name, (0.5, 0.5, 0.5), Roughness=0.92, Specular_IOR_Level=0.15, Sheen_Weight=0.25)
    picture(made, image, "Base Color", repeat=(repeat, repeat))
    normal_picture(made, bumps, strength=0.7, repeat=(threads, threads))
    return made


def leather() -> bpy.types.Material:
    """Saddle leather, all procedural: blotched colour, pebbled bump, worn roughness."""
    made = material("Leather", (0.25, 0.08, 0.03), Specular_IOR_Level=0.4)
    shader = principled(made)
    where = node(made, "TexCoord").outputs["Object"]
    blotches = node(made, "TexNoise", inputs={"Scale": 6.0, "Detail": 5.0, "Roughness": 0.6})
    wire(made, where, blotches.inputs["Vector"])
    stops = [(0.34, (0.09, 0.022, 0.008)), (0.55, (0.24, 0.072, 0.022)), (0.72, (0.36, 0.13, 0.045))]
    tone = ramp(made, blotches.outputs["Fac"], stops)
    wire(made, tone.outputs["Color"], shader.inputs["Base Color"])
    worn = node(made, "MapRange", inputs={"From Min": 0.35, "From Max": 0.7, "To Min": 0.55, "To Max": 0.3})
    wire(made, blotches.outputs["Fac"], worn.inputs["Value"])
    wire(made, worn.outputs["Result"], shader.inputs["Roughness"])
    pebbles = node(made, "TexVoronoi", inputs={"Scale": 55.0})
    wire(made, where, pebbles.inputs["Vector"])
    bump = node(made, "Bump", inputs={"Strength": 0.35, "Distance": 0.004})
    wire(made, pebbles.outputs["Distance"], bump.inputs["Height"])
    wire(made, bump.outputs["Normal"], shader.inputs["Normal"])
    return made


# ---------------------------------------------------------------- the scene


def build_chair(oak: bpy.types.Material, cover: bpy.types.Material) -> list[bpy.types.Object]:
    """Frame of turned and bent wood, seat and back upholstered; faces -Y."""
    parts: list[bpy.types.Object] = []
    leg = [(0.0, 0.0), (0.016, 0.0), (0.020, 0.02), (0.017, 0.05), (0.027, 0.20), (0.024, 0.27), (0.031, 0.285)]
    leg += [(0.024, 0.30), (0.033, 0.33), (0.033, 0.42), (0.022, 0.445), (0.018, 0.50), (0.025, 0.56)]
    leg += [(0.017, 0.62), (0.021, 0.66), (0.0, 0.672)]
    front = lathe("Front leg", curve_profile(leg, 4), 28, turns=1.0, rise=1.6)
    left = link("Front leg, left", front, oak)
    right = place("Front leg, right", front)
    parts += [left, right]
    for part, x in ((left, -0.315), (right, 0.315)):
        part.location = (x, -0.275, 0.0)

    bar = rounded_rectangle(0.046, 0.052, 0.014)
    for side, word in ((-1, "left"), (1, "right")):
        knots = [(0.30, 0.42, 0.0), (0.295, 0.33, 0.22), (0.29, 0.30, 0.43), (0.285, 0.345, 0.78), (0.262, 0.46, 1.13)]
        path = spline(np.array(knots) * (side, 1, 1), 7)
        parts.append(link(f"Back post, {word}", sweep(f"Back post, {word}", path, bar, up=(0, 1, 0), metric=1.6), oak))
        knots = [(0.285, 0.35, 0.735), (0.315, 0.12, 0.715), (0.335, -0.16, 0.69), (0.33, -0.31, 0.685)]
        path = spline(np.array([*knots, (0.325, -0.365, 0.655)]) * (side, 1, 1), 6)
        arm = sweep(f"Arm, {word}", path, rounded_rectangle(0.062, 0.036, 0.014), metric=1.6)
        parts.append(link(f"Arm, {word}", arm, oak))
        path = np.linspace((0.315 * side, -0.275, 0.16), (0.298 * side, 0.375, 0.16), 17)
        swell = 0.7 + 0.5 * np.sin(np.linspace(0, np.pi, 17)) ** 2
        rod = sweep(f"Stretcher, {word}", path, circle(0.016, 14), scale=swell, metric=1.6)
        parts.append(link(f"Stretcher, {word}", rod, oak))
        rail = rounded_box(f"Side rail, {word}", (0.028, 0.56, 0.075), oak, 0.006, metric=1.6)
        rail.location = (0.305 * side, 0.015, 0.35)
        parts.append(rail)
    for name, y in (("Front rail", -0.282), ("Back rail", 0.305)):
        rail = rounded_box(name, (0.58, 0.028, 0.075), oak, 0.006, metric=1.6)
        rail.location = (0.0, y, 0.35)
        parts.append(rail)
    cross = sweep("Cross stretcher", np.linspace((-0.30, 0.05, 0.16), (0.30, 0.05, 0.16), 9), circle(0.014, 14))
    parts.append(link("Cross stretcher", cross, oak))
    for name, z, y, rise, height in (
        ("Crest rail", 1.11, 0.452, 0.075, 0.10),
        ("Lower back rail", 0.60, 0.315, 0.0, 0.05),
    ):
        knots = [(-0.285, y, z), (-0.14, y + 0.015, z + 0.7 * rise), (0.0, y + 0.022, z + rise)]
        knots += [(0.14, y + 0.015, z + 0.7 * rise), (0.285, y, z)]
        rail = sweep(name, spline(np.array(knots), 7), rounded_rectangle(0.036, height, 0.012), metric=1.6)
        parts.append(link(name, rail, oak))

    seat = link("Seat", cushion("Seat", (0.62, 0.60, 0.115), 0.045, 0.035), cover)
    seat.location = (0.0, 0.005, 0.468)
    back = link("Back", cushion("Back", (0.47, 0.47, 0.085), 0.035, 0.03), cover)
    back.location, back.rotation_euler = (0.0, 0.375, 0.865), (np.radians(76), 0.0, 0.0)
    piping = rounded_rectangle(0.625, 0.605, 0.05, 8)
    for name, z in (("Piping, upper", 0.5), ("Piping, lower", 0.436)):
        ring = np.column_stack([piping[:, 0], piping[:, 1] + 0.005, np.full(len(piping), z)])
        parts.append(link(name, sweep(name, ring, circle(0.007, 8), closed=True), cord()))
    return [*parts, seat, back]


def cord() -> bpy.types.Material:
    """Plain cord in the colour of the damask's gold, made once."""
    known = bpy.data.materials.get("Cord")
    return known or material("Cord", (0.55, 0.28, 0.045), Roughness=0.8, Specular_IOR_Level=0.2)


def build_throw(made: bpy.types.Material) -> bpy.types.Object:
    """Knitted throw that hangs over the right arm, thickened by a live modifier."""
    rows, columns = 56, 30
    knots = [(0.455, 0.26), (0.43, 0.42), (0.405, 0.60), (0.385, 0.70), (0.33, 0.735), (0.275, 0.70)]
    knots += [(0.262, 0.62), (0.235, 0.565), (0.15, 0.552)]
    outline = spline(np.array(knots), 7)
    s = np.linspace(0, len(outline) - 1, rows)
    x = np.interp(s, np.arange(len(outline)), outline[:, 0])
    z = np.interp(s, np.arange(len(outline)), outline[:, 1])
    t = np.linspace(0, 1, columns)
    down = np.clip((0.70 - z) / 0.44, 0, 1)[:, None] * np.where(np.arange(rows) < rows / 2, 1.0, 0.25)[:, None]
    fold = np.sin(t[None, :] * 19 + 0.6 * np.sin(3 * t)[None, :])
    points = np.zeros((rows, columns, 3))
    points[..., 0] = x[:, None] + 0.026 * down * fold + 0.004
    points[..., 1] = -0.20 + 0.34 * t[None, :] * (1 - 0.10 * down) + 0.02 * down * np.cos(t[None, :] * 9)
    points[..., 2] = z[:, None] + 0.006 * np.cos(t[None, :] * 13)
    body = link(
        "Throw", grid_mesh("Throw", points[:, ::-1], grid_uv(rows, columns, 1.0, 2.4), wrap_columns=False), made
    )
    thick: Any = body.modifiers.new("Solidify", "SOLIDIFY")
    thick.thickness, thick.offset = 0.012, 1.0
    return body


def build() -> None:
    """Chair, pillow, throw, pouf and rug around the origin."""
    oak = material("Oak", (0.4, 0.22, 0.1), Roughness=0.38)
    picture(oak, make_image("oak", wood(512, 512, 3, (0.30, 0.16, 0.08), (0.62, 0.40, 0.22), 6), jpeg=88), "Base Color")
    height, _ = weave(128, 16, 1)
    threads = make_image("threads", normals_from_height(height, 2.0), data=True, jpeg=92)
    colour, stitches = knit()
    stitch_normals = make_image("stitches", normals_from_height(stitches, 2.5), data=True, jpeg=92)
    damask_cloth = cloth("Damask", make_image("damask", damask(), jpeg=90), threads, 4.0, 16.0)
    kilim_cloth = cloth("Kilim", make_image("kilim", kilim(), jpeg=90), threads, 3.0, 14.0)
    wool = cloth("Knitted wool", make_image("knit", colour, jpeg=90), stitch_normals, 2.0, 2.0)
    carpet = material("Rug", (0.5, 0.4, 0.3), Roughness=1.0, Specular_IOR_Level=0.0)
    picture(carpet, make_image("rug", rug(), jpeg=90), "Base Color")
    normal_picture(carpet, threads, strength=1.0, repeat=(20.0, 20.0))

    parts = build_chair(oak, damask_cloth)
    pillow = link("Pillow", cushion("Pillow", (0.40, 0.40, 0.06), 0.028, 0.075, 14), kilim_cloth)
    pillow.location, pillow.rotation_euler = (-0.04, 0.21, 0.735), (np.radians(68), np.radians(8), np.radians(6))
    throw = build_throw(wool)
    for part in (*parts, pillow, throw):
        part.location.z += FLOOR
    # Everything that makes up the chair hangs on one empty, turned a little.
    chair = bpy.data.objects.new("Armchair", None)
    bpy.context.scene.collection.objects.link(chair)
    for part in (*parts, pillow, throw):
        part.parent = chair
    chair.location, chair.rotation_euler = (-0.10, 0.12, 0.0), (0, 0, np.radians(-14))

    hide = leather()
    knots = [
        (0.0, 0.0),
        (0.22, 0.0),
        (0.265, 0.03),
        (0.285, 0.12),
        (0.282, 0.20),
        (0.25, 0.265),
        (0.15, 0.295),
        (0.0, 0.30),
    ]
    pouf = link("Pouf", lathe("Pouf", curve_profile(knots, 5), 64), hide)
    pouf.location = (0.52, -0.56, FLOOR)
    t = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    for name, radius, z in (("Pouf seam, lower", 0.281, 0.06), ("Pouf seam, upper", 0.268, 0.245)):
        ring = np.stack([radius * np.cos(t), radius * np.sin(t), np.full_like(t, z)], axis=-1)
        seam = link(name, sweep(name, ring, circle(0.008, 8), closed=True), cord())
        seam.location = pouf.location

    ground = lathe("Rug", rounded_disc(1.0, 0.0, FLOOR, 0.009), 96)
    planar_uv(ground, 0.5)
    for loop in ground.uv_layers[0].data:
        loop.uv = (loop.uv[0] + 0.5, loop.uv[1] + 0.5)
    link("Rug", ground, carpet)

    boxes = [(-140.0, 45.0, 26.0, 18.0, (8.0, 7.2, 6.2)), (-30.0, 30.0, 14.0, 24.0, (2.4, 2.6, 3.0))]
    boxes += [(80.0, 50.0, 22.0, 14.0, (2.2, 2.5, 3.2))]
    image_world("Studio sky", studio_sky(boxes))
    camera((1.45, -3.15, 1.62), (0.04, -0.04, 0.47), 58)


if __name__ == "__main__":
    main("furniture", build)

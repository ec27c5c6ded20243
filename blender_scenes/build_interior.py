"""Build ``interior.blend``: a living room at night, lit through a door ajar and by two shaded lamps.

    python blender_scenes/build_interior.py [OUT.blend] [--preview PREVIEW.png]

Hard light: the hall's lamp shines in through a slit, the floor lamp through its cloth shade, the desk lamp onto its
desk; nearly everything else is seen by light that has bounced. A doll's house (no ceiling, no near wall), so that a
dome of cameras sees into it; the scene's own camera drives through the room over 120 frames. AgX view transform.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from building import (
    area_light,
    camera,
    flat_world,
    main,
    material,
    point_light,
)
from interior_finishes import Finishes, glowing
from shapes import (
    block,
    box_mesh,
    circle,
    curve_profile,
    cushion,
    grid_mesh,
    grid_uv,
    lathe,
    link,
    mesh_from,
    place,
    rounded_disc,
    spline,
    sweep,
)

LEFT, RIGHT, FRONT, BACK, HEIGHT = -1.1, 1.1, -1.15, 0.65, 1.05
DOOR = (0.30, 0.70, 0.82)  # from x, to x, height
HALL = (0.12, 0.88, 1.15)  # from x, to x, far y
FRAMES = 120


def build_shell(finish: Finishes) -> None:
    """Floor, three walls papered inside and bricked outside, door ajar, the hall behind it."""
    block("Floor", (LEFT - 0.06, FRONT, -0.04), (RIGHT + 0.06, HALL[2] + 0.06, 0.0), finish.floor, metric=1.1)
    square = 1 / HEIGHT
    inner, outer = 0.03, 0.06
    door_low, door_high, door_top = DOOR
    walls = [
        ("Left wall", (LEFT - inner, FRONT, 0), (LEFT, BACK, HEIGHT)),
        ("Right wall", (RIGHT, FRONT, 0), (RIGHT + inner, BACK, HEIGHT)),
        ("Back wall, left", (LEFT - inner, BACK, 0), (door_low, BACK + inner, HEIGHT)),
        ("Back wall, right", (door_high, BACK, 0), (RIGHT + inner, BACK + inner, HEIGHT)),
        ("Back wall, over the door", (door_low, BACK, door_top), (door_high, BACK + inner, HEIGHT)),
    ]
    for name, low, high in walls:
        block(name, low, high, finish.paper, metric=square)
    top = HEIGHT + 0.012
    bricks = [
        ("Outer wall, left", (LEFT - outer, FRONT, 0), (LEFT - inner, BACK + outer, HEIGHT)),
        ("Outer wall, right", (RIGHT + inner, FRONT, 0), (RIGHT + outer, BACK + outer, HEIGHT)),
        ("Outer wall, back left", (LEFT - inner, BACK + inner, 0), (HALL[0], BACK + outer, HEIGHT)),
        ("Outer wall, back right", (HALL[1], BACK + inner, 0), (RIGHT + inner, BACK + outer, HEIGHT)),
        ("Hall, outer left", (HALL[0] - 0.03, BACK + outer, 0), (HALL[0], HALL[2] + 0.03, HEIGHT)),
        ("Hall, outer right", (HALL[1], BACK + outer, 0), (HALL[1] + 0.03, HALL[2] + 0.03, HEIGHT)),
        ("Hall, outer back", (HALL[0], HALL[2], 0), (HALL[1], HALL[2] + 0.03, HEIGHT)),
    ]
    for name, low, high in bricks:
        block(name, low, high, finish.brick)
    hall = [
        ("Hall, left", (HALL[0], BACK + inner, 0), (HALL[0] + 0.02, HALL[2], HEIGHT)),
        ("Hall, right", (HALL[1] - 0.02, BACK + inner, 0), (HALL[1], HALL[2], HEIGHT)),
        ("Hall, back", (HALL[0], HALL[2] - 0.02, 0), (HALL[1], HALL[2], HEIGHT)),
        ("Hall ceiling", (HALL[0] - 0.03, BACK, HEIGHT), (HALL[1] + 0.03, HALL[2] + 0.03, top + 0.02)),
    ]
    for name, low, high in hall:
        block(name, low, high, finish.plaster)
    slate = material("Slate", (0.10, 0.11, 0.13), Roughness=0.6)
    block("Hall roof", (HALL[0] - 0.04, BACK + outer, top + 0.02), (HALL[1] + 0.04, HALL[2] + 0.05, top + 0.035), slate)
    copings = [
        ("Coping, left", (LEFT - outer - 0.01, FRONT, HEIGHT), (LEFT + 0.01, BACK + outer, top)),
        ("Coping, right", (RIGHT - 0.01, FRONT, HEIGHT), (RIGHT + outer + 0.01, BACK + outer, top)),
        ("Coping, back", (LEFT + 0.01, BACK - 0.01, HEIGHT), (HALL[0] - 0.03, BACK + outer, top)),
    ]
    for name, low, high in copings:
        block(name, low, high, finish.enamel)
    for name, low, high in (
        ("Architrave, left", (door_low - 0.045, BACK - 0.014, 0), (door_low, BACK, door_top + 0.045)),
        ("Architrave, right", (door_high, BACK - 0.014, 0), (door_high + 0.045, BACK, door_top + 0.045)),
        ("Architrave, top", (door_low, BACK - 0.014, door_top), (door_high, BACK, door_top + 0.045)),
    ):
        block(name, low, high, finish.enamel, bevel=0.004)
    width = door_high - door_low - 0.006
    door = [block("Door", (-width, -0.012, 0.006), (0.0, 0.012, door_top - 0.004), finish.enamel, bevel=0.003)]
    for k, (z, tall) in enumerate(((0.08, 0.26), (0.42, 0.32))):
        for j, x in enumerate((-width + 0.05, -width / 2 + 0.02)):
            for face, y in (("front", -0.017), ("back", 0.011)):
                low, high = (x, y, z), (x + 0.125, y + 0.006, z + tall)
                door.append(block(f"Door panel {k + 1}{j + 1}, {face}", low, high, finish.enamel, bevel=0.005))
    knob = [(0.0, 0.0), (0.012, 0.0), (0.006, 0.008), (0.006, 0.018), (0.016, 0.028), (0.014, 0.042), (0.0, 0.046)]
    handle = link("Door knob", lathe("Door knob", curve_profile(knob, 4), 20), finish.gilt)
    handle.location, handle.rotation_euler = (-width + 0.03, -0.012, 0.39), (np.radians(90), 0, 0)
    hinge = bpy.data.objects.new("Door hinge", None)
    bpy.context.scene.collection.objects.link(hinge)
    for part in (*door, handle):
        part.parent = hinge
    hinge.location, hinge.rotation_euler = (door_high - 0.003, BACK - 0.004, 0.0), (0.0, 0.0, np.radians(52))


def build_sofa(finish: Finishes) -> None:
    """Two-seater along the left wall, with pillows."""
    parts = []
    for name, size, at, puff in (
        ("Sofa base", (0.40, 0.92, 0.12), (0.0, 0.0, 0.125), 0.0),
        ("Sofa back", (0.11, 0.92, 0.34), (-0.19, 0.0, 0.30), 0.0),
        ("Sofa arm, near", (0.42, 0.11, 0.24), (0.0, -0.46, 0.22), 0.01),
        ("Sofa arm, far", (0.42, 0.11, 0.24), (0.0, 0.46, 0.22), 0.01),
        ("Seat, near", (0.34, 0.40, 0.10), (0.03, -0.203, 0.225), 0.018),
        ("Seat, far", (0.34, 0.40, 0.10), (0.03, 0.203, 0.225), 0.018),
    ):
        body = link(name, cushion(name, size, 0.035, puff, 8), finish.tweed)
        body.location = at
        parts.append(body)
    for k, (y, turn) in enumerate(((-0.27, 12.0), (0.25, -16.0))):
        pillow = link(
            f"Pillow {k + 1}", cushion(f"Pillow {k + 1}", (0.25, 0.25, 0.04), 0.018, 0.045, 10), finish.velvet
        )
        pillow.location, pillow.rotation_euler = (-0.06, y, 0.385), (0.0, np.radians(68), np.radians(turn))
        parts.append(pillow)
    leg = lathe("Sofa leg", [(0.0, 0.0), (0.014, 0.0), (0.022, 0.07), (0.0, 0.07)], 16)
    leg.materials.append(finish.walnut)
    for k, (x, y) in enumerate(((-0.17, -0.42), (0.17, -0.42), (0.17, 0.42), (-0.17, 0.42))):
        part = place(f"Sofa leg {k + 1}", leg)
        part.location = (x, y, 0.0)
        parts.append(part)
    for part in parts:
        part.location = (part.location[0] - 0.81, part.location[1] - 0.22, part.location[2])


def build_shelf(finish: Finishes) -> None:
    """Bookcase on the right wall; books share their meshes by colour and size."""
    x0, x1, y0, y1 = 0.90, RIGHT - 0.005, -0.62, 0.18
    for k in range(5):
        z = 0.04 + 0.20 * k
        block(f"Shelf {k + 1}", (x0, y0, z), (x1, y1, z + 0.016), finish.walnut, metric=1.5)
    for name, y in (("Bookcase side, near", y0 - 0.018), ("Bookcase side, far", y1)):
        block(name, (x0 - 0.004, y, 0.0), (x1, y + 0.018, 0.87), finish.walnut, metric=1.5)
    rng = np.random.default_rng(3)
    number = 0
    meshes: dict[tuple[int, int], bpy.types.Mesh] = {}
    for shelf in range(4):
        y = y0 + 0.01
        while y < y1 - 0.05:
            if rng.random() < 0.10:
                y += rng.uniform(0.03, 0.09)
                continue
            tint, kind = int(rng.integers(5)), int(rng.integers(3))
            thick, tall, deep = ((0.022, 0.145, 0.10), (0.032, 0.160, 0.115), (0.016, 0.125, 0.09))[kind]
            number += 1
            name = f"Book {number}"
            if (tint, kind) not in meshes:
                made = block(name, (-deep, 0, 0), (0, thick, tall), finish.books[tint])
                meshes[tint, kind] = made.data
            else:
                made = place(name, meshes[tint, kind])
            lean = rng.uniform(-0.02, 0.10) if rng.random() < 0.2 else 0.0
            made.location = (x1 - 0.03 + rng.uniform(-0.02, 0.0), y, 0.056 + 0.20 * shelf)
            made.rotation_euler = (-lean, 0.0, 0.0)
            y += thick + 0.003 + tall * np.sin(max(lean, 0.0))
    vase = curve_profile([(0.0, 0.0), (0.035, 0.0), (0.055, 0.05), (0.045, 0.10), (0.018, 0.14), (0.026, 0.165)], 5)
    link("Shelf vase", lathe("Shelf vase", [*vase, (0.012, 0.14), (0.0, 0.12)], 36), finish.glaze).location = (
        1.0,
        -0.05,
        0.857,
    )


def build_table(finish: Finishes) -> None:
    """Rug, low round table with a bowl, a glass, and an open book."""
    rug = link("Rug", box_mesh("Rug", (1.12, 0.84, 0.012)), finish.rug)
    rug.location, rug.rotation_euler = (-0.02, -0.32, 0.0), (0, 0, np.radians(96))
    at = (-0.12, -0.30)
    board = lathe("Table top", rounded_disc(0.24, 0.235, 0.26, 0.008), 64)
    for loop, corner in zip(board.loops, board.uv_layers[0].data, strict=True):
        x, y, _ = board.vertices[loop.vertex_index].co
        corner.uv = (1.4 * x, 1.4 * y)
    link("Table top", board, finish.walnut).location = (*at, 0.0)
    for k in range(3):
        turn = 2 * np.pi * k / 3 + 0.3
        path = np.linspace(
            (0.11 * np.cos(turn), 0.11 * np.sin(turn), 0.24), (0.19 * np.cos(turn), 0.19 * np.sin(turn), 0.012), 4
        )
        leg = sweep(
            f"Table leg {k + 1}", path, circle(0.013, 12), scale=np.linspace(1, 0.6, 4), metric=1.5, up=(1, 0, 0)
        )
        link(f"Table leg {k + 1}", leg, finish.walnut).location = (*at, 0.0)
    bowl = [
        (0.0, 0.0),
        (0.04, 0.0),
        (0.045, 0.008),
        (0.085, 0.05),
        (0.088, 0.055),
        (0.08, 0.052),
        (0.04, 0.014),
        (0.0, 0.012),
    ]
    link("Brass bowl", lathe("Brass bowl", curve_profile(bowl, 3), 48), finish.gilt).location = (
        at[0] + 0.06,
        at[1] + 0.10,
        0.26,
    )
    cup = [(0.0, 0.0), (0.026, 0.0), (0.032, 0.09), (0.0295, 0.09), (0.024, 0.006), (0.0, 0.006)]
    link("Tumbler", lathe("Tumbler", cup, 40), finish.glass).location = (at[0] + 0.12, at[1] - 0.08, 0.26)
    t = np.linspace(-1, 1, 25)[None, :]
    s = np.linspace(-1, 1, 3)[:, None]
    swell = 0.012 * np.sqrt(np.clip(1 - (np.abs(t) * 1.6 - 0.55) ** 2, 0.0, 1)) + 0.001
    points = np.stack([0.09 * t + 0 * s, 0.06 * s + 0 * t, swell + 0 * s], axis=-1)
    book = link("Open book", grid_mesh("Open book", points, grid_uv(3, 25), wrap_columns=False), finish.pages)
    book.location, book.rotation_euler = (at[0] - 0.07, at[1] - 0.06, 0.263), (0, 0, np.radians(28))
    block("Open book cover", (-0.094, -0.064, 0), (0.094, 0.064, 0.003), finish.books[0]).location = (
        at[0] - 0.07,
        at[1] - 0.06,
        0.26,
    )
    bpy.data.objects["Open book cover"].rotation_euler = (0, 0, np.radians(28))


def build_lamps(finish: Finishes) -> None:
    """Floor lamp with a cloth shade, desk with a hooded lamp, the hall's ceiling lamp."""
    x, y = -0.80, 0.42
    foot = [(0.0, 0.0), (0.09, 0.0), (0.092, 0.012), (0.02, 0.02), (0.008, 0.03), (0.008, 0.60), (0.0, 0.60)]
    link("Floor lamp stand", lathe("Floor lamp stand", foot, 40), finish.gilt).location = (x, y, 0.0)
    shade = link(
        "Floor lamp shade", lathe("Floor lamp shade", [(0.15, 0.58), (0.125, 0.68), (0.10, 0.78)], 56), finish.shade
    )
    shade.location = (x, y, 0.0)
    point_light("Floor lamp", (x, y, 0.67), 9.0, 0.02, (1.0, 0.72, 0.42))

    x, y = 1.0, -0.46
    foot = curve_profile([(0.0, 0.0), (0.035, 0.0), (0.03, 0.02), (0.042, 0.05), (0.012, 0.085)], 4)
    link("Shelf lamp foot", lathe("Shelf lamp foot", [*foot, (0.0, 0.085)], 32), finish.glaze).location = (x, y, 0.857)
    small = lathe("Shelf lamp shade", [(0.062, 0.08), (0.048, 0.16)], 40)
    link("Shelf lamp shade", small, finish.shade).location = (x, y, 0.857)
    point_light("Shelf lamp", (x, y, 0.975), 4.0, 0.01, (1.0, 0.72, 0.42))

    block("Desk top", (-0.42, 0.36, 0.345), (0.16, 0.635, 0.365), finish.walnut, metric=1.5, bevel=0.004)
    for k, (lx, ly) in enumerate(((-0.40, 0.38), (0.13, 0.38), (0.13, 0.605), (-0.40, 0.605))):
        block(f"Desk leg {k + 1}", (lx, ly, 0.0), (lx + 0.022, ly + 0.022, 0.345), finish.walnut, metric=1.5)
    block("Desk drawer", (-0.15, 0.362, 0.285), (0.12, 0.62, 0.345), finish.walnut, metric=1.5, bevel=0.003)
    block("Letter", (-0.30, 0.42, 0.365), (-0.17, 0.52, 0.367), finish.pages)
    lx, ly = -0.30, 0.57
    stem = spline(
        np.array([(lx, ly, 0.365), (lx, ly, 0.52), (lx + 0.03, ly - 0.02, 0.60), (lx + 0.10, ly - 0.06, 0.60)]), 6
    )
    link("Desk lamp stem", sweep("Desk lamp stem", stem, circle(0.006, 10), up=(1, 0, 0)), finish.gilt)
    base = lathe("Desk lamp foot", [(0.0, 0.0), (0.055, 0.0), (0.05, 0.014), (0.0, 0.02)], 32)
    link("Desk lamp foot", base, finish.gilt).location = (lx, ly, 0.365)
    outside = [(0.075, -0.02), (0.07, 0.01), (0.045, 0.045), (0.015, 0.055)]
    hood = lathe("Desk lamp hood", [*[(r - 0.003, z - 0.002) for r, z in outside[::-1]], *outside, (0.0, 0.055)], 48)
    link("Desk lamp hood", hood, finish.green).location = (lx + 0.10, ly - 0.06, 0.56)
    bulb = lathe("Desk lamp bulb", curve_profile([(0.0, -0.02), (0.018, -0.004), (0.014, 0.018), (0.0, 0.026)], 4), 20)
    link("Desk lamp bulb", bulb, glowing("Bulb", (1.0, 0.74, 0.45), 160.0)).location = (lx + 0.10, ly - 0.06, 0.575)

    middle = 0.5 * (HALL[0] + HALL[1])
    area_light("Hall lamp", (middle, 0.93, HEIGHT - 0.02), (middle, 0.93, 0.0), 32.0, (0.16, 0.16), (1.0, 0.86, 0.66))


def build_pictures(finish: Finishes) -> None:
    """Painting over the sofa, round mirror over the desk."""
    y, z, wide, tall = -0.22, 0.72, 0.54, 0.36
    mesh = mesh_from(
        "Painting",
        [(0, -wide / 2, -tall / 2), (0, wide / 2, -tall / 2), (0, wide / 2, tall / 2), (0, -wide / 2, tall / 2)],
        [(0, 1, 2, 3)],
        np.array([(0, 0), (1, 0), (1, 1), (0, 1)]),
    )
    link("Painting", mesh, finish.canvas, smooth=False).location = (LEFT + 0.014, y, z)
    for name, low, high in (
        ("Frame, below", (0, -wide / 2 - 0.03, -tall / 2 - 0.03), (0.028, wide / 2 + 0.03, -tall / 2)),
        ("Frame, above", (0, -wide / 2 - 0.03, tall / 2), (0.028, wide / 2 + 0.03, tall / 2 + 0.03)),
        ("Frame, near", (0, -wide / 2 - 0.03, -tall / 2), (0.028, -wide / 2, tall / 2)),
        ("Frame, far", (0, wide / 2, -tall / 2), (0.028, wide / 2 + 0.03, tall / 2)),
    ):
        block(name, low, high, finish.gilt, bevel=0.006).location = (LEFT, y, z)
    glass = link("Mirror", lathe("Mirror", [(0.15, 0.0), (0.15, 0.004), (0.0, 0.004)], 64), finish.mirror)
    ring = [(0.148, 0.0), (0.180, 0.0), (0.182, 0.010), (0.168, 0.022), (0.150, 0.014), (0.148, 0.004)]
    rim = link("Mirror frame", lathe("Mirror frame", ring, 64), finish.gilt)
    for part in (glass, rim):
        part.location, part.rotation_euler = (-0.13, BACK, 0.76), (np.radians(90), 0, 0)


def build_camera() -> None:
    """Drive from the sofa's end past the table towards the bookcase, looking at a focus that moves too."""
    focus = bpy.data.objects.new("Focus", None)
    bpy.context.scene.collection.objects.link(focus)
    eye = camera((0.0, -1.0, 0.6), (0.0, 0.3, 0.4), 24)
    track: Any = eye.constraints.new("TRACK_TO")
    track.target, track.track_axis, track.up_axis = focus, "TRACK_NEGATIVE_Z", "UP_Y"
    stations = [  # frame, eye, focus
        (1, (0.62, -1.62, 0.74), (-0.15, 0.30, 0.36)),
        (30, (0.70, -0.95, 0.62), (-0.50, 0.25, 0.38)),
        (60, (0.30, -0.62, 0.55), (-0.20, 0.60, 0.46)),
        (90, (-0.35, -0.75, 0.58), (0.45, 0.55, 0.42)),
        (FRAMES, (-0.72, -1.45, 0.70), (0.55, 0.10, 0.38)),
    ]
    for frame, position, target in stations:
        eye.location, focus.location = position, target
        eye.keyframe_insert("location", frame=frame)
        focus.keyframe_insert("location", frame=frame)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, FRAMES
    scene.frame_set(1)


def build() -> None:
    """The room, centred on the origin."""
    finish = Finishes()
    build_shell(finish)
    build_sofa(finish)
    build_shelf(finish)
    build_table(finish)
    build_lamps(finish)
    build_pictures(finish)
    build_camera()
    flat_world((0.10, 0.16, 0.30), 0.30)
    view = bpy.context.scene.view_settings
    view.view_transform, view.exposure = "AgX", 0.6


if __name__ == "__main__":
    main("interior", build)

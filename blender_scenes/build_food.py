"""Build ``food.blend``: two hot dogs on a plate, fries, a ramekin of ketchup, cherry tomatoes, a napkin, a board.

    python blender_scenes/build_food.py [OUT.blend] [--preview PREVIEW.png]

Subsurface scattering in most of what can be eaten (bread, sausage, fries, tomatoes), image textures for crust, grill
marks and glaze, glossy sauces, lettuce that lets light through, and a printed paper box. Lit by one HDRI.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from bpy.types import Material, Object
from building import camera, image_world, main, make_image, material, node, normal_picture, picture, principled, wire
from food_images import (
    CRUST,
    box_print,
    bun_maps,
    fry_map,
    gherkin_map,
    lettuce_map,
    napkin_map,
    plate_map,
    sausage_maps,
)
from patterns import (
    lattice_noise,
    normals_from_height,
    smoothstep,
    studio_sky,
    weave,
    wood,
)
from shapes import (
    Rgb,
    circle,
    curve_profile,
    grid_mesh,
    grid_uv,
    lathe,
    link,
    mesh_from,
    place,
    planar_uv,
    rounded_disc,
    sweep,
)

BOARD = 0.05  # its top
PLATE = BOARD + 0.03  # where the food stands
HALF = 0.43  # half length of a bun


# ---------------------------------------------------------------- materials


def edible(name: str, colour: Rgb, depth: Rgb, weight: float, scale: float, **inputs: float) -> Material:
    """Principled with subsurface scattering: ``depth`` is the relative mean free path per channel."""
    made = material(name, colour, Subsurface_Weight=weight, Subsurface_Scale=scale, **inputs)
    principled(made).inputs["Subsurface Radius"].default_value = depth
    return made


def lettuce() -> Material:
    """Half of the light comes through."""
    made = material("Lettuce", (0.3, 0.55, 0.12), Roughness=0.42)
    shown = picture(made, make_image("lettuce", lettuce_map(), jpeg=90), "Base Color")
    through = node(made, "BsdfTranslucent")
    wire(made, shown.outputs["Color"], through.inputs["Color"])
    both = node(made, "MixShader", inputs={"Fac": 0.4})
    wire(made, principled(made).outputs["BSDF"], both.inputs[1])
    wire(made, through.outputs["BSDF"], both.inputs[2])
    wire(made, both.outputs["Shader"], made.node_tree.nodes["Material Output"].inputs["Surface"])
    return made


# ---------------------------------------------------------------- parts


def group(name: str, parts: list[Object], location: Rgb, turn: float) -> None:
    """Hang ``parts`` on one empty turned by ``turn`` degrees about Z."""
    holder = bpy.data.objects.new(name, None)
    bpy.context.scene.collection.objects.link(holder)
    for part in parts:
        part.parent = holder
    holder.location, holder.rotation_euler = location, (0.0, 0.0, np.radians(turn))


def bun_mesh(name: str, seed: int) -> bpy.types.Mesh:
    """Split bun along X, open above; tapered towards its foot at both ends."""
    under = np.radians(np.linspace(118, 422, 27))
    outer = np.stack([0.175 * np.cos(under), 0.125 + 0.125 * np.sin(under)], axis=-1)
    inside = np.radians(np.linspace(48, -228, 15))
    inner = np.stack([0.082 * np.cos(inside), 0.170 + 0.088 * np.sin(inside)], axis=-1)
    section = np.concatenate([outer, inner])
    s = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 40))
    size = np.maximum(1 - np.abs(s) ** 5, 0) ** 0.5
    x = HALF * s
    points = np.zeros((len(s), len(section), 3))
    points[..., 0] = x[:, None]
    points[..., 1] = -section[None, :, 0] * size[:, None]
    points[..., 2] = section[None, :, 1] * (0.25 + 0.75 * size[:, None]) * np.minimum(1, 6 * size[:, None])
    swell = lattice_noise(points * 4 + seed, 1.0, 3, seed) - 0.5
    points[..., 1:] *= 1 + 0.16 * swell[..., None] * np.array((1.0, 0.7))
    around = np.concatenate([np.linspace(0, CRUST, 27), np.linspace(CRUST, 1, 17)[1:]])
    uv = np.stack(np.meshgrid(around, np.linspace(0, 1, len(s))), axis=-1)
    return grid_mesh(name, points[:, ::-1], uv[:, ::-1])


def hot_dog(name: str, seed: int, stuff: dict[str, Material], sauces: tuple[str, ...]) -> list[Object]:
    """Bun, two lettuce frills, sausage, zigzags of sauce; along X, on z = 0."""
    parts = [link(f"{name}, bun", bun_mesh(f"{name}, bun", seed), stuff["bun"], angle=60)]
    s = np.linspace(-1, 1, 33)
    centre = np.stack([(HALF + 0.05) * s, 0.008 * np.sin(3 * s + seed), 0.205 + 0.012 * s**2], axis=-1)
    round_ends = np.sqrt(np.clip(1 - np.clip((np.abs(s) - 0.86) / 0.14, 0, 1) ** 2, 0.0, 1))
    # u = 0.5 lies on top: the section starts underneath.
    ring = circle(0.074, 28) @ np.array(((0.0, -1.0), (1.0, 0.0)))
    dog = sweep(f"{name}, sausage", centre, ring, scale=np.maximum(round_ends, 0.02), metric=1 / (2 * HALF + 0.1))
    parts.append(link(f"{name}, sausage", dog, stuff["sausage"]))
    rng = np.random.default_rng(seed)
    for side in (-1, 1):
        rows, columns = 7, 60
        t, w = np.linspace(-0.92, 0.92, columns)[None, :], np.linspace(0, 1, rows)[:, None]
        ruffle = np.sin(21 * t + rng.uniform(0, 6)) + 0.6 * np.sin(37 * t + rng.uniform(0, 6))
        points = np.zeros((rows, columns, 3))
        points[..., 0] = HALF * t + 0.010 * w * np.cos(30 * t)
        points[..., 1] = side * (0.045 + 0.075 * w + 0.020 * w**2 * ruffle)
        points[..., 2] = 0.135 + 0.150 * w - 0.05 * w**2 + 0.020 * w**2 * np.sin(27 * t + side)
        leaf = grid_mesh(
            f"{name}, lettuce", points[:, ::-side], grid_uv(rows, columns, 1, 1)[:, ::-side], wrap_columns=False
        )
        parts.append(link(f"{name}, lettuce, {'left' if side < 0 else 'right'}", leaf, stuff["lettuce"]))
    for k, sauce in enumerate(sauces):
        t = np.linspace(-1, 1, 150)
        swing = 0.043 * np.sin(t * 27 + 1.9 * k) * smoothstep(1.0, 0.93, np.abs(t))
        x = 0.88 * HALF * t + 0.006 * np.cos(t * 54)
        drop = 0.074**2 - np.clip(np.abs(swing), 0, 0.07) ** 2
        z = 0.205 + 0.012 * (x / HALF) ** 2 + np.sqrt(drop) + 0.004 + 0.007 * k
        path = np.stack([x, swing, z], axis=-1)
        thick = 0.0125 * (1 + 0.18 * np.sin(t * 61 + k)) * np.sqrt(np.clip((1 - np.abs(t)) / 0.02, 0.05, 1))
        strand = sweep(f"{name}, {sauce}", path, circle(1.0, 10), scale=thick)
        parts.append(link(f"{name}, {sauce}", strand, stuff[sauce]))
    return parts


def build_fries(stuff: dict[str, Material]) -> None:
    """Open paper box, fries that share three meshes stand in it and lie beside it."""
    rng = np.random.default_rng(31)
    meshes = []
    for k, length in enumerate((0.30, 0.36, 0.42)):
        t = np.linspace(0, 1, 8)
        path = np.stack([0.02 * (k - 1) * np.sin(np.pi * t), 0.012 * np.sin(2 * t + k), length * t], axis=-1)
        square = 0.0185 * np.array(
            [(1, 0.75), (0.75, 1), (-0.75, 1), (-1, 0.75), (-1, -0.75), (-0.75, -1), (0.75, -1), (1, -0.75)]
        )
        mesh = sweep(f"Fry {k + 1}", path, square, up=(0, 1, 0), metric=1 / length)
        mesh.materials.append(stuff["fries"])
        meshes.append(mesh)
    foot, top, height = (0.10, 0.055), (0.165, 0.095), 0.26
    vertices, faces, uv = [], [], []
    for k in range(4):
        sx, sy = ((-1, -1), (1, -1), (1, 1), (-1, 1))[k]
        vertices += [(sx * foot[0], sy * foot[1], 0.0), (sx * top[0], sy * top[1], height if sy < 0 else height + 0.07)]
        nxt = (k + 1) % 4
        faces.append((2 * k, 2 * nxt, 2 * nxt + 1, 2 * k + 1))
        wide = 1.0 if k % 2 == 0 else 0.4
        uv += [(0.5 - 0.32 * wide, 0.05), (0.5 + 0.32 * wide, 0.05), (0.5 + 0.5 * wide, 0.95), (0.5 - 0.5 * wide, 0.95)]
    faces.append((6, 4, 2, 0))
    uv += [(0, 0), (1, 0), (1, 0.02), (0, 0.02)]
    box = link("Fries box", mesh_from("Fries box", vertices, faces, np.array(uv)), stuff["paper"], smooth=False)
    thick: Any = box.modifiers.new("Solidify", "SOLIDIFY")
    thick.thickness, thick.offset = 0.006, -1.0
    parts = [box]
    for k in range(34):
        x, y = rng.uniform(-0.085, 0.085), rng.uniform(-0.04, 0.04)
        fry = place(f"Fry {k + 1}", meshes[int(rng.integers(3))])
        fry.location = (x, y, rng.uniform(0.02, 0.08))
        fry.rotation_euler = (-2.6 * y + rng.normal(0, 0.07), 2.0 * x + rng.normal(0, 0.09), rng.uniform(0, 6.28))
        # Lean outwards first, then spin about the fry's own axis.
        fry.rotation_mode = "XYZ"
        parts.append(fry)
    group("Fries", parts, (0.50, 0.48, BOARD), -24)
    for k, (x, y, turn) in enumerate(((0.10, 0.80, 30.0), (0.24, 0.70, -50.0), (0.78, 0.0, 180.0))):
        fry = place(f"Fallen fry {k + 1}", meshes[k])
        fry.location, fry.rotation_euler = (x, y, BOARD + 0.019), (np.radians(90), 0.0, np.radians(turn))


def build_sides(stuff: dict[str, Material]) -> None:
    """Plate, ramekin with ketchup, tomatoes, gherkin slices, napkin, board."""
    dish = [(0.0, 0.0), (0.36, 0.0), (0.38, 0.004), (0.50, 0.03), (0.66, 0.062), (0.672, 0.070), (0.66, 0.076)]
    dish += [(0.50, 0.046), (0.44, 0.026), (0.0, 0.02)]
    mesh = lathe("Plate", curve_profile(dish, 4), 96)
    for loop, corner in zip(mesh.loops, mesh.uv_layers[0].data, strict=True):
        x, y, _ = mesh.vertices[loop.vertex_index].co
        corner.uv = (0.5 + 0.5 * x / 0.675, 0.5 + 0.5 * y / 0.675)
    link("Plate", mesh, stuff["plate"]).location = (-0.12, -0.06, PLATE - 0.02)
    cup = [
        (0.0, 0.0),
        (0.10, 0.0),
        (0.112, 0.01),
        (0.125, 0.11),
        (0.130, 0.122),
        (0.122, 0.126),
        (0.112, 0.11),
        (0.10, 0.02),
    ]
    ramekin = link("Ramekin", lathe("Ramekin", [*cup, (0.0, 0.018)], 56), stuff["stoneware"])
    rows, columns = 14, 40
    r = np.linspace(0.109, 0.0, rows)[:, None]
    a = np.linspace(0, 2 * np.pi, columns, endpoint=False)[None, :]
    swirl = 0.085 + 0.010 * np.cos(a - 38 * r) * smoothstep(0.109, 0.07, r) * smoothstep(0.0, 0.02, r)
    points = np.stack([r * np.cos(a), r * np.sin(a), swirl + 0.010 * np.exp(-((r / 0.02) ** 2))], axis=-1)
    dip = link("Dip", grid_mesh("Dip", points, grid_uv(rows, columns + 1)), stuff["ketchup"])
    ramekin.location = dip.location = (0.66, -0.26, BOARD)
    fruit = lathe(
        "Tomato",
        [
            (1.03 * x, 0.94 * z)
            for x, z in curve_profile(
                [(0, 0), (0.05, 0.006), (0.085, 0.07), (0.062, 0.14), (0.018, 0.152), (0.0, 0.145)], 5
            )
        ],
        36,
    )
    fruit.materials.append(stuff["tomato"])
    fruit.polygons.foreach_set("use_smooth", np.ones(len(fruit.polygons), dtype=bool))
    rows, columns = 3, 40
    t = np.linspace(0, 2 * np.pi, columns, endpoint=False)[None, :]
    w = np.linspace(1, 0, rows)[:, None]
    star = 0.004 + 0.050 * w * (0.25 + 0.75 * np.abs(np.cos(2.5 * t)) ** 4)
    crown = np.stack(
        [star * np.cos(t), star * np.sin(t), 0.145 - 0.012 * w + 0.03 * w**3 * np.cos(2.5 * t) ** 4], axis=-1
    )
    calyx = grid_mesh("Calyx", crown, grid_uv(rows, columns + 1))
    calyx.materials.append(stuff["stalk"])
    for k, (x, y, tilt, turn) in enumerate(
        ((0.40, -0.66, 0.25, 0.4), (0.58, -0.56, -0.5, 2.0), (0.28, -0.80, 0.6, 4.1))
    ):
        for word, mesh in (("Tomato", fruit), ("Calyx", calyx)):
            part = place(f"{word} {k + 1}", mesh)
            part.location, part.rotation_euler = (x, y, BOARD + 0.004 * abs(tilt)), (0.35 * tilt, 0.25 * tilt, turn)
    slice_ = lathe("Gherkin slice", rounded_disc(0.062, 0.0, 0.016, 0.005), 32)
    for loop, corner in zip(slice_.loops, slice_.uv_layers[0].data, strict=True):
        x, y, _ = slice_.vertices[loop.vertex_index].co
        corner.uv = (0.5 + 0.5 * x / 0.063, 0.5 + 0.5 * y / 0.063)
    slice_.materials.append(stuff["gherkin"])
    slice_.polygons.foreach_set("use_smooth", np.ones(len(slice_.polygons), dtype=bool))
    slice_.set_sharp_from_angle(angle=np.radians(60))
    for k, (x, y, z, rx, ry) in enumerate(
        ((-0.50, 0.20, 0.008, 0.14, -0.10), (-0.43, 0.28, 0.016, 0.30, 0.0), (-0.35, 0.33, 0.02, 0.32, 0.1))
    ):
        part = place(f"Gherkin slice {k + 1}", slice_)
        part.location, part.rotation_euler = (x, y, PLATE + z), (rx, ry, 0.7 * k)
    size = 49
    x, y = np.meshgrid(np.linspace(-0.62, 0.62, size), np.linspace(-0.62, 0.62, size))
    lift = 0.004 + 0.010 * (1 + np.sin(5.2 * x + 2 * y) * np.cos(4.1 * y - x)) * smoothstep(
        0.3, 0.62, np.maximum(abs(x), abs(y))
    )
    cloth = grid_mesh("Napkin", np.stack([x, y, lift], axis=-1), grid_uv(size, size, 7, 7), wrap_columns=False)
    napkin = link("Napkin", cloth, stuff["napkin"])
    napkin.location, napkin.rotation_euler = (-0.16, -0.02, BOARD), (0, 0, np.radians(-33))
    thick: Any = napkin.modifiers.new("Solidify", "SOLIDIFY")
    thick.thickness, thick.offset = 0.004, 1.0
    board = lathe("Board", rounded_disc(1.02, 0.0, BOARD, 0.016), 96)
    planar_uv(board, 0.9)
    link("Board", board, stuff["board"])


def build() -> None:
    """The meal around the origin."""
    bun_colour, bun_normals = bun_maps()
    dog_colour, dog_normals = sausage_maps()
    height, _ = weave(128, 16, 4)
    stuff = {
        "bun": edible("Bun", (0.8, 0.55, 0.28), (1.0, 0.6, 0.3), 0.35, 0.02, Roughness=0.55, Specular_IOR_Level=0.25),
        "sausage": edible("Sausage", (0.6, 0.2, 0.1), (1.0, 0.3, 0.15), 0.3, 0.02, Roughness=0.32),
        "lettuce": lettuce(),
        "ketchup": edible("Ketchup", (0.55, 0.02, 0.012), (1.0, 0.15, 0.08), 0.3, 0.01, Roughness=0.14),
        "mustard": edible("Mustard", (0.85, 0.50, 0.02), (1.0, 0.6, 0.1), 0.3, 0.01, Roughness=0.20),
        "fries": edible("Fries", (0.85, 0.6, 0.2), (1.0, 0.7, 0.25), 0.4, 0.015, Roughness=0.5),
        "tomato": edible("Tomato", (0.62, 0.035, 0.015), (1.0, 0.2, 0.1), 0.35, 0.03, Roughness=0.10, Coat_Weight=0.4),
        "gherkin": edible("Gherkin", (0.5, 0.55, 0.15), (0.6, 1.0, 0.2), 0.4, 0.02, Roughness=0.2),
        "stalk": material("Tomato stalk", (0.10, 0.22, 0.04), Roughness=0.7),
        "plate": material("Painted porcelain", (0.9, 0.88, 0.83), Roughness=0.12),
        "stoneware": material("Stoneware", (0.36, 0.40, 0.42), Roughness=0.22),
        "paper": material("Printed paper", (0.8, 0.3, 0.3), Roughness=0.7),
        "napkin": material("Gingham", (0.8, 0.4, 0.4), Roughness=0.95, Specular_IOR_Level=0.1, Sheen_Weight=0.15),
        "board": material("Beech board", (0.6, 0.4, 0.25), Roughness=0.5),
    }
    picture(stuff["bun"], make_image("bun", bun_colour, jpeg=90), "Base Color")
    normal_picture(stuff["bun"], make_image("bun normals", bun_normals, data=True, jpeg=92), strength=0.5)
    picture(stuff["sausage"], make_image("sausage", dog_colour, jpeg=90), "Base Color")
    normal_picture(stuff["sausage"], make_image("sausage normals", dog_normals, data=True, jpeg=92), strength=0.5)
    picture(stuff["plate"], make_image("plate", plate_map(), jpeg=92), "Base Color")
    picture(stuff["fries"], make_image("fry", fry_map(), jpeg=90), "Base Color")
    picture(stuff["paper"], make_image("fries print", box_print()), "Base Color")
    picture(stuff["gherkin"], make_image("gherkin", gherkin_map()), "Base Color")
    picture(stuff["napkin"], make_image("gingham", napkin_map(), jpeg=92), "Base Color")
    normal_picture(
        stuff["napkin"], make_image("linen", normals_from_height(height, 2.0), data=True, jpeg=92), repeat=(2.0, 2.0)
    )
    beech = wood(512, 512, 17, (0.50, 0.33, 0.20), (0.76, 0.57, 0.38), 7)
    picture(stuff["board"], make_image("beech", beech, jpeg=88), "Base Color")
    turn = 24.0
    across = np.array((-np.sin(np.radians(turn)), np.cos(np.radians(turn))))
    for k, (offset, sauces) in enumerate(((-0.20, ("ketchup",)), (0.185, ("ketchup", "mustard")))):
        x, y = np.array((-0.12, -0.06)) + offset * across
        group(f"Hot dog {k + 1}", hot_dog(f"Hot dog {k + 1}", 3 + k, stuff, sauces), (x, y, PLATE), turn + 3 * k)
    build_fries(stuff)
    build_sides(stuff)
    boxes = [
        (-150.0, 40.0, 26.0, 20.0, (9.0, 8.2, 7.2)),
        (-20.0, 30.0, 12.0, 24.0, (2.8, 2.9, 3.2)),
        (70.0, 50.0, 20.0, 14.0, (2.6, 3.0, 3.6)),
    ]
    image_world("Kitchen window", studio_sky(boxes))
    camera((0.55, -3.0, 2.0), (0.0, -0.02, 0.14), 58)


if __name__ == "__main__":
    main("food", build)

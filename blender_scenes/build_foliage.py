"""Build ``foliage.blend``: a weeping fig in a terracotta pot, a watering can beside it, on a stone slab.

    python blender_scenes/build_foliage.py [OUT.blend] [--preview PREVIEW.png]

Leaf cards cut out by alpha (Mix with a Transparent BSDF) that let light through (Translucent BSDF), twigs that share
three meshes, bark with a normal map, and procedural terracotta, soil and stone (Noise, Voronoi, ColorRamp, Bump).
"""

from __future__ import annotations

import bpy
import numpy as np
from bpy.types import Material
from building import (
    camera,
    cut_out_leaf,
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
from foliage_images import bark, leaf_sheet
from mathutils import Matrix, Vector
from patterns import normals_from_height, studio_sky
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
    rounded_disc,
    spline,
    sweep,
)

SLAB = 0.05  # its top
SOIL = SLAB + 0.40


# ---------------------------------------------------------------- materials


def leaves() -> Material:
    """Alpha cut-out over a mix of a glossy front and light that comes through."""
    sheet, veins = leaf_sheet()
    made = material("Fig leaves", (0.2, 0.4, 0.1), Roughness=0.38, Specular_IOR_Level=0.4)
    shown = picture(made, make_image("leaves", sheet), "Base Color")
    normal_picture(made, make_image("leaf veins", veins, data=True, jpeg=92), strength=0.6)
    through = node(made, "BsdfTranslucent")
    lift = node(made, "HueSaturation", inputs={"Hue": 0.48, "Saturation": 1.15, "Value": 1.5})
    wire(made, shown.outputs["Color"], lift.inputs["Color"])
    wire(made, lift.outputs["Color"], through.inputs["Color"])
    cut_out_leaf(made, shown, through, 0.35)
    return made


def earthen(
    name: str, stops: list[tuple[float, Rgb]], scale: float, bump: float, roughness: float, detail: float = 8.0
) -> Material:
    """Noise through a ColorRamp, and the same noise as Bump, in object coordinates."""
    made = material(name, stops[-1][1], Roughness=roughness, Specular_IOR_Level=0.2)
    noise = node(made, "TexNoise", inputs={"Scale": scale, "Detail": detail, "Roughness": 0.62})
    wire(made, node(made, "TexCoord").outputs["Object"], noise.inputs["Vector"])
    wire(made, ramp(made, noise.outputs["Fac"], stops).outputs["Color"], principled(made).inputs["Base Color"])
    bend = node(made, "Bump", inputs={"Strength": 0.6, "Distance": bump})
    wire(made, noise.outputs["Fac"], bend.inputs["Height"])
    wire(made, bend.outputs["Normal"], principled(made).inputs["Normal"])
    return made


def flagstones() -> Material:
    """Crazy paving: Voronoi cells of several greys, dark joints where two cells meet."""
    made = material("Flagstones", (0.4, 0.38, 0.35), Roughness=0.75, Specular_IOR_Level=0.3)
    where = node(made, "TexCoord").outputs["Object"]
    cells = node(made, "TexVoronoi", inputs={"Scale": 3.2})
    edges = node(made, "TexVoronoi", feature="DISTANCE_TO_EDGE", inputs={"Scale": 3.2})
    noise = node(made, "TexNoise", inputs={"Scale": 14.0, "Detail": 6.0})
    for each in (cells, edges, noise):
        wire(made, where, each.inputs["Vector"])
    split = node(made, "SeparateColor")
    wire(made, cells.outputs["Color"], split.inputs["Color"])
    stops = [
        (0.0, (0.20, 0.19, 0.18)),
        (0.4, (0.36, 0.33, 0.29)),
        (0.75, (0.46, 0.42, 0.36)),
        (1.0, (0.30, 0.31, 0.33)),
    ]
    tone = ramp(made, split.outputs["Red"], stops)
    mottle = node(made, "Mix", data_type="RGBA", blend_type="OVERLAY", inputs={0: 0.55})
    wire(made, tone.outputs["Color"], mottle.inputs[6])
    wire(made, noise.outputs["Fac"], mottle.inputs[7])
    joint = ramp(made, edges.outputs["Distance"], [(0.0, (0.0, 0.0, 0.0)), (0.055, (1.0, 1.0, 1.0))])
    paved = node(made, "Mix", data_type="RGBA", blend_type="MULTIPLY", inputs={0: 0.88})
    wire(made, mottle.outputs[2], paved.inputs[6])
    wire(made, joint.outputs["Color"], paved.inputs[7])
    wire(made, paved.outputs[2], principled(made).inputs["Base Color"])
    bend = node(made, "Bump", inputs={"Strength": 0.5, "Distance": 0.01})
    wire(made, joint.outputs["Color"], bend.inputs["Height"])
    wire(made, bend.outputs["Normal"], principled(made).inputs["Normal"])
    return made


# ---------------------------------------------------------------- the plant


def twig(name: str, seed: int, count: int, wood: Material, foliage: Material) -> bpy.types.Mesh:
    """A drooping stem along +X with ``count`` leaf cards in two rows; two materials."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, 7)
    stem = np.stack([0.24 * t, 0.012 * np.sin(5 * t + seed), 0.02 * t - 0.075 * t**2], axis=-1)
    vertices: list[np.ndarray] = []
    faces: list[list[int]] = []
    corners: list[tuple[float, float]] = []
    bark_faces = 0
    ring = circle(1.0, 5)
    for i, point in enumerate(stem):
        radius = 0.0042 * (1 - 0.75 * t[i])
        vertices += [point + np.array((0.0, radius * a, radius * b)) for a, b in ring]
    for i in range(len(stem) - 1):
        for j in range(5):
            k = (j + 1) % 5
            faces.append([5 * i + j, 5 * i + k, 5 * i + 5 + k, 5 * i + 5 + j][::-1])
            corners += [(j / 5, t[i]), ((j + 1) / 5, t[i]), ((j + 1) / 5, t[i + 1]), (j / 5, t[i + 1])][::-1]
            bark_faces += 1
    rows, columns = 5, 3
    for n in range(count):
        at = 0.12 + 0.88 * n / (count - 1)
        base = np.array([np.interp(at, t, stem[:, k]) for k in range(3)])
        side = -1 if n % 2 else 1
        turn = side * rng.uniform(0.6, 1.0) if n < count - 1 else rng.normal(0, 0.1)
        pitch, roll = rng.uniform(-0.5, 0.15), rng.normal(0, 0.35)
        length = 0.115 * rng.uniform(0.8, 1.12) * (1 - 0.25 * at)
        frame = Matrix.Rotation(turn, 3, "Z") @ Matrix.Rotation(-pitch, 3, "Y") @ Matrix.Rotation(roll, 3, "X")
        tile = np.array(divmod(int(rng.choice(4, p=(0.34, 0.34, 0.24, 0.08))), 2))[::-1] * 0.5
        start = len(vertices)
        for i in range(rows):
            for j in range(columns):
                x, y = i / (rows - 1), j / (columns - 1) - 0.5
                bend = -0.28 * x**2 + 0.35 * abs(y) * (1 - 0.3 * x)
                local = Vector((length * x, 0.52 * length * y, length * bend))
                vertices.append(base + np.array(frame @ local))
        for i in range(rows - 1):
            for j in range(columns - 1):
                cells = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
                faces.append([start + a * columns + b for a, b in cells])
                corners += [tuple(tile + 0.5 * np.array([a / (rows - 1), b / (columns - 1)])) for a, b in cells]
    mesh = mesh_from(name, vertices, faces, np.asarray(corners))
    mesh.materials.append(wood)
    mesh.materials.append(foliage)
    mesh.polygons.foreach_set("material_index", (np.arange(len(faces)) >= bark_faces).astype(np.int32))
    mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), dtype=bool))
    return mesh


def build_plant(wood: Material, foliage: Material) -> None:
    """Two twisted stems, boughs, and twigs along them."""
    rng = np.random.default_rng(2)
    twigs = [twig(f"Twig {k + 1}", 10 + k, count, wood, foliage) for k, count in enumerate((15, 13, 17))]
    number = 0
    for stem, phase in ((1, 0.0), (2, np.pi)):
        s = np.linspace(0, 1, 22)
        turn = 7.5 * s + phase
        wide = 0.030 + 0.02 * s**2
        trunk = np.stack([wide * np.cos(turn) + 0.05 * s, wide * np.sin(turn), SOIL - 0.04 + 0.78 * s], axis=-1)
        taper = 1 - 0.45 * s
        name = f"Trunk {stem}"
        mesh = sweep(name, trunk, circle(0.030, 14), scale=taper, up=(1, 0, 0), metric=2.2, turns=1.0)
        link(name, mesh, wood)
        for bough in range(8):
            at = 0.50 + 0.50 * bough / 7
            start = np.array([np.interp(at, s, trunk[:, k]) for k in range(3)])
            azimuth = 2.4 * (2 * bough + stem) + rng.normal(0, 0.2)
            rise = rng.uniform(0.26, 0.50) * (0.55 + 0.85 * (at - 0.5) / 0.5)
            reach = rng.uniform(0.30, 0.44) * (1.15 - 0.55 * (at - 0.5) / 0.5)
            out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            lean = np.array([-out[1], out[0], 0.0]) * rng.normal(0, 0.06)
            tip = start + reach * out + (0.0, 0.0, rise)
            middle = start + 0.45 * reach * out + (0.0, 0.0, 0.62 * rise) + lean
            path = spline(np.array([start, middle, tip, tip + 0.20 * out - (0.0, 0.0, 0.06)]), 5)
            size = 0.013 * np.linspace(1.0, 0.25, len(path))
            name = f"Bough {stem}.{bough + 1}"
            link(name, sweep(name, path, circle(1.0, 8), scale=size, up=(1, 0, 0), metric=2.5), wood)
            for along in np.linspace(0.34, 1.0, 7):
                index = along * (len(path) - 1)
                point = np.array([np.interp(index, np.arange(len(path)), path[:, k]) for k in range(3)])
                spin = azimuth + (rng.uniform(-1.5, 1.5) if along < 1 else rng.normal(0, 0.2))
                lift = rng.uniform(-0.35, 0.55)
                turned = Matrix.Rotation(spin, 4, "Z") @ Matrix.Rotation(-lift, 4, "Y")
                turned = turned @ Matrix.Rotation(rng.normal(0, 0.4), 4, "X")
                number += 1
                part = place(f"Twig on {stem}.{bough + 1}, {number}", twigs[int(rng.integers(3))])
                part.matrix_world = Matrix.Translation(point) @ turned @ Matrix.Scale(rng.uniform(0.85, 1.2), 4)


def build_pot(clay: Material, soil: Material) -> None:
    """Pot, saucer, uneven soil, pebbles that share a mesh."""
    outer = [(0.0, 0.0), (0.175, 0.0), (0.19, 0.012), (0.232, 0.20), (0.258, 0.335), (0.262, 0.345), (0.288, 0.35)]
    outer += [(0.296, 0.36), (0.304, 0.425), (0.298, 0.436), (0.272, 0.436), (0.263, 0.428), (0.252, 0.37)]
    link("Pot", lathe("Pot", outer, 72), clay).location.z = SLAB + 0.02
    saucer = [(0.0, 0.0), (0.24, 0.0), (0.272, 0.012), (0.292, 0.05), (0.282, 0.052), (0.262, 0.022), (0.0, 0.02)]
    link("Saucer", lathe("Saucer", saucer, 72), clay).location.z = SLAB
    rows, columns = 16, 48
    r = np.linspace(0.258, 0.0, rows)[:, None]
    a = np.linspace(0, 2 * np.pi, columns, endpoint=False)[None, :]
    z = (
        SOIL
        + 0.03 * np.exp(-((r / 0.10) ** 2))
        + 0.012 * (np.sin(9 * a + 40 * r) + np.cos(5 * a - 61 * r)) * (r > 0) / 2
    )
    points = np.stack([r * np.cos(a), r * np.sin(a), z + 0 * a], axis=-1)
    link("Soil", grid_mesh("Soil", points, grid_uv(rows, columns + 1)), soil)
    stone = lathe(
        "Pebble",
        [(1.0 * x, 0.6 * y) for x, y in curve_profile([(0, -1), (0.7, -0.75), (1, 0), (0.7, 0.75), (0, 1)], 3)],
        12,
    )
    stone.materials.append(material("Pebbles", (0.62, 0.58, 0.52), Roughness=0.45))
    stone.polygons.foreach_set("use_smooth", np.ones(len(stone.polygons), dtype=bool))
    rng = np.random.default_rng(8)
    for k in range(46):
        radius, turn, size = (
            0.24 * np.sqrt(rng.uniform(0.16, 1.0)),
            rng.uniform(0, 2 * np.pi),
            rng.uniform(0.010, 0.022),
        )
        part = place(f"Pebble {k + 1}", stone)
        part.location = (radius * np.cos(turn), radius * np.sin(turn), SOIL + 0.008)
        part.rotation_euler = (rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4), turn)
        part.scale = (size, size * rng.uniform(0.6, 1.0), size * rng.uniform(0.7, 1.0))


def build_can() -> None:
    """Enamelled watering can with a brass rose."""
    enamel = material("Blue enamel", (0.035, 0.13, 0.24), Roughness=0.16)
    brass = material("Brass", (0.80, 0.55, 0.22), Metallic=1.0, Roughness=0.25)
    body = [(0.0, 0.0), (0.12, 0.0), (0.13, 0.01), (0.125, 0.12), (0.105, 0.22), (0.085, 0.245), (0.085, 0.262)]
    body += [(0.079, 0.264), (0.078, 0.24), (0.098, 0.215), (0.116, 0.12), (0.118, 0.03), (0.0, 0.025)]
    spout = spline(np.array([(0.10, 0.0, 0.05), (0.20, 0.0, 0.11), (0.27, 0.0, 0.24), (0.33, 0.0, 0.31)]), 6)
    handle = spline(
        np.array([(-0.118, 0, 0.07), (-0.20, 0, 0.14), (-0.18, 0, 0.27), (-0.05, 0, 0.35), (0.075, 0, 0.255)]), 7
    )
    parts = [link("Can", lathe("Can", body, 56), enamel)]
    parts.append(
        link("Spout", sweep("Spout", spout, circle(1.0, 16), scale=np.linspace(0.028, 0.013, len(spout))), enamel)
    )
    parts.append(link("Handle", sweep("Handle", handle, circle(0.009, 10), up=(0, 1, 0)), enamel))
    rose = [(0.0, 0.0), (0.014, 0.0), (0.016, 0.015), (0.040, 0.045), (0.041, 0.052), (0.0, 0.058)]
    head = link("Rose", lathe("Rose", rose, 32), brass)
    head.location, head.rotation_euler = (0.325, 0.0, 0.305), (0.0, np.radians(42), 0.0)
    holder = bpy.data.objects.new("Watering can", None)
    bpy.context.scene.collection.objects.link(holder)
    for part in (*parts, head):
        part.parent = holder
    holder.location, holder.rotation_euler = (0.40, -0.36, SLAB), (0.0, 0.0, np.radians(-152))


def build() -> None:
    """Plant, pot, can and slab around the origin."""
    colour, ridges = bark()
    wood = material("Bark", (0.35, 0.3, 0.25), Roughness=0.85, Specular_IOR_Level=0.2)
    picture(wood, make_image("bark", colour, jpeg=90), "Base Color")
    normal_picture(wood, make_image("bark normals", normals_from_height(ridges, 2.0), data=True, jpeg=92))
    clay = [(0.30, (0.36, 0.115, 0.05)), (0.52, (0.50, 0.18, 0.085)), (0.72, (0.62, 0.33, 0.21))]
    ground = [(0.35, (0.012, 0.008, 0.005)), (0.55, (0.05, 0.03, 0.018)), (0.75, (0.13, 0.085, 0.05))]
    build_plant(wood, leaves())
    build_pot(earthen("Terracotta", clay, 4.0, 0.006, 0.8), earthen("Soil", ground, 28.0, 0.02, 1.0))
    build_can()
    link("Slab", lathe("Slab", rounded_disc(0.78, 0.0, SLAB, 0.012), 96), flagstones())
    boxes = [(-60.0, 55.0, 24.0, 18.0, (10.5, 9.6, 8.2)), (100.0, 35.0, 26.0, 20.0, (5.0, 5.2, 5.4))]
    image_world("Garden sky", studio_sky(boxes, ground=(0.30, 0.33, 0.22)))
    camera((1.5, -3.6, 1.75), (0.0, -0.02, 0.86), 55)


if __name__ == "__main__":
    main("foliage", build)

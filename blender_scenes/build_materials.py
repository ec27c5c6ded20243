"""Build `materials`: sixteen balls on a tiled slab, from mirror to rough metal, plastic, glass, coat and cloth.

    python blender_scenes/build_materials.py [out.blend]

Exercises: every lobe of the Principled shader that the converter knows, the Glass node, images on base colour,
roughness, metallic and normal, an area light beside the environment, refraction of one ball through another.
"""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np
from building import (
    area_light,
    camera,
    image_world,
    main,
    make_image,
    material,
    node,
    normal_picture,
    picture,
    principled,
    wire,
)
from patterns import (
    lattice_noise,
    mix,
    normals_from_height,
    plain,
    smoothstep,
    spectral_noise,
    studio_sky,
    texel_grid,
    weave,
)
from solids import ball, box, loop_spline, place, tube

RADIUS = 0.215
SPACING = 0.54
SLAB = 0.06


# ---------------------------------------------------------------- pictures


def tiles(size: int = 512, across: int = 8) -> np.ndarray:
    """Two-tone stone tiles with grout, [N, N, 3]."""
    u, v = texel_grid(size, size)
    x, y = u * across, v * across
    odd = (np.floor(x) + np.floor(y)) % 2
    tone = spectral_noise(size, size, 21, slope=1.5, lowest=3) * 0.030
    stone = mix(plain(size, size, (0.70, 0.69, 0.66)), (0.34, 0.36, 0.39), odd) + tone[..., None]
    gap = np.maximum(np.abs(x % 1 - 0.5), np.abs(y % 1 - 0.5))
    return mix(stone, (0.16, 0.155, 0.15), smoothstep(0.482, 0.492, gap))


def majolica(size: int = 512) -> np.ndarray:
    """Glazed ceramic: green scales between white and ochre bands, [N, N, 3]."""
    u, v = texel_grid(size, size)
    image = plain(size, size, (0.93, 0.91, 0.84))
    row = v * 12
    x = (u * 16 + 0.5 * (np.floor(row) % 2)) % 1 - 0.5
    scale = np.hypot(x * 1.6, row % 1 - 0.0)
    image = mix(image, (0.08, 0.42, 0.36), smoothstep(0.92, 0.86, scale) * smoothstep(0.20, 0.28, scale))
    image = mix(image, (0.86, 0.52, 0.13), smoothstep(0.20, 0.15, scale))
    for centre in (0.20, 0.5, 0.80):
        band = np.abs(v - centre)
        image = mix(image, (0.95, 0.93, 0.86), smoothstep(0.052, 0.048, band))
        image = mix(image, (0.09, 0.16, 0.42), smoothstep(0.034, 0.030, band) * smoothstep(0.018, 0.022, band))
        dots = np.hypot((u * 48) % 1 - 0.5, (v - centre) * 24)
        image = mix(image, (0.72, 0.22, 0.12), smoothstep(0.36, 0.28, dots))
    return image


def brushed(size: int = 256) -> np.ndarray:
    """Roughness of lathe-turned steel, lines along u, [N, N]."""
    return np.clip(0.32 + 0.09 * spectral_noise(size, size, 31, slope=0.5, stretch=18.0).T, 0.05, 1)


def hammered(size: int = 256, dents: int = 150) -> np.ndarray:
    """Height of a hammered sheet, tileable: the nearest of many shallow bowls."""
    rng = np.random.default_rng(12)
    u, v = texel_grid(size, size)
    nearest = np.full((size, size), 9.0)
    for cx, cy in rng.random((dents, 2)):
        dx, dy = (u - cx + 0.5) % 1 - 0.5, (v - cy + 0.5) % 1 - 0.5
        nearest = np.minimum(nearest, dx**2 + dy**2)
    return nearest


def chipped(size: int = 512) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Worn teal paint on steel: colour [N, N, 3], metallic [N, N], roughness [N, N]."""
    u, v = texel_grid(size, size)
    turn, rise = u * 2 * np.pi, (v - 0.5) * np.pi
    points = np.stack([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)], axis=-1)
    wear = lattice_noise(points, 3.5, 5, seed=77)
    bare = smoothstep(0.555, 0.565, wear)
    rust = smoothstep(0.52, 0.555, wear) * (1 - bare)
    grain = lattice_noise(points, 22.0, 2, seed=5)
    colour = mix(plain(size, size, (0.10, 0.46, 0.47)), (0.45, 0.22, 0.10), rust * (0.5 + 0.5 * grain))
    colour = mix(colour, (0.74, 0.73, 0.71), bare)
    return colour, bare, 0.30 + 0.45 * rust - 0.02 * bare


# ---------------------------------------------------------------- materials


def steel() -> bpy.types.Material:
    made = material("Brushed steel", (0.58, 0.58, 0.57), Metallic=1.0)
    picture(made, make_image("brushed", brushed(), data=True), "Roughness", repeat=(1.0, 2.0))
    return made


def ceramic() -> bpy.types.Material:
    made = material("Majolica", (0.5, 0.6, 0.5), Roughness=0.09)
    picture(made, make_image("majolica", majolica()), "Base Color")
    return made


def velvet() -> bpy.types.Material:
    made = material("Woven cloth", (0.30, 0.03, 0.10), Roughness=0.85, Sheen_Weight=0.6, Sheen_Roughness=0.4)
    height, warp = weave(256, 16, 8)
    colour = mix(
        mix(plain(256, 256, (0.40, 0.09, 0.20)), (0.62, 0.30, 0.30), warp), (0.12, 0.03, 0.06), (1 - height) * 0.7
    )
    picture(made, make_image("cloth", colour), "Base Color", repeat=(8.0, 4.0))
    bumps = normals_from_height(height, 3.0)
    normal_picture(made, make_image("cloth normal", bumps, data=True), strength=0.6, repeat=(8.0, 4.0))
    return made


def brass() -> bpy.types.Material:
    made = material("Hammered brass", (0.83, 0.58, 0.24), Metallic=1.0, Roughness=0.14)
    height = hammered()
    bumps = normals_from_height(height / height.max() * 18, 1.0)
    normal_picture(made, make_image("hammered", bumps, data=True), strength=0.7, repeat=(2.0, 1.0))
    return made


def worn_paint() -> bpy.types.Material:
    made = material("Worn paint", (0.1, 0.4, 0.4))
    colour, metallic, roughness = chipped()
    picture(made, make_image("worn paint", colour), "Base Color")
    picture(made, make_image("worn paint metallic", metallic, data=True), "Metallic")
    picture(made, make_image("worn paint roughness", roughness, data=True), "Roughness")
    return made


def glass(name: str, colour: tuple[float, float, float], roughness: float, ior: float) -> bpy.types.Material:
    """Glass node rather than Principled transmission: both are common in real files."""
    made = material(name, colour)
    tree = made.node_tree
    output = next(n for n in tree.nodes if n.type == "OUTPUT_MATERIAL")
    tree.nodes.remove(principled(made))
    shader = node(made, "BsdfGlass", inputs={"Color": (*colour, 1), "Roughness": roughness, "IOR": ior})
    wire(made, shader.outputs["BSDF"], output.inputs["Surface"])
    return made


MAKERS: list[Callable[[], bpy.types.Material]] = [
    lambda: material("Chrome", (0.92, 0.92, 0.92), Metallic=1.0, Roughness=0.0),
    lambda: material("Red plastic", (0.60, 0.02, 0.02), Roughness=0.08),
    lambda: material("Clear glass", (1.0, 1.0, 1.0), Roughness=0.0, IOR=1.5, Transmission_Weight=1.0),
    ceramic,
    lambda: material("Gold", (1.0, 0.72, 0.28), Metallic=1.0, Roughness=0.12),
    velvet,
    lambda: material("Blue satin plastic", (0.03, 0.10, 0.50), Roughness=0.38),
    lambda: material("Amber glass", (0.95, 0.52, 0.10), Roughness=0.0, IOR=1.52, Transmission_Weight=1.0),
    lambda: material(
        "Car paint", (0.03, 0.16, 0.09), Metallic=0.5, Roughness=0.42, Coat_Weight=1.0, Coat_Roughness=0.03
    ),
    lambda: glass("Frosted glass", (0.90, 0.96, 1.0), 0.25, 1.45),
    brass,
    lambda: material("Rubber", (0.018, 0.018, 0.02), Roughness=0.75, Specular_IOR_Level=0.35),
    worn_paint,
    lambda: material("Rough copper", (0.93, 0.44, 0.30), Metallic=1.0, Roughness=0.5),
    lambda: glass("Heavy blue glass", (0.45, 0.66, 1.0), 0.0, 1.75),
    steel,
]


# ---------------------------------------------------------------- the scene


def build() -> None:
    """Slab, sixteen balls on rubber rings, sky and one area light."""
    slab = material("Stone tiles", (0.5, 0.5, 0.5), Roughness=0.35)
    picture(slab, make_image("tiles", tiles(), jpeg=92), "Base Color")
    side = 4 * SPACING + 0.12
    place("Slab", box((side, side, SLAB), bevel=0.012, scale=1 / side, at=(0, 0, -SLAB / 2)), slab, smooth=None)
    rubber = material("Ring rubber", (0.03, 0.03, 0.032), Roughness=0.6)
    circle = loop_spline([(np.cos(a) * 0.11, np.sin(a) * 0.11, 0.012) for a in np.arange(6) * np.pi / 3], 6)
    ring = tube(circle, 0.012, 10, closed=True, repeats=(1, 12))
    for i, make in enumerate(MAKERS):
        made = make()
        x, y = (i % 4 - 1.5) * SPACING, (1.5 - i // 4) * SPACING
        place(f"Ring, {made.name}", ring, rubber, at=(x, y, 0))
        # It sits in the ring: the ring's top circle is where their distances to the ball's centre add up.
        height = 0.012 + np.sqrt((RADIUS + 0.012) ** 2 - 0.11**2)
        place(made.name, ball(RADIUS, 28, 56), made, at=(x, y, height), turn=(0, 0, 30.0 * i))
    boxes = [
        (-150.0, 40.0, 20.0, 15.0, (9.0, 8.4, 7.4)),
        (-20.0, 28.0, 9.0, 24.0, (3.2, 3.5, 4.0)),
        (80.0, 50.0, 18.0, 10.0, (2.6, 3.0, 3.6)),
    ]
    image_world("Studio sky", studio_sky(boxes), 0.75)
    area_light("Key softbox", (1.7, -1.9, 2.6), (0, 0, 0.1), 60.0, (1.0, 0.6), (1.0, 0.95, 0.88))
    camera((1.35, -3.9, 2.9), (0.0, -0.05, 0.08), lens=56)


if __name__ == "__main__":
    main("materials", build)

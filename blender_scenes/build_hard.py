"""Build the six small hard scenes of the tests, each one thing carried to an extreme.

    python blender_scenes/build_hard.py [FOLDER]

all_glass       nothing but refraction: light reaches the eye through dielectrics alone
all_mirror      perfect mirrors facing one another, roughness 0
emissive_only   no lamps, no world: surfaces that shine, one of them textured
volume          absorbing and scattering media, bounded and free-standing
tiny_scale      the still life of `still_life` at 1e-4 units
huge_scale      the same at 2e4 units; both must give the unit scene's picture

``python blender_scenes/build_hard.py --still-life SCALE OUT.blend`` builds the still life at any scale.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
from building import (
    FOLDER,
    area_light,
    camera,
    flat_world,
    make_image,
    material,
    new_scene,
    node,
    picture,
    principled,
    save,
    wire,
)
from patterns import mix, plain, smoothstep, texel_grid
from shapes import rounded_disc
from solids import ball, box, lathe, place

TINY, HUGE = 1e-4, 2e4


def tiles(size: int = 64, across: int = 8) -> np.ndarray:
    """Two-colour checker with a red corner, so that a flip would show, [N, N, 3]."""
    u, v = texel_grid(size, size)
    odd = (np.floor(u * across) + np.floor(v * across)) % 2
    image = mix(plain(size, size, (0.80, 0.78, 0.70)), (0.25, 0.30, 0.38), odd)
    return mix(image, (0.75, 0.15, 0.10), smoothstep(0.30, 0.28, np.hypot(u, v)))


def slab(image: bool = True, size: float = 2.4) -> bpy.types.Object:
    """Checkered floor whose top is z = 0."""
    made = material("Floor", (0.6, 0.6, 0.6), Roughness=0.6)
    if image:
        picture(made, make_image("tiles", tiles()), "Base Color")
    return place("Floor", box((size, size, 0.08), scale=1 / size, at=(0, 0, -0.04)), made, smooth=None)


def without_surface(name: str) -> bpy.types.Material:
    """A material with nothing on its surface, for a volume."""
    made = material(name, (1, 1, 1))
    made.node_tree.nodes.remove(principled(made))
    return made


def volume_output(made: bpy.types.Material) -> bpy.types.NodeSocket:
    """The material's volume input."""
    return next(n for n in made.node_tree.nodes if n.type == "OUTPUT_MATERIAL").inputs["Volume"]


# ---------------------------------------------------------------- the six


def all_glass() -> None:
    """Glass ball, box and hollow bottle on a glass plate under a white sky."""
    clear = material("Clear glass", (1.0, 1.0, 1.0), Roughness=0.0, IOR=1.5, Transmission_Weight=1.0)
    green = material("Green glass", (0.55, 0.92, 0.65), Roughness=0.0, IOR=1.5, Transmission_Weight=1.0)
    frosted = material("Frosted glass", (0.95, 0.95, 1.0), Roughness=0.3, IOR=1.45, Transmission_Weight=1.0)
    place("Plate", box((2.2, 2.2, 0.08), bevel=0.01, at=(0, 0, -0.05)), green, smooth=None)
    place("Ball", ball(0.35, 16, 32), clear, at=(-0.45, -0.3, 0.36))
    place("Box", box((0.5, 0.5, 0.8), bevel=0.03, at=(0, 0, 0.41)), frosted, at=(0.5, -0.2, 0), turn=(0, 0, 25))
    outer = [(0.0, 0.0), (0.26, 0.0), (0.28, 0.03), (0.28, 0.55), (0.12, 0.75), (0.10, 1.0)]
    inner = [(0.07, 1.0), (0.09, 0.74), (0.24, 0.53), (0.24, 0.06), (0.0, 0.05)]
    place("Bottle", lathe([*outer, *inner], 32), green, at=(0.0, 0.5, 0.01))
    flat_world((0.9, 0.95, 1.0), 1.0)


def all_mirror() -> None:
    """Perfect mirrors: a floor, three walls' worth of panels, two balls; light comes from the world alone."""
    silver = material("Silver mirror", (0.97, 0.96, 0.92), Metallic=1.0, Roughness=0.0)
    gold = material("Gold mirror", (1.0, 0.76, 0.33), Metallic=1.0, Roughness=0.0)
    place("Floor", box((2.2, 2.2, 0.06), at=(0, 0, -0.03)), silver, smooth=None)
    place("Left mirror", box((0.05, 1.8, 1.0), at=(0, 0, 0.5)), silver, at=(-0.9, 0, 0.01), smooth=None)
    place("Right mirror", box((0.05, 1.8, 1.0), at=(0, 0, 0.5)), silver, at=(0.9, 0, 0.01), smooth=None)
    place("Gold ball", ball(0.36, 16, 32), gold, at=(-0.3, 0.2, 0.37))
    place("Silver ball", ball(0.26, 16, 32), silver, at=(0.42, -0.3, 0.27))
    world = flat_world((1, 1, 1), 1.0)
    # A gradient by direction: in a uniform sky mirrors would be invisible.
    u, v = texel_grid(32, 64)
    sky = mix(
        mix(plain(32, 64, (0.9, 0.6, 0.35)), (0.25, 0.45, 0.9), v),
        (1.6, 1.5, 1.3),
        smoothstep(0.7, 1.0, np.cos(2 * np.pi * u)),
    )
    environment = node(world, "TexEnvironment", image=make_image("gradient", sky, is_float=True))
    wire(world, environment.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"])


def emissive_only() -> None:
    """A textured screen, a shining ring and a small strong bulb are the only light."""
    slab()
    screen = material("Screen", (0.0, 0.0, 0.0), Roughness=0.5, Emission_Strength=3.0)
    u, v = texel_grid(64, 64)
    bars = np.stack([np.sin(u * 9) * 0.5 + 0.5, v, np.cos(u * 6 + v * 3) * 0.5 + 0.5], axis=-1)
    picture(screen, make_image("screen", bars), "Emission Color")
    place("Screen", box((1.4, 0.05, 0.9), scale=0.7, at=(0, 0, 0.5)), screen, at=(0, 0.7, 0.02), smooth=None)
    white = material("Clay", (0.75, 0.72, 0.68), Roughness=0.8)
    place("Ball", ball(0.3, 16, 32), white, at=(-0.3, -0.1, 0.3))
    bulb = material("Bulb", (0.0, 0.0, 0.0), Emission_Strength=60.0)
    principled(bulb).inputs["Emission Color"].default_value = (1.0, 0.7, 0.35, 1.0)
    place("Bulb", ball(0.07, 8, 16), bulb, at=(0.55, -0.35, 0.45))
    bpy.context.scene.world = None


def volume() -> None:
    """Absorbing liquid in glass, a free cloud of smoke, and both lit by a lamp and a dim sky."""
    slab()
    tea = material("Tea glass", (1.0, 1.0, 1.0), Roughness=0.0, IOR=1.33, Transmission_Weight=1.0)
    absorb = node(tea, "VolumeAbsorption", inputs={"Color": (0.9, 0.45, 0.12, 1.0), "Density": 3.0})
    wire(tea, absorb.outputs["Volume"], volume_output(tea))
    place("Tea", lathe(rounded_disc(0.3, 0.0, 0.7, 0.04), 24), tea, at=(-0.5, -0.2, 0.01))
    smoke = without_surface("Smoke")
    scatter = node(smoke, "VolumeScatter", inputs={"Color": (0.85, 0.9, 1.0, 1.0), "Density": 2.5, "Anisotropy": 0.3})
    wire(smoke, scatter.outputs["Volume"], volume_output(smoke))
    place("Smoke", ball(0.42, 10, 20), smoke, at=(0.45, 0.1, 0.5))
    fog = without_surface("Dark block")
    both = node(fog, "VolumePrincipled", inputs={"Color": (0.3, 0.3, 0.35, 1.0), "Density": 4.0})
    wire(fog, both.outputs["Volume"], volume_output(fog))
    place("Dark block", box((0.4, 0.4, 0.4), at=(0, 0, 0.2)), fog, at=(0.15, -0.75, 0.01), turn=(0, 0, 30), smooth=None)
    area_light("Lamp", (-1.0, -1.5, 2.2), (0, 0, 0.3), 60.0, (0.6, 0.6))
    flat_world((0.35, 0.42, 0.55), 0.8)


def still_life(scale: float) -> None:
    """Ball, box and glass under an area lamp, all lengths times ``scale``; radiance does not depend on it."""
    floor = slab()
    red = material("Red plastic", (0.6, 0.05, 0.04), Roughness=0.25)
    metal = material("Steel", (0.6, 0.62, 0.65), Metallic=1.0, Roughness=0.3)
    glass = material("Glass", (1.0, 1.0, 1.0), Roughness=0.0, IOR=1.5, Transmission_Weight=1.0)
    bodies = [
        floor,
        place("Ball", ball(0.35, 16, 32), red, at=(-0.4, -0.1, 0.35)),
        place("Box", box((0.45, 0.45, 0.7), bevel=0.03, at=(0, 0, 0.35)), metal, at=(0.45, 0.3, 0), turn=(0, 0, 30)),
        place("Glass ball", ball(0.24, 16, 32), glass, at=(0.2, -0.55, 0.25)),
    ]
    lamp = area_light("Lamp", (-1.2, -1.4, 2.2), (0, 0, 0.2), 90.0, (0.8, 0.8))
    flat_world((0.5, 0.6, 0.75), 0.5)
    view()
    eye = bpy.context.scene.camera
    for body in [*bodies, lamp, eye]:
        body.location *= scale
    for body in bodies:
        body.scale = (scale, scale, scale)
    lamp.data.size *= scale
    lamp.data.size_y *= scale
    lamp.data.energy *= scale**2  # power over area, so that radiance stays
    eye.data.clip_start, eye.data.clip_end = 0.01 * scale, 100 * scale


def view() -> None:
    """The view that all of them share."""
    camera((1.2, -3.6, 2.1), (0.0, 0.0, 0.28), lens=50)


SCENES: dict[str, Callable[[], None]] = {
    "all_glass": all_glass,
    "all_mirror": all_mirror,
    "emissive_only": emissive_only,
    "volume": volume,
    "tiny_scale": lambda: still_life(TINY),
    "huge_scale": lambda: still_life(HUGE),
}


def write(path: Path, build: Callable[[], None]) -> None:
    """Build into an empty scene and save."""
    new_scene()
    build()
    if bpy.context.scene.camera is None:
        view()
    # Blender saves eleven workspaces of its window with every file; one is enough, and 15 KB smaller.
    bpy.data.batch_remove([w for w in bpy.data.workspaces if w != bpy.context.window.workspace])
    save(path)


def main() -> None:
    """Write the six scenes, or one still life."""
    parser = argparse.ArgumentParser(description="Build the hard scenes")
    parser.add_argument(
        "output", type=Path, nargs="?", default=FOLDER / "hard", help="folder, or file for --still-life"
    )
    parser.add_argument("--still-life", type=float, metavar="SCALE")
    options = parser.parse_args()
    if options.still_life is not None:
        write(options.output, lambda: still_life(options.still_life))
        return
    for name, build in SCENES.items():
        write(options.output / f"{name}.blend", build)


if __name__ == "__main__":
    main()

"""Does the scene have light at all? If not, a neutral studio lights it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np

from ..geometry.frozen import FrozenMesh
from ..lighting.lights import visible_lights
from ..shading.sockets import find_input, resolve, surface_source, walk
from .names import find_material

STUDIO = "dnrpipe.studio"
STUDIO_SIZE = (128, 64)
DEFAULT_WORLD = 0.0509  # linear grey of the world in Blender's startup file
EMITTING = {"EMISSION": ("Color", "Strength"), "BSDF_PRINCIPLED": ("Emission Color", "Emission Strength")}
DARK = "no lamp, no world that shines, no emissive surface"


def ensure_light(scene: bpy.types.Scene, meshes: Sequence[FrozenMesh]) -> list[str]:
    """Light ``scene`` with a neutral studio environment where nobody has lit it; say so in one line."""
    if has_light(scene, meshes):
        return []
    default = _is_default_world(scene.world)
    scene.world = studio_world()
    why = "but Blender's dim default world; give that a colour of its own to keep it" if default else DARK
    return [f"scene '{scene.name}' has no light ({why}): a neutral studio environment lights it"]


def has_light(scene: bpy.types.Scene, meshes: Sequence[FrozenMesh]) -> bool:
    """Whether a lamp, the world or an emissive material of a visible surface gives light.

    Linked (textured) inputs count as light; only plain zeros and blacks count as dark, and the world that Blender
    puts into every new scene (a grey of 0.05).
    """
    world = _world(scene.world) and not _is_default_world(scene.world)
    lamps = [obj.data for obj, _ in visible_lights(scene)]
    return world or any(lamp.energy > 0 and max(lamp.color) > 0 for lamp in lamps) or _surfaces(meshes)


def studio_world() -> bpy.types.World:
    """A world whose environment image is `studio_radiance`, packed into the file."""
    width, height = STUDIO_SIZE
    image = bpy.data.images.new(STUDIO, width, height, alpha=False, float_buffer=True)
    image.colorspace_settings.name = "Linear Rec.709"
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = studio_radiance(width, height)[..., None]
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.file_format = "OPEN_EXR"
    image.pack()
    world = bpy.data.worlds.new(STUDIO)
    tree: Any = world.node_tree
    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputWorld")
    background = tree.nodes.new("ShaderNodeBackground")
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = image
    tree.links.new(texture.outputs["Color"], background.inputs["Color"])
    tree.links.new(background.outputs["Background"], output.inputs["Surface"])
    return world


def studio_radiance(width: int, height: int) -> np.ndarray:
    """Grey equirectangular radiance [height, width], float32, bottom row first: a soft dome with a key and a fill.

    Scaled so that a white diffuse floor has radiance 1. As in Blender's projection, column i of the image lies at
    azimuth pi - 2 pi (i + 0.5) / width.
    """
    azimuth = math.pi - 2 * math.pi * (np.arange(width) + 0.5) / width
    elevation = math.pi * ((np.arange(height) + 0.5) / height - 0.5)
    phi, theta = np.meshgrid(azimuth, elevation)
    direction = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.sin(theta)], axis=-1)
    dome = 0.35 + 0.35 * (1 + direction[..., 2]) / 2
    radiance = dome + 3.0 * _lobe(direction, -100, 50, 22) + 0.8 * _lobe(direction, 40, 25, 30)
    # Irradiance of an upward floor: sum of L cos(zenith) over the upper half; texel's solid angle by its row.
    solid = (2 * math.pi / width) * (math.pi / height) * np.cos(theta)
    irradiance = float((radiance * np.maximum(direction[..., 2], 0) * solid).sum())
    return (radiance * math.pi / irradiance).astype(np.float32)


def _lobe(direction: np.ndarray, azimuth: float, elevation: float, width: float) -> np.ndarray:
    """Gaussian of the angle to a direction; degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    axis = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    angle = np.arccos(np.clip(direction @ axis, -1, 1))
    return np.exp(-0.5 * (angle / math.radians(width)) ** 2)


def _world(world: bpy.types.World | None) -> bool:
    if world is None:
        return False
    if world.node_tree is None:
        return max(world.color) > 0
    return surface_source(world.node_tree) is not None and any(
        _emits(node, "Color", "Strength") for node in walk(world.node_tree) if node.type == "BACKGROUND"
    )


def _is_default_world(world: Any) -> bool:
    """One Background of Blender's startup grey at strength 1, nothing linked."""
    if world is None:
        return False
    if world.node_tree is None:
        return bool(np.allclose(list(world.color), DEFAULT_WORLD, atol=1e-3))
    source = surface_source(world.node_tree)
    if source is None or source.node.type != "BACKGROUND":
        return False
    colour = resolve(source.node.inputs["Color"], source.scope)
    strength = resolve(source.node.inputs["Strength"], source.scope)
    if colour.linked or strength.linked or abs(strength.number - 1) > 1e-3:
        return False
    return bool(np.allclose(colour.colour, DEFAULT_WORLD, atol=1e-3))


def _surfaces(meshes: Sequence[FrozenMesh]) -> bool:
    names = {mesh.materials[i] for mesh in meshes for i in set(mesh.material_index.tolist())}
    materials = [find_material(name) for name in names if name is not None]
    trees = [material.node_tree for material in materials if material and surface_source(material.node_tree)]
    nodes = [node for tree in trees for node in walk(tree) if not node.mute and node.type in EMITTING]
    return any(_emits(node, *EMITTING[node.type]) for node in nodes)


def _emits(node: bpy.types.Node, colour: str, strength: str) -> bool:
    inputs = find_input(node, colour), find_input(node, strength)
    if None in inputs:
        return False
    bright, strong = (resolve(socket) for socket in inputs)
    return (bright.linked or max(bright.colour) > 0) and (strong.linked or strong.number > 0)

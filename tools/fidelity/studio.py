"""What the scene builders share: camera, sky, floor, subjects, materials, images. bpy only.

Everything around the feature under test is something both renderers agree on to the noise: a diffuse floor and a
float environment image (or the lamp under test).
"""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

Rgb = tuple[float, float, float]
GREY: Rgb = (0.5, 0.5, 0.5)
CLAY: Rgb = (0.62, 0.36, 0.22)


def empty() -> Any:
    """An empty file with a camera that looks down at the subjects; plain sRGB display. Called before each builder."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene: Any = bpy.context.scene
    scene.view_settings.view_transform = "Standard"
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (0.5, -4.1, 2.3)
    camera.rotation_euler = (Vector((0.05, 0.0, 0.42)) - camera.location).to_track_quat("-Z", "Y").to_euler()
    camera.data.lens = 52
    scene.collection.objects.link(camera)
    scene.camera = camera
    return scene


def lit(material: Any, *, floor_material: Any = None) -> None:
    """The standard set: sky, floor, a ball and a bevelled box of ``material``."""
    sky()
    floor(floor_material)
    subjects(material)


# ---------------------------------------------------------------- light


def world() -> Any:
    """A new world. The size of its importance map is fixed: choosing it takes Cycles seconds a render."""
    made: Any = bpy.data.worlds.new("World")
    made.use_nodes = True
    made.cycles.sampling_method, made.cycles.sample_map_resolution = "MANUAL", 256
    bpy.context.scene.world = made
    return made


def constant_world(colour: Rgb = (1, 1, 1), strength: float = 0.6) -> Any:
    made = world()
    background = made.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (*colour, 1)
    background.inputs["Strength"].default_value = strength
    return made


def sky_pixels() -> np.ndarray:
    """Linear [96, 192, 3], rows bottom up: a grey-blue dome with a warm and a cool soft box, soft edges."""
    v, u = np.mgrid[0:96, 0:192]
    elevation = (v + 0.5) / 96 * 2 - 1
    pixels = np.repeat((0.22 + 0.12 * elevation)[..., None], 3, axis=2) * np.array([0.95, 1.0, 1.1])

    def box(cu: float, cv: float, wu: float, wv: float, colour: Rgb) -> np.ndarray:
        across = 1 / (1 + np.exp((np.abs((u - cu + 96) % 192 - 96) - wu) / 0.8))
        up = 1 / (1 + np.exp((np.abs(v - cv) - wv) / 0.8))
        return (across * up)[..., None] * np.array(colour)

    pixels = pixels + box(62, 70, 13, 9, (3.2, 2.5, 1.8)) + box(150, 62, 7, 13, (0.9, 1.5, 2.4))
    return pixels.astype(np.float32)


def sky(rotation: Rgb = (0, 0, 0), kind: str = "POINT", strength: float = 1.0) -> None:
    """Environment image through a Mapping node."""
    made = world()
    tree = made.node_tree
    tree.nodes["Background"].inputs["Strength"].default_value = strength
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    node.image = image("sky", sky_pixels(), is_float=True)
    mapping, coordinates = tree.nodes.new("ShaderNodeMapping"), tree.nodes.new("ShaderNodeTexCoord")
    mapping.vector_type = kind
    mapping.inputs["Rotation"].default_value = rotation
    tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], node.inputs["Vector"])
    tree.links.new(node.outputs["Color"], tree.nodes["Background"].inputs["Color"])


def lamp(kind: str, energy: float, location: Rgb, target: Rgb = (0, 0, 0.3), **fields: Any) -> Any:
    """A lamp at ``location`` that shines at ``target``."""
    data: Any = bpy.data.lights.new(kind, kind)
    data.energy = energy
    for key, value in fields.items():
        setattr(data, key, value)
    body = bpy.data.objects.new(kind, data)
    body.location = location
    body.rotation_euler = (Vector(target) - Vector(location)).to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(body)
    return body


def lamp_set(kind: str, energy: float, location: Rgb, **fields: Any) -> Any:
    """Diffuse floor and subjects under one lamp, nothing else."""
    floor()
    subjects(diffuse("Clay", CLAY))
    return lamp(kind, energy, location, **fields)


# ---------------------------------------------------------------- subjects


def floor(material: Any = None, size: float = 3.4) -> Any:
    bpy.ops.mesh.primitive_plane_add(size=size)
    body: Any = bpy.context.object
    body.name = "Floor"
    body.data.materials.append(material or diffuse("Floor", GREY))
    return body


def ball(material: Any, location: Rgb = (-0.58, -0.05, 0.6), radius: float = 0.6) -> Any:
    bpy.ops.mesh.primitive_uv_sphere_add(segments=128, ring_count=64, radius=radius, location=location)
    bpy.ops.object.shade_smooth()
    body: Any = bpy.context.object
    body.name = "Ball"
    if material:
        body.data.materials.append(material)
    return body


def box(material: Any, location: Rgb = (0.72, 0.05, 0.45), size: float = 0.86) -> Any:
    """A cube with bevelled edges, turned, just above the floor: coincident faces have no right answer."""
    bpy.ops.mesh.primitive_cube_add(size=size, location=location, rotation=(0, 0, 0.6))
    body: Any = bpy.context.object
    body.name = "Box"
    bevel = body.modifiers.new("Bevel", "BEVEL")
    bevel.width, bevel.segments = 0.09, 4
    if material:
        body.data.materials.append(material)
    return body


def subjects(material: Any) -> tuple[Any, Any]:
    return ball(material), box(material)


def smooth(body: Any) -> Any:
    body.data.polygons.foreach_set("use_smooth", np.ones(len(body.data.polygons), dtype=bool))
    return body


# ---------------------------------------------------------------- materials


def principled(name: str, colour: Rgb = CLAY, **inputs: Any) -> Any:
    """Principled BSDF; input names with underscores for blanks."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1)
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    return material


def matte(name: str = "Matte", colour: Rgb = CLAY) -> Any:
    """A Principled BSDF that is nothing but diffuse: its textures can be judged alone."""
    return principled(name, colour, Roughness=1.0, Specular_IOR_Level=0.0)


def diffuse(name: str, colour: Rgb) -> Any:
    return shader(name, "ShaderNodeBsdfDiffuse", Color=(*colour, 1))


def shader(name: str, kind: str, **inputs: Any) -> Any:
    """A material of one shader node."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.remove(tree.nodes["Principled BSDF"])
    add_shader(material, kind, "Surface", **inputs)
    return material


def add_shader(material: Any, kind: str, output: str | None = None, **inputs: Any) -> Any:
    """A further shader node, linked to the material output's socket ``output`` when given."""
    tree = material.node_tree
    node = tree.nodes.new(kind)
    for key, value in inputs.items():
        node.inputs[key.replace("_", " ")].default_value = value
    if output:
        tree.links.new(node.outputs[0], tree.nodes["Material Output"].inputs[output])
    return node


def node(material: Any, kind: str, **inputs: Any) -> Any:
    """A node of any kind with its inputs set."""
    return add_shader(material, kind, None, **inputs)


def link(material: Any, source: Any, target: Any) -> None:
    material.node_tree.links.new(source, target)


def into(material: Any, source: Any, socket: str = "Base Color") -> None:
    """Link ``source`` into the Principled BSDF."""
    link(material, source, material.node_tree.nodes["Principled BSDF"].inputs[socket])


def mixed(name: str, first: tuple[str, dict[str, Any]], second: tuple[str, dict[str, Any]]) -> tuple[Any, Any]:
    """(material, its Mix Shader node) of two shader nodes."""
    material = shader(name, first[0], **first[1])
    tree = material.node_tree
    mix = tree.nodes.new("ShaderNodeMixShader")
    one = next(n for n in tree.nodes if n.bl_idname == first[0])
    two = add_shader(material, second[0], None, **second[1])
    tree.links.new(one.outputs[0], mix.inputs[1])
    tree.links.new(two.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    return material, mix


# ---------------------------------------------------------------- images


def image(name: str, pixels: np.ndarray, *, data: bool = False, is_float: bool = False) -> Any:
    """Packed image from [H, W, 3 or 4], rows bottom up; 8 bits unless ``is_float``."""
    height, width = pixels.shape[:2]
    made: Any = bpy.data.images.new(name, width, height, alpha=True, float_buffer=is_float, is_data=data)
    if is_float:
        made.colorspace_settings.name = "Linear Rec.709"
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., : pixels.shape[2]] = pixels
    made.pixels.foreach_set(rgba.ravel())
    made.pack()
    return made


def image_node(material: Any, picture: Any, socket: str = "Base Color", *, output: str = "Color") -> Any:
    """Image Texture node into a socket of the Principled BSDF."""
    made = material.node_tree.nodes.new("ShaderNodeTexImage")
    made.image = picture
    into(material, made.outputs[output], socket)
    return made


def mapped(material: Any, picture_node: Any, **inputs: Rgb) -> Any:
    """UV -> Mapping (location, rotation, scale) -> the image node."""
    mapping = material.node_tree.nodes.new("ShaderNodeMapping")
    coordinates = material.node_tree.nodes.new("ShaderNodeTexCoord")
    for key, value in inputs.items():
        mapping.inputs[key.title()].default_value = value
    link(material, coordinates.outputs["UV"], mapping.inputs["Vector"])
    link(material, mapping.outputs["Vector"], picture_node.inputs["Vector"])
    return mapping


def chart(size: int = 256) -> np.ndarray:
    """sRGB codes [size, size, 3]: four colours, a ramp, rings and a letter-like mark: flips and shifts show."""
    v, u = np.mgrid[0:size, 0:size] / size
    pixels = np.zeros((size, size, 3), np.float32)
    pixels[...] = (0.85, 0.82, 0.75)
    pixels[(u < 0.5) & (v < 0.5)] = (0.8, 0.25, 0.2)
    pixels[(u >= 0.5) & (v >= 0.5)] = (0.2, 0.35, 0.75)
    pixels[(u >= 0.5) & (v < 0.5)] = np.repeat((0.15 + 0.75 * u[:, :, None]), 3, 2)[(u >= 0.5) & (v < 0.5)]
    rings = np.sin(40 * np.hypot(u - 0.25, v - 0.75)) * 0.5 + 0.5
    upper = (u < 0.5) & (v >= 0.5)
    pixels[upper] = np.stack([0.2 + 0.5 * rings, 0.75 * np.ones_like(rings), 0.3 + 0.4 * rings], -1)[upper]
    mark = ((u > 0.6) & (u < 0.66) & (v > 0.58) & (v < 0.92)) | ((u > 0.6) & (u < 0.85) & (v > 0.58) & (v < 0.64))
    pixels[mark] = (0.95, 0.85, 0.2)
    return pixels


def bumps(size: int = 256) -> np.ndarray:
    """A smooth height field [size, size] in [0, 1], periodic."""
    v, u = np.mgrid[0:size, 0:size] / size * 2 * math.pi
    return (0.5 + 0.25 * np.sin(4 * u) * np.cos(3 * v) + 0.25 * np.sin(2 * v + 1) * np.sin(5 * u)).astype(np.float32)

"""Image and procedural textures, their coordinates, and what they drive."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from . import studio as s
from .catalogue import scene

IMAGES = "Images"
SHAPE = "Normal and bump"
PROCEDURAL = "Procedural (baked)"


@scene("image, repeated", IMAGES)
def image_repeat() -> None:
    material = s.matte()
    s.mapped(material, s.image_node(material, s.image("chart", s.chart())), scale=(2.5, 2.5, 1))
    s.lit(material, floor_material=material)


@scene("image, clipped", IMAGES)
def image_clip() -> None:
    material = s.matte()
    picture = s.image_node(material, s.image("chart", s.chart()))
    picture.extension = "CLIP"
    s.mapped(material, picture, location=(-0.3, -0.2, 0), scale=(1.6, 1.6, 1))
    s.lit(material, floor_material=material)


@scene("image, mirrored", IMAGES)
def image_mirror() -> None:
    material = s.matte()
    picture = s.image_node(material, s.image("chart", s.chart()))
    picture.extension = "MIRROR"
    s.mapped(material, picture, scale=(2.5, 2.5, 1))
    s.lit(material, floor_material=material)


@scene("image, nearest texel", IMAGES)
def image_closest() -> None:
    material = s.matte()
    s.image_node(material, s.image("small", s.chart(16))).interpolation = "Closest"
    s.lit(material, floor_material=material)


@scene("image, cubic interpolation", IMAGES)
def image_cubic() -> None:
    material = s.matte()
    s.image_node(material, s.image("small", s.chart(16))).interpolation = "Cubic"
    s.lit(material, floor_material=material)


@scene("Mapping: moved, turned, scaled", IMAGES)
def image_mapping() -> None:
    material = s.matte()
    picture = s.image_node(material, s.image("chart", s.chart()))
    s.mapped(material, picture, location=(0.2, 0.1, 0), rotation=(0, 0, math.radians(30)), scale=(1.5, 0.8, 1))
    s.lit(material, floor_material=material)


@scene("alpha cut-out", IMAGES)
def image_alpha() -> None:
    pixels = np.ones((64, 64, 4), np.float32)
    pixels[..., :3] = s.chart(64)
    v, u = np.mgrid[0:64, 0:64]
    pixels[..., 3] = (np.hypot((u % 16) - 7.5, (v % 16) - 7.5) > 5).astype(np.float32)
    picture = s.image("holes", pixels)
    material = s.matte()
    s.image_node(material, picture)
    s.image_node(material, picture, "Alpha", output="Alpha")
    s.lit(material)


@scene("dark leaves cut out by an image, under lamps", IMAGES)
def leaves() -> None:
    v, u = np.mgrid[0:64, 0:64] / 31.5 - 1
    pixels = np.ones((64, 64, 4), np.float32)
    pixels[..., :3] = np.stack([0.2 + 0.1 * u, 0.3 + 0.1 * v, 0.1 + 0 * u], -1)
    pixels[..., 3] = np.clip((0.8 - np.hypot(u / (0.75 - 0.4 * v), v)) / 0.15, 0, 1)
    material = s.principled("Leaf", Roughness=0.35)
    picture = s.image("leaf", pixels)
    s.image_node(material, picture)
    s.image_node(material, picture, "Alpha", output="Alpha")
    s.constant_world(strength=0.05)
    s.floor()
    s.lamp("SUN", 2.0, (1.5, -1.0, 3.0), angle=0.02)
    s.lamp("AREA", 60, (-2.0, -1.0, 2.0), size=0.5)
    place = np.random.default_rng(3)
    for _ in range(70):
        bpy.ops.mesh.primitive_plane_add(
            size=0.5, location=place.uniform((-1, -0.7, 0.3), (1, 0.9, 1.3)), rotation=place.uniform(0, 6.3, 3)
        )
        bpy.context.object.data.materials.append(material)


@scene("non-colour image as roughness", IMAGES)
def image_roughness() -> None:
    material = s.principled("Patchy", (0.8, 0.8, 0.8), Metallic=1.0)
    s.image_node(material, s.image("roughness", 0.1 + 0.35 * s.chart(), data=True), "Roughness")
    s.lit(material, floor_material=material)


@scene("image as metallic", IMAGES)
def image_metallic() -> None:
    material = s.principled("Rust", (0.8, 0.5, 0.3), Roughness=0.3)
    s.image_node(material, s.image("metallic", (s.chart() > 0.5).astype(np.float32), data=True), "Metallic")
    s.lit(material)


@scene("UDIM tiles", IMAGES)
def image_udim() -> None:
    s.sky()
    folder = Path(tempfile.mkdtemp())
    for tile, flip in ((1001, False), (1002, True)):
        picture: Any = bpy.data.images.new(f"tile{tile}", 64, 64)
        rgba = np.ones((64, 64, 4), np.float32)
        rgba[..., :3] = s.chart(64)[..., ::-1] if flip else s.chart(64)
        picture.pixels.foreach_set(rgba.ravel())
        picture.filepath_raw, picture.file_format = str(folder / f"chart.{tile}.png"), "PNG"
        picture.save()
        bpy.data.images.remove(picture)
    tiled: Any = bpy.data.images.load(str(folder / "chart.1001.png"))
    tiled.source = "TILED"
    tiled.filepath = str(folder / "chart.<UDIM>.png")
    if len(tiled.tiles) < 2:
        tiled.tiles.new(1002)
    tiled.reload()
    tiled.pack()
    material = s.matte()
    s.image_node(material, tiled)
    for body in (s.floor(material), s.box(material)):
        uv = np.empty(2 * len(body.data.loops), np.float32)
        layer = body.data.uv_layers.active.uv
        layer.foreach_get("vector", uv)
        uv[0::2] *= 1.98
        layer.foreach_set("vector", uv)


@scene("second UV layer", IMAGES)
def second_uv() -> None:
    s.sky()
    material = s.matte()
    picture = s.image_node(material, s.image("chart", s.chart()))
    chosen = s.node(material, "ShaderNodeUVMap")
    chosen.uv_map = "Second"
    s.link(material, chosen.outputs[0], picture.inputs["Vector"])
    rough = s.image_node(material, s.image("rough", s.chart(64), data=True), "Roughness")
    assert rough
    for body in (s.floor(material), *s.subjects(material)):
        first = np.empty(2 * len(body.data.loops), np.float32)
        body.data.uv_layers.active.uv.foreach_get("vector", first)
        turned = np.stack([1.3 * first[1::2], 1 - 0.8 * first[0::2]], -1).astype(np.float32)
        body.data.uv_layers.new(name="Second").uv.foreach_set("vector", turned.ravel())


@scene("colour attribute", IMAGES)
def vertex_colours() -> None:
    s.sky()
    material = s.matte()
    s.into(material, s.node(material, "ShaderNodeVertexColor").outputs[0])
    s.floor()
    for body in s.subjects(material):
        layer = body.data.color_attributes.new("Paint", "FLOAT_COLOR", "POINT")
        for item, vertex in zip(layer.data, body.data.vertices, strict=True):
            x, y, z = vertex.co
            item.color = (
                0.5 + 0.45 * math.sin(5 * x),
                0.5 + 0.45 * math.sin(6 * y + 1),
                0.5 + 0.45 * math.cos(4 * z),
                1,
            )


@scene("image through Mix, Hue/Saturation and Gamma in a node group", IMAGES)
def node_group() -> None:
    material = s.matte()
    tree = material.node_tree
    picture = s.image_node(material, s.image("chart", s.chart()))
    group = bpy.data.node_groups.new("Grade", "ShaderNodeTree")
    group.interface.new_socket("Color", in_out="INPUT", socket_type="NodeSocketColor")
    group.interface.new_socket("Result", in_out="OUTPUT", socket_type="NodeSocketColor")
    inside, outside = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    hue, gamma, mix = (group.nodes.new(f"ShaderNode{k}") for k in ("HueSaturation", "Gamma", "Mix"))
    hue.inputs["Hue"].default_value, hue.inputs["Saturation"].default_value = 0.6, 0.8
    gamma.inputs["Gamma"].default_value = 1.4
    mix.data_type, mix.blend_type = "RGBA", "MULTIPLY"
    mix.inputs["Factor"].default_value = 0.6
    colours = [socket for socket in mix.inputs if socket.type == "RGBA"]
    colours[1].default_value = (0.9, 0.8, 0.5, 1)
    group.links.new(inside.outputs[0], hue.inputs["Color"])
    group.links.new(hue.outputs[0], gamma.inputs["Color"])
    group.links.new(gamma.outputs[0], colours[0])
    group.links.new(next(o for o in mix.outputs if o.type == "RGBA"), outside.inputs[0])
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = group
    tree.links.new(picture.outputs["Color"], node.inputs[0])
    s.into(material, node.outputs[0])
    s.lit(material, floor_material=material)


@scene("two images multiplied, different placement", IMAGES)
def two_images() -> None:
    material = s.matte()
    one, two, mix = (s.node(material, f"ShaderNode{k}") for k in ("TexImage", "TexImage", "Mix"))
    one.image, two.image = s.image("chart", s.chart()), s.image("shade", 0.3 + 0.7 * s.bumps()[..., None].repeat(3, 2))
    mix.data_type, mix.blend_type = "RGBA", "MULTIPLY"
    mix.inputs["Factor"].default_value = 1.0
    colours = [socket for socket in mix.inputs if socket.type == "RGBA"]
    s.mapped(material, two, scale=(3, 3, 1))
    s.link(material, one.outputs[0], colours[0])
    s.link(material, two.outputs[0], colours[1])
    s.into(material, next(o for o in mix.outputs if o.type == "RGBA"))
    s.lit(material, floor_material=material)


@scene("box projection", IMAGES)
def box_projection() -> None:
    material = s.matte()
    picture = s.image_node(material, s.image("chart", s.chart()))
    picture.projection, picture.projection_blend = "BOX", 0.2
    s.link(material, s.node(material, "ShaderNodeTexCoord").outputs["Object"], picture.inputs["Vector"])
    s.lit(material, floor_material=material)


@scene("normal map, tangent space", SHAPE)
def normal_map() -> None:
    material = s.principled("Embossed", (0.5, 0.5, 0.5), Roughness=0.4)
    height = s.bumps()
    slope = np.stack([-np.gradient(height, axis=1), -np.gradient(height, axis=0), np.full_like(height, 0.03)], -1)
    slope /= np.linalg.norm(slope, axis=-1, keepdims=True)
    picture = s.node(material, "ShaderNodeTexImage")
    picture.image = s.image("normals", slope * 0.5 + 0.5, data=True)
    bend = s.node(material, "ShaderNodeNormalMap", Strength=0.7)
    s.link(material, picture.outputs["Color"], bend.inputs["Color"])
    s.into(material, bend.outputs["Normal"], "Normal")
    s.lit(material, floor_material=material)


def _bumped(material: Any, source: Any, strength: float, distance: float) -> None:
    bump = s.node(material, "ShaderNodeBump", Strength=strength, Distance=distance)
    s.link(material, source, bump.inputs["Height"])
    s.into(material, bump.outputs["Normal"], "Normal")


@scene("bump from an image", SHAPE)
def bump_image() -> None:
    material = s.principled("Bumpy", (0.5, 0.5, 0.5), Roughness=0.4)
    picture = s.node(material, "ShaderNodeTexImage")
    picture.image = s.image("height", s.bumps()[..., None].repeat(3, 2), data=True)
    _bumped(material, picture.outputs["Color"], 0.8, 0.12)
    s.lit(material, floor_material=material)


@scene("bump from noise", SHAPE)
def bump_noise() -> None:
    material = s.principled("Bumpy", (0.5, 0.5, 0.5), Roughness=0.4)
    _bumped(material, s.node(material, "ShaderNodeTexNoise", Scale=6.0, Detail=1.0).outputs[0], 0.9, 0.25)
    s.lit(material)


@scene("Noise through ColorRamp", PROCEDURAL, formulas=("pink_dummy",))
def noise_ramp() -> None:
    material = s.matte()
    noise, ramp = s.node(material, "ShaderNodeTexNoise", Scale=4.0), s.node(material, "ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[0].position = (0.1, 0.25, 0.5, 1), 0.4
    ramp.color_ramp.elements[1].color, ramp.color_ramp.elements[1].position = (0.8, 0.6, 0.3, 1), 0.6
    s.link(material, noise.outputs["Fac"], ramp.inputs["Fac"])
    s.into(material, ramp.outputs["Color"])
    s.lit(material, floor_material=material)


@scene("Checker, generated coordinates", PROCEDURAL)
def checker() -> None:
    material = s.matte()
    checks = s.node(material, "ShaderNodeTexChecker", Scale=7.0, Color1=(0.8, 0.7, 0.5, 1), Color2=(0.1, 0.2, 0.4, 1))
    s.link(material, s.node(material, "ShaderNodeTexCoord").outputs["Generated"], checks.inputs["Vector"])
    s.into(material, checks.outputs["Color"])
    s.lit(material, floor_material=material)


@scene("Voronoi, object coordinates", PROCEDURAL)
def voronoi() -> None:
    material = s.matte()
    cells = s.node(material, "ShaderNodeTexVoronoi", Scale=5.0)
    s.link(material, s.node(material, "ShaderNodeTexCoord").outputs["Object"], cells.inputs["Vector"])
    s.into(material, cells.outputs["Color"])
    s.lit(material, floor_material=material)


@scene("Wave as metal roughness", PROCEDURAL)
def wave_roughness() -> None:
    material = s.principled("Turned", (0.8, 0.8, 0.85), Metallic=1.0)
    wave, span = s.node(material, "ShaderNodeTexWave", Scale=1.2), s.node(material, "ShaderNodeMapRange")
    span.inputs["To Min"].default_value, span.inputs["To Max"].default_value = 0.1, 0.4
    s.link(material, wave.outputs["Fac"], span.inputs["Value"])
    s.into(material, span.outputs[0], "Roughness")
    s.lit(material)


@scene("Mix of two colours by Brick", PROCEDURAL)
def brick() -> None:
    material = s.matte()
    bricks = s.node(material, "ShaderNodeTexBrick", Scale=4.0)
    s.link(material, s.node(material, "ShaderNodeTexCoord").outputs["UV"], bricks.inputs["Vector"])
    s.into(material, bricks.outputs["Color"])
    s.lit(material, floor_material=material)

"""Lamps, worlds, glowing surfaces."""

from __future__ import annotations

import math

import bpy

from . import studio as s
from .catalogue import scene

GROUP = "Lamps"
WORLD = "World"
GLOW = "Glowing surfaces"


@scene("point, radius 0", GROUP)
def point_r0() -> None:
    s.lamp_set("POINT", 90, (0.9, -1.2, 2.2), shadow_soft_size=0.0)


@scene("point, radius 0.3, soft falloff (default)", GROUP)
def point_soft() -> None:
    s.lamp_set("POINT", 90, (0.9, -1.2, 2.2), shadow_soft_size=0.3)


@scene("point, radius 0.3, hard falloff (true sphere)", GROUP)
def point_sphere() -> None:
    s.lamp_set("POINT", 90, (0.9, -1.2, 2.2), shadow_soft_size=0.3, use_soft_falloff=False)


@scene("point, 3500 K, exposure 1, colour", GROUP)
def point_temperature() -> None:
    s.lamp_set(
        "POINT",
        60,
        (0.9, -1.2, 2.2),
        shadow_soft_size=0.0,
        use_temperature=True,
        temperature=3500,
        exposure=1.0,
        color=(0.8, 1.0, 0.9),
    )


@scene("spot, hard edge", GROUP)
def spot_hard() -> None:
    s.lamp_set("SPOT", 220, (0.9, -1.2, 2.6), spot_size=math.radians(48), spot_blend=0.0, shadow_soft_size=0.0)


@scene("spot, blend 0.6", GROUP, formulas=("mitsuba_spot_falloff",))
def spot_blend() -> None:
    s.lamp_set("SPOT", 220, (0.9, -1.2, 2.6), spot_size=math.radians(60), spot_blend=0.6, shadow_soft_size=0.0)


@scene("spot, radius 0.2", GROUP)
def spot_radius() -> None:
    s.lamp_set("SPOT", 220, (0.9, -1.2, 2.6), spot_size=math.radians(60), spot_blend=0.3, shadow_soft_size=0.2)


@scene("area, square", GROUP, formulas=("area_quarter",))
def area_square() -> None:
    s.lamp_set("AREA", 60, (0.9, -1.0, 2.2), shape="SQUARE", size=0.9)


@scene("area, rectangle, scaled object", GROUP, formulas=("area_quarter",))
def area_rectangle() -> None:
    body = s.lamp_set("AREA", 60, (0.9, -1.0, 2.2), shape="RECTANGLE", size=0.8, size_y=0.3)
    body.scale = (1.5, 0.8, 1.0)


@scene("area, disk", GROUP, formulas=("area_quarter",))
def area_disk() -> None:
    s.lamp_set("AREA", 60, (0.9, -1.0, 2.2), shape="DISK", size=0.9)


@scene("area, ellipse", GROUP, formulas=("area_quarter",))
def area_ellipse() -> None:
    s.lamp_set("AREA", 60, (0.9, -1.0, 2.2), shape="ELLIPSE", size=1.2, size_y=0.4)


@scene("area, spread 60 degrees", GROUP)
def area_spread() -> None:
    s.lamp_set("AREA", 14, (0.9, -1.0, 2.2), shape="SQUARE", size=0.9, spread=math.radians(60))


@scene("sun, angle 0", GROUP)
def sun_hard() -> None:
    s.lamp_set("SUN", 3.0, (1.5, -1.5, 3.0), angle=0.0)


@scene("sun, angle 12 degrees", GROUP)
def sun_soft() -> None:
    s.lamp_set("SUN", 3.0, (1.5, -1.5, 3.0), angle=math.radians(12))


@scene("area lamp seen in a mirror, not by the camera", GROUP)
def lamp_in_mirror() -> None:
    s.floor()
    s.subjects(s.principled("Mirror", (0.9, 0.9, 0.9), Metallic=1.0, Roughness=0.05))
    s.lamp("AREA", 25, (0.5, -1.2, 2.0), shape="SQUARE", size=1.0)
    s.lamp("AREA", 10, (0.0, 1.6, 1.4), target=(0, 0, 0.6), shape="SQUARE", size=1.0)


@scene("constant", WORLD)
def world_constant() -> None:
    s.constant_world((0.9, 1.0, 1.1))
    s.floor()
    s.subjects(s.diffuse("Clay", s.CLAY))


def _mirror_set() -> None:
    s.floor()
    s.subjects(s.principled("Chrome", (0.85, 0.85, 0.85), Metallic=1.0, Roughness=0.1))


@scene("environment image, turned about Z", WORLD)
def hdri_turned() -> None:
    s.sky((0, 0, math.radians(70)), strength=1.3)
    _mirror_set()


@scene("environment image, tilted (Texture mapping)", WORLD)
def hdri_tilted() -> None:
    s.sky((math.radians(35), math.radians(-20), math.radians(110)), kind="TEXTURE")
    _mirror_set()


@scene("Sky Texture with sun disc", WORLD)
def sky_texture() -> None:
    made = s.world()
    made.cycles.sampling_method = "AUTOMATIC"
    tree = made.node_tree
    tree.nodes["Background"].inputs["Strength"].default_value = 0.03
    node = tree.nodes.new("ShaderNodeTexSky")
    node.sun_elevation, node.sun_rotation = math.radians(35), math.radians(150)
    tree.links.new(node.outputs[0], tree.nodes["Background"].inputs["Color"])
    s.floor()
    s.subjects(s.diffuse("Clay", s.CLAY))


@scene("Sky Texture without sun disc", WORLD)
def sky_texture_soft() -> None:
    tree = s.world().node_tree
    tree.nodes["Background"].inputs["Strength"].default_value = 0.1
    node = tree.nodes.new("ShaderNodeTexSky")
    node.sun_disc, node.sun_elevation = False, math.radians(35)
    tree.links.new(node.outputs[0], tree.nodes["Background"].inputs["Color"])
    _mirror_set()


@scene("gradient nodes", WORLD)
def world_gradient() -> None:
    tree = s.world().node_tree
    gradient, coordinates = tree.nodes.new("ShaderNodeTexGradient"), tree.nodes.new("ShaderNodeTexCoord")
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color = (0.9, 0.2, 0.1, 1)
    ramp.color_ramp.elements[1].color = (0.1, 0.3, 1.2, 1)
    tree.links.new(coordinates.outputs["Generated"], gradient.inputs["Vector"])
    tree.links.new(gradient.outputs["Fac"], ramp.inputs["Fac"])
    tree.links.new(ramp.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    _mirror_set()


@scene("closed mesh (ball), out of view", GLOW)
def glow_closed() -> None:
    s.floor()
    s.box(s.diffuse("Clay", s.CLAY))
    s.ball(s.shader("Lamp", "ShaderNodeEmission", Color=(1, 0.7, 0.4, 1), Strength=14.0), (-1.2, -1.2, 2.3), 0.3)


@scene("closed mesh in view", GLOW)
def glow_in_view() -> None:
    s.floor()
    s.box(s.diffuse("Clay", s.CLAY))
    s.ball(s.shader("Lamp", "ShaderNodeEmission", Color=(1, 0.7, 0.4, 1), Strength=0.9))


@scene("open sheet (shines from both sides)", GLOW)
def glow_open() -> None:
    s.floor()
    s.subjects(s.diffuse("Clay", s.CLAY))
    bpy.ops.mesh.primitive_plane_add(size=1.1, location=(0.1, 0.15, 0.85), rotation=(0, math.radians(90), 0.2))
    material = s.shader("Sheet", "ShaderNodeEmission", Color=(0.6, 0.8, 1, 1), Strength=3.0)
    bpy.context.object.data.materials.append(material)


@scene("image as emission", GLOW)
def glow_image() -> None:
    s.constant_world(strength=0.15)
    material = s.principled("Screen", (0, 0, 0), Roughness=1.0, Specular_IOR_Level=0.0, Emission_Strength=1.2)
    s.image_node(material, s.image("screen", s.chart()), "Emission Color")
    s.floor()
    s.box(material)
    s.ball(s.diffuse("Clay", s.CLAY))

"""Geometry and cameras: what reaches the ray tracer as triangles, and from where it is seen."""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np

from . import studio as s
from .catalogue import scene

GROUP = "Geometry"
CAMERA = "Camera"


def _stage() -> None:
    s.sky()
    s.floor()


@scene("collection instances, mirrored and scaled", GROUP)
def instances() -> None:
    _stage()
    group = bpy.data.collections.new("Group")
    bpy.ops.mesh.primitive_cone_add(vertices=24, radius1=0.22, depth=0.6, location=(0.1, 0, 0.3), rotation=(0, 0.5, 0))
    cone = bpy.context.object
    cone.data.materials.append(s.principled("Plastic", Roughness=0.3))
    bpy.context.scene.collection.objects.unlink(cone)
    group.objects.link(cone)
    for index in range(9):
        holder = bpy.data.objects.new(f"Instance {index}", None)
        holder.instance_type, holder.instance_collection = "COLLECTION", group
        holder.location = (index % 3 - 1.0, index // 3 * 0.8 - 0.8, 0)
        holder.scale = (-1 if index % 2 else 1, 1, 0.7 + 0.1 * index)
        holder.rotation_euler = (0, 0, 0.7 * index)
        bpy.context.scene.collection.objects.link(holder)


@scene("smooth shading over a sharp rim", GROUP)
def smooth_sharp() -> None:
    _stage()
    bpy.ops.mesh.primitive_cone_add(vertices=24, radius1=0.6, depth=1.2, location=(0, 0, 0.75), rotation=(0, 0.6, 0))
    s.smooth(bpy.context.object).data.materials.append(s.diffuse("Clay", s.CLAY))


@scene("geometry-nodes instances (400)", GROUP)
def node_instances() -> None:
    _stage()
    body = s.ball(s.diffuse("Clay", s.CLAY), (0, 0, 0.7), 0.6)
    modifier = body.modifiers.new("Scatter", "NODES")
    tree = bpy.data.node_groups.new("Scatter", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    source, sink = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    points, place = (
        tree.nodes.new("GeometryNodeDistributePointsOnFaces"),
        tree.nodes.new("GeometryNodeInstanceOnPoints"),
    )
    cube, join = tree.nodes.new("GeometryNodeMeshCube"), tree.nodes.new("GeometryNodeJoinGeometry")
    painted = tree.nodes.new("GeometryNodeSetMaterial")
    painted.inputs["Material"].default_value = s.principled("Blue", (0.1, 0.3, 0.6), Roughness=0.4)
    points.inputs["Density"].default_value = 90.0
    cube.inputs["Size"].default_value = (0.05, 0.05, 0.16)
    for out, into in (
        (source.outputs[0], points.inputs["Mesh"]),
        (points.outputs["Points"], place.inputs["Points"]),
        (points.outputs["Rotation"], place.inputs["Rotation"]),
        (cube.outputs["Mesh"], painted.inputs["Geometry"]),
        (painted.outputs[0], place.inputs["Instance"]),
        (source.outputs[0], join.inputs[0]),
        (place.outputs[0], join.inputs[0]),
        (join.outputs[0], sink.inputs[0]),
    ):
        tree.links.new(out, into)
    modifier.node_group = tree


@scene("particle hair", GROUP, samples=2)
def hair() -> None:
    _stage()
    body = s.ball(s.diffuse("Skin", (0.6, 0.4, 0.3)), (0, 0, 0.75), 0.5)
    body.data.materials.append(s.diffuse("Hair", (0.25, 0.12, 0.04)))
    system = body.modifiers.new("Hair", "PARTICLE_SYSTEM").particle_system
    settings = system.settings
    settings.type, settings.count, settings.hair_length = "HAIR", 900, 0.35
    settings.material, settings.root_radius, settings.tip_radius, settings.radius_scale = 2, 1.0, 0.4, 0.02


def _pelt(material: Any, strands: int, length: float) -> None:
    """A ball with dense hair of ``material``, under the sky and an area lamp."""
    _stage()
    s.lamp("AREA", 120, (2.0, -1.5, 3.0), size=0.6)
    body = s.ball(s.diffuse("Skin", (0.6, 0.4, 0.3)), (0, 0, 0.75), 0.45)
    body.data.materials.append(material)
    settings = body.modifiers.new("Hair", "PARTICLE_SYSTEM").particle_system.settings
    settings.type, settings.count, settings.hair_length = "HAIR", strands, length
    settings.child_type, settings.rendered_child_count, settings.child_radius = "SIMPLE", 10, 0.08
    settings.material, settings.root_radius, settings.tip_radius, settings.radius_scale = 2, 1.0, 0.2, 0.01


@scene("dense hair, Principled BSDF", GROUP, samples=2)
def hair_principled() -> None:
    _pelt(s.principled("Fur", (0.35, 0.2, 0.1)), 1500, 0.3)


@scene("dense hair, Principled Hair BSDF", GROUP, samples=2)
def hair_fibres() -> None:
    _pelt(s.shader("Fur", "ShaderNodeBsdfHairPrincipled"), 1500, 0.3)


@scene("dense hair, Diffuse BSDF", GROUP, samples=2)
def hair_diffuse() -> None:
    _pelt(s.diffuse("Fur", (0.6, 0.5, 0.4)), 1500, 0.3)


@scene("smooth terrain of steep slopes, low sun", GROUP)
def terrain() -> None:
    s.constant_world((0.6, 0.75, 1.0), 0.3)
    s.lamp("SUN", 3.0, (3.0, -1.0, 1.2), angle=0.01)
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=96, y_subdivisions=96, size=3.4)
    body = s.smooth(bpy.context.object)
    heights = np.empty(len(body.data.vertices) * 3, np.float32)
    body.data.vertices.foreach_get("co", heights)
    points = heights.reshape(-1, 3)
    x, y = points[:, 0], points[:, 1]
    waves = (((5, 3, 0), 0.22), ((-9, 13, 1), 0.12), ((23, 17, 2), 0.06), ((-41, 37, 3), 0.03))
    points[:, 2] = 0.4 + sum(h * np.sin(a * x + c) * np.sin(b * y + 2 * c) for (a, b, c), h in waves)
    body.data.vertices.foreach_set("co", heights)
    body.data.materials.append(s.principled("Rock", (0.35, 0.3, 0.25), Roughness=0.8))


@scene("Displace modifier", GROUP)
def displace_modifier() -> None:
    _stage()
    body = s.ball(s.principled("Plastic", Roughness=0.4), (0, 0, 0.75), 0.65)
    modifier = body.modifiers.new("Displace", "DISPLACE")
    modifier.texture = bpy.data.textures.new("Clouds", "CLOUDS")
    modifier.texture.noise_scale, modifier.strength = 0.4, 0.35


@scene("Displacement node (true displacement)", GROUP)
def displacement_node() -> None:
    _stage()
    material = s.principled("Waves", Roughness=0.5)
    material.displacement_method = "DISPLACEMENT"
    wave = s.node(material, "ShaderNodeTexWave", Scale=1.5)
    height = s.node(material, "ShaderNodeDisplacement", Scale=0.15)
    s.link(material, wave.outputs["Fac"], height.inputs["Height"])
    s.link(material, height.outputs[0], material.node_tree.nodes["Material Output"].inputs["Displacement"])
    s.ball(material, (0, 0, 0.75), 0.65)


@scene("curve with bevel", GROUP)
def curve() -> None:
    _stage()
    data = bpy.data.curves.new("Curve", "CURVE")
    data.dimensions, data.bevel_depth, data.bevel_resolution, data.resolution_u = "3D", 0.07, 4, 16
    spline = data.splines.new("BEZIER")
    spline.bezier_points.add(5)
    for index, point in enumerate(spline.bezier_points):
        point.co = (index * 0.45 - 1.1, 0.6 * math.sin(1.7 * index), 0.4 + 0.3 * math.cos(2.1 * index))
        point.handle_left_type = point.handle_right_type = "AUTO"
    data.materials.append(s.principled("Plastic", Roughness=0.3))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Curve", data))


@scene("text, extruded", GROUP)
def text() -> None:
    _stage()
    data = bpy.data.curves.new("Text", "FONT")
    data.body, data.extrude, data.bevel_depth, data.size, data.align_x = "Rays", 0.1, 0.015, 1.1, "CENTER"
    data.materials.append(s.principled("Plastic", Roughness=0.3))
    body = bpy.data.objects.new("Text", data)
    body.location, body.rotation_euler = (0, 0, 0.05), (math.radians(80), 0, 0.1)
    bpy.context.scene.collection.objects.link(body)


@scene("metaballs", GROUP)
def metaballs() -> None:
    _stage()
    data = bpy.data.metaballs.new("Meta")
    data.resolution, data.render_resolution = 0.1, 0.04
    for place in ((-0.5, 0, 0.6), (0.25, 0.1, 0.7), (0.7, -0.2, 0.5)):
        element = data.elements.new()
        element.co, element.radius = place, 0.75
    data.materials.append(s.principled("Plastic", Roughness=0.3))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Meta", data))


@scene("several materials on one mesh", GROUP)
def material_slots() -> None:
    _stage()
    body = s.ball(s.diffuse("Red", (0.7, 0.1, 0.1)), (0, 0, 0.75), 0.7)
    body.data.materials.append(s.principled("Steel", (0.6, 0.6, 0.65), Metallic=1.0, Roughness=0.2))
    for polygon in body.data.polygons:
        polygon.material_index = (polygon.index // 16) % 2


@scene("shift, landscape frame", CAMERA, size=(120, 72))
def camera_shift() -> None:
    s.lit(s.diffuse("Clay", s.CLAY))
    camera = bpy.context.scene.camera.data
    camera.shift_x, camera.shift_y, camera.lens = 0.12, -0.07, 40


@scene("vertical sensor fit, portrait frame", CAMERA, size=(72, 120))
def camera_portrait() -> None:
    s.lit(s.diffuse("Clay", s.CLAY))
    camera = bpy.context.scene.camera.data
    camera.sensor_fit, camera.sensor_height, camera.lens = "VERTICAL", 30.0, 45


@scene("depth of field", CAMERA)
def camera_dof() -> None:
    s.lit(s.diffuse("Clay", s.CLAY))
    camera = bpy.context.scene.camera.data
    camera.dof.use_dof, camera.dof.focus_distance, camera.dof.aperture_fstop = True, 3.2, 0.12

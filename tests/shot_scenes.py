"""Small shots: still scenes with one thing in them that changes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import bpy
from tests.nasty_scenes import cube, empty, link, material, save


def still() -> tuple[Any, Any]:
    """A floor, a block, a lamp and two cameras, of which "wide" is active: (scene, that camera)."""
    empty()
    scene: Any = bpy.context.scene
    cube("floor").scale = (4, 4, 0.1)
    cube("block").location = (-2, 1, 1)
    lamp = link("lamp", bpy.data.lights.new("lamp", "POINT"))
    lamp.location, lamp.data.energy = (2, -2, 5), 300
    for name, place in (("wide", (0, -9, 1.5)), ("close", (3, -5, 1.0))):
        camera = link(name, bpy.data.cameras.new(name))
        camera.location, camera.rotation_euler = place, (math.radians(85), 0, 0)
        scene.camera = scene.camera or camera
    scene.frame_start, scene.frame_end = 1, 5
    scene.render.resolution_x, scene.render.resolution_y = 320, 180
    return scene, scene.camera


def cameras(folder: Path) -> Path:
    """Lens, sensor and shift keyed, a driver on the scene's frame, oblong pixels, half size, markers."""
    scene, wide = still()
    render = scene.render
    render.pixel_aspect_x, render.pixel_aspect_y, render.resolution_percentage = 1.0, 1.5, 50
    render.fps, render.fps_base = 30, 1.001
    for frame, lens, sensor, shift in ((1, 30, 36, 0.0), (5, 50, 28, 0.2)):
        for name, value in (("lens", lens), ("sensor_width", sensor), ("shift_x", shift), ("shift_y", -shift)):
            setattr(wide.data, name, value)
            wide.data.keyframe_insert(name, frame=frame)
    driver = wide.driver_add("location", 0).driver
    variable = driver.variables.new()
    variable.name, variable.targets[0].id_type, variable.targets[0].id = "now", "SCENE", scene
    variable.targets[0].data_path, driver.expression = "frame_current", "now * 0.1"
    scene.timeline_markers.new("a", frame=2).camera = wide
    scene.timeline_markers.new("b", frame=4).camera = bpy.data.objects["close"]
    flat = link("flat", bpy.data.cameras.new("flat"))
    flat.data.type = "ORTHO"
    return save(folder / "cameras.blend")


def rolling(folder: Path) -> Path:
    """A red sphere, rough and bumpy by noise, rolls two units to the right from frame 2 to 4.

    The camera moves all the time, on an empty that nothing else hangs on.
    """
    _roll()
    return save(folder / "rolling.blend")


def fading(folder: Path) -> Path:
    """The rolling sphere, and a block whose roughness, noise by a keyed number, falls to a tenth at frame 5.

    There the floor is gone, and another block has come, whose name is the first one.
    """
    _roll()
    keyed(bpy.data.objects["floor"], "hide_render", {4: False, 5: True})
    keyed(cube("arch"), "hide_render", {4: True, 5: False})
    paint = material("paint")
    tree = paint.node_tree
    noise, factor = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeMath")
    factor.operation = "MULTIPLY"
    keyed(factor.inputs[1], "default_value", {2: 1.0, 5: 0.1})
    tree.links.new(noise.outputs["Fac"], factor.inputs[0])
    tree.links.new(factor.outputs[0], tree.nodes["Principled BSDF"].inputs["Roughness"])
    bpy.data.objects["block"].data.materials.append(paint)
    bpy.context.scene.frame_set(1)
    return save(folder / "fading.blend")


def vanishing(folder: Path) -> Path:
    """Floor and block are hidden in frames 3, 4 and 6."""
    still()
    for name in ("floor", "block"):
        keyed(bpy.data.objects[name], "hide_render", {1: False, 3: True, 5: False, 6: True})
    bpy.context.scene.frame_set(1)
    return save(folder / "vanishing.blend")


def _roll() -> None:
    scene, wide = still()
    bpy.ops.mesh.primitive_uv_sphere_add(segments=16, ring_count=8, radius=1, location=(0, 0, 1))
    ball = bpy.context.object
    ball.name = "ball"
    skin = material("skin", colour=(0.8, 0.02, 0.02))
    principled = skin.node_tree.nodes["Principled BSDF"]
    noise, bump = (skin.node_tree.nodes.new(f"ShaderNode{name}") for name in ("TexNoise", "Bump"))
    for output, socket in (
        (noise.outputs["Fac"], principled.inputs["Roughness"]),
        (noise.outputs["Fac"], bump.inputs["Height"]),
        (bump.outputs["Normal"], principled.inputs["Normal"]),
    ):
        skin.node_tree.links.new(output, socket)
    ball.data.materials.append(skin)
    for frame, x in ((2, 0.0), (4, 2.0)):
        ball.location.x, ball.rotation_euler.y = x, x
        ball.keyframe_insert("location", frame=frame)
        ball.keyframe_insert("rotation_euler", frame=frame)
    wide.parent = rig = link("rig", None)
    keyed(rig, "location", {1: (0.1, 0, 0), 5: (0.5, 0, 0)})
    scene.frame_set(1)


def keyed(block: Any, path: str, values: dict[int, Any]) -> None:
    """Keys of a property, by frame."""
    for frame, value in values.items():
        setattr(block, path, value)
        block.keyframe_insert(path, frame=frame)


def driven(obj: Any, expression: str) -> None:
    obj.driver_add("location", 0).driver.expression = expression


def menagerie(folder: Path) -> Path:
    """One of everything that may change, and of what looks like it and does not; frames 1 to 4."""
    scene, wide = still()
    scene.frame_end = 4
    paint = material("paint", colour=(0.1, 0.1, 0.1))
    keyed(paint.node_tree.nodes["Principled BSDF"].inputs["Roughness"], "default_value", {1: 0.2, 2: 0.2, 4: 0.9})
    cube("painted", paint)
    unlinked = material("unlinked")
    keyed(unlinked.node_tree.nodes.new("ShaderNodeRGB").outputs[0], "default_value", {1: (0, 0, 0, 1), 4: (1, 1, 1, 1)})
    cube("unlinked", unlinked)
    keyed(bpy.data.objects["lamp"].data, "energy", {3: 300, 4: 500})
    scene.world = bpy.data.worlds.new("sky")
    strength = scene.world.node_tree.nodes["Background"].inputs["Strength"]
    keyed(strength, "default_value", {1: 1.0, 4: 2.0})
    shaped = cube("shaped")
    shaped.shape_key_add(name="basis")
    shaped.shape_key_add(name="tall").points[3].co.z = 3
    keyed(shaped.data.shape_keys.key_blocks["tall"], "value", {2: 0.0, 3: 1.0})
    keyed(cube("blinking"), "hide_render", {1: False, 2: True, 3: False})
    keyed(cube("hidden"), "location", {1: (0, 0, 0), 4: (5, 0, 0)})
    bpy.data.objects["hidden"].hide_render = True
    keyed(cube("steady"), "location", {1: (1, 0, 0), 4: (1, 0, 0)})
    driven(cube("driven"), "frame * 0.1")
    cube("child").parent = bpy.data.objects["driven"]
    group = bpy.data.collections.new("group")
    group.objects.link(member := cube("member"))
    scene.collection.objects.unlink(member)
    keyed(member, "scale", {3: (1, 1, 1), 4: (2, 1, 1)})
    copy = link("copies", None)
    copy.instance_type, copy.instance_collection = "COLLECTION", group
    waving = cube("waving").modifiers.new("wave", "WAVE")
    waving.height, waving.time_offset = 1.0, -20
    _timed_nodes(cube("nodes"))
    sign = cube("sign").constraints.new("TRACK_TO")
    sign.target = wide
    target = link("target", None)
    driven(target, "frame * 0.2")
    wide.constraints.new("TRACK_TO").target = target
    keyed(wide, "location", {2: (0, -9, 1.5), 3: (1, -9, 1.5)})
    _bending(cube("bending"))
    _falling(cube("falling"))
    rider = link("rider", bpy.data.cameras.new("rider"))
    rider.parent = bpy.data.objects["falling"]
    scene.frame_set(1)
    return save(folder / "menagerie.blend")


def _timed_nodes(obj: Any) -> None:
    """Geometry nodes that move the mesh by the scene's time from frame 3 on."""
    tree = bpy.data.node_groups.new("timed", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    names = (
        "NodeGroupInput",
        "NodeGroupOutput",
        "GeometryNodeInputSceneTime",
        "GeometryNodeSetPosition",
        "ShaderNodeMath",
    )
    begin, end, now, place, late = (tree.nodes.new(name) for name in names)
    late.operation, late.inputs[1].default_value = "GREATER_THAN", 2.5
    tree.links.new(now.outputs["Frame"], late.inputs[0])
    tree.links.new(late.outputs[0], place.inputs["Offset"])
    tree.links.new(begin.outputs[0], place.inputs["Geometry"])
    tree.links.new(place.outputs[0], end.inputs[0])
    obj.modifiers.new("nodes", "NODES").node_group = tree


def _bending(obj: Any) -> None:
    """The child of an armature that deforms it, from frame 2 to 3."""
    rig = link("rig", bpy.data.armatures.new("rig"))
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    bone = rig.data.edit_bones.new("bone")
    bone.tail = (0, 0, 1)
    bpy.ops.object.mode_set(mode="OBJECT")
    obj.vertex_groups.new(name="bone").add([3], 1.0, "REPLACE")
    obj.parent, obj.parent_type = rig, "ARMATURE"
    keyed(rig.pose.bones["bone"], "location", {2: (0, 0, 0), 3: (0, 1, 0)})


def _falling(obj: Any) -> None:
    """A rigid body that nobody has baked."""
    bpy.context.view_layer.objects.active = obj
    obj.location = (8, 8, 9)
    bpy.ops.rigidbody.object_add()

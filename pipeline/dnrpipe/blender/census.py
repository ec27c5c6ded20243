"""What is in a scene: counts and features that decide which light-transport effects matter."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from dnrpipe.core.scene_records import Census, ImageFacts, LightFacts, MaterialFacts, WorldFacts

from .census_materials import describe_material
from .findings import Findings
from .geometry.frozen import FrozenMesh
from .geometry.render_graph import render_layer
from .lighting.lights import visible_lights
from .reading.missing import SHAPELESS_IMAGES
from .reading.names import find_material
from .settings_left_out import moving_objects, settings_left_out
from .shading.sockets import find_input, resolve, surface_source, walk

NAMES_PER_MATERIAL = 8  # objects listed as examples for each material


def take_census(scene: bpy.types.Scene, findings: Findings, meshes: Sequence[FrozenMesh]) -> Census:
    """Count the objects, materials, lights, images and special features that renders of ``scene`` see.

    meshes: the frozen geometry, so that nothing is evaluated twice. Adds missing images to the findings as
    ``missing``, motion blur and render settings as ``ignored``; freezing reports hair and volumes. The census holds
    all findings so far.
    """
    instances, triangles, by_object = _counts(meshes)
    types = Counter(obj.type for obj in render_layer(scene).objects if not obj.hide_render)
    users = _users(meshes)
    found = {name: find_material(name) for name in sorted(filter(None, users))}
    described = {name: describe_material(material, users[name]) for name, material in found.items() if material}
    for finding in settings_left_out(scene):
        findings.add(*finding)
    volumes = sorted(obj.name for obj in scene.objects if obj.type == "VOLUME" and not obj.hide_render)
    return Census(
        scene=scene.name,
        blender=bpy.app.version_string,
        file_version=".".join(str(v) for v in bpy.data.version),
        objects=dict(sorted(types.items())),
        meshes=len(meshes),
        instances=instances,
        triangles=triangles,
        triangles_by_object=by_object,
        materials=described,
        default_material=users.get(None, []),
        lights=_lights(scene),
        world=_world(scene.world),
        images=_images(findings),
        node_groups=sorted({tree.name for tree in bpy.data.node_groups if tree.bl_idname == "ShaderNodeTree"}),
        procedural_textures=_using(described, "procedural"),
        transparency=_using(described, "transparent"),
        transmission=_using(described, "transmissive"),
        emission=_using(described, "emissive"),
        subsurface=_using(described, "subsurface"),
        metals=_using(described, "metallic"),
        normal_maps=_using(described, "normal_map"),
        view_dependent_nodes=_using(described, "view_dependent"),
        volumes=sorted({*volumes, *_using(described, "volume")}),
        hair=_hair(scene),
        depth_of_field=sorted(o.name for o in scene.objects if o.type == "CAMERA" and o.data.dof.use_dof),
        motion=_motion(scene, findings),
        view_transform=scene.view_settings.view_transform,
        render_engine=scene.render.engine,
        findings=list(findings),
    )


def _counts(meshes: Sequence[FrozenMesh]) -> tuple[int, int, dict[str, int]]:
    """Instances, triangles that rays can hit, and triangles of one instance by object."""
    by_object: dict[str, int] = {}
    instances = triangles = 0
    for mesh in meshes:
        instances += 1 + len(mesh.copies)
        triangles += mesh.triangles * (1 + len(mesh.copies))
        by_object.setdefault(mesh.object_name, mesh.triangles)
    return instances, triangles, dict(sorted(by_object.items()))


def _users(meshes: Sequence[FrozenMesh]) -> dict[str | None, list[str]]:
    """Objects by the material that they show, a few names each; None is Cycles' default grey."""
    users: dict[str | None, dict[str, None]] = {}
    for mesh in meshes:
        for slot in np.unique(mesh.material_index):
            users.setdefault(mesh.materials[int(slot)], {})[mesh.object_name] = None
    return {name: list(objects)[:NAMES_PER_MATERIAL] for name, objects in users.items()}


def _lights(scene: bpy.types.Scene) -> list[LightFacts]:
    found = []
    for obj, _ in visible_lights(scene):
        light = obj.data
        facts: dict[str, Any] = {"name": obj.name, "type": light.type, "color": tuple(light.color)}
        facts["power"] = float(light.energy) * 2.0 ** float(light.exposure)
        if light.type == "AREA":
            both = light.shape in {"RECTANGLE", "ELLIPSE"}
            facts |= {"shape": light.shape, "size": (light.size, light.size_y if both else light.size)}
        else:
            facts["size"] = light.angle if light.type == "SUN" else light.shadow_soft_size
        found.append(LightFacts.model_validate(facts))
    return found


def _world(world: Any) -> WorldFacts | None:
    if world is None:
        return None
    tree = world.node_tree
    kinds = Counter(node.type for node in walk(tree))
    image = next((n.image.name for n in walk(tree) if n.type == "TEX_ENVIRONMENT" and n.image), None)
    return WorldFacts(
        name=world.name,
        kind="hdri" if image else "sky" if kinds["TEX_SKY"] else "nodes" if tree else "color",
        image=image,
        emits=_world_emits(world),
        volume=surface_source(tree, "Volume") is not None,
        nodes=dict(sorted(kinds.items())),
    )


def _world_emits(world: Any) -> bool:
    """Whether the world gives light: anything but a plain Background that is black or of strength 0."""
    tree = world.node_tree
    if tree is None:
        return any(v > 0 for v in world.color)
    surface = surface_source(tree)
    if surface is None:
        return False
    if surface.node.type != "BACKGROUND":
        return True
    colour, strength = (find_input(surface.node, name) for name in ("Color", "Strength"))
    for socket in (colour, strength):
        source = None if socket is None else resolve(socket)
        if source is not None and not source.linked and max(source.colour) <= 0:
            return False
    return True


def _images(findings: Findings) -> list[ImageFacts]:
    """Images with users; records those whose file is gone."""
    found = []
    for image in bpy.data.images:
        if image.users == 0 or image.source == "VIEWER":
            continue
        missing = is_missing(image)
        if missing:
            note = f"file not found: {image.filepath}; put it there or pack it into the .blend"
            findings.add("missing", f"image '{image.name}'", note)
        found.append(
            ImageFacts(
                name=image.name,
                size=tuple(image.size),
                float=bool(image.is_float),
                packed=image.packed_file is not None,
                color_space=image.colorspace_settings.name,
                missing=missing,
            )
        )
    return found


def is_missing(image: Any) -> bool:
    """Whether an image refers to a file that is neither packed nor on disk."""
    if image.source in SHAPELESS_IMAGES or image.packed_file or image.packed_files:
        return False
    path = bpy.path.abspath(image.filepath, library=image.library)
    if image.source == "TILED":
        return not any(Path(path.replace("<UDIM>", str(tile.number))).is_file() for tile in image.tiles)
    return not Path(path).is_file()


def _hair(scene: bpy.types.Scene) -> list[str]:
    """Objects with hair: curves objects and particle systems of type hair that renders draw as strands."""
    found = []
    for obj in scene.objects:
        settings = [system.settings for system in obj.particle_systems]
        strands = any(entry.type == "HAIR" and entry.render_type == "PATH" for entry in settings)
        if not obj.hide_render and (obj.type == "CURVES" or strands):
            found.append(obj.name)
    return sorted(found)


def _motion(scene: bpy.types.Scene, findings: Findings) -> list[str]:
    """Objects that would be blurred by their motion, where the scene and its view layer ask for motion blur."""
    if not (scene.render.use_motion_blur and render_layer(scene).use_motion_blur):
        return []
    moving = moving_objects(scene)
    for name in moving:
        findings.add("ignored", "motion blur", f"frozen at frame {scene.frame_current}", object=name)
    return moving


def _using(materials: dict[str, MaterialFacts], feature: str) -> list[str]:
    return sorted(name for name, facts in materials.items() if getattr(facts, feature))

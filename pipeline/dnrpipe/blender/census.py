"""What is in a scene: counts and features that decide which light-transport effects matter."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import bpy

from .findings import Findings
from .lights import visible_lights
from .sockets import find_input, resolve, surface_source, walk

PROCEDURAL = {
    "TEX_BRICK",
    "TEX_CHECKER",
    "TEX_GABOR",
    "TEX_GRADIENT",
    "TEX_MAGIC",
    "TEX_MUSGRAVE",
    "TEX_NOISE",
    "TEX_VORONOI",
    "TEX_WAVE",
    "TEX_WHITE_NOISE",
}
"""Texture nodes without image."""
VIEW_DEPENDENT = {"FRESNEL", "LAYER_WEIGHT", "LIGHT_PATH", "CAMERA", "AMBIENT_OCCLUSION"}
VOLUME_NODES = {"VOLUME_ABSORPTION", "VOLUME_SCATTER", "PRINCIPLED_VOLUME", "VOLUME_COEFFICIENTS"}
TRANSMISSIVE = {"BSDF_GLASS", "BSDF_REFRACTION", "BSDF_TRANSLUCENT"}


def take_census(scene: bpy.types.Scene, findings: Findings) -> dict[str, Any]:
    """Count the objects, materials, lights, images and special features that renders of ``scene`` see.

    Missing images are recorded as findings ``missing``, hair and volumes as ``ignored``. The result is JSON-able;
    its key ``findings`` holds everything collected so far.
    """
    instances, triangles, types, materials, by_object = _geometry(scene)
    hair = _hair(scene)
    volumes = sorted(obj.name for obj in scene.objects if obj.type == "VOLUME" and not obj.hide_render)
    for name in hair:
        findings.add("ignored", "hair", "strands are not converted", object=name)
    for name in volumes:
        findings.add("ignored", "volume object", "not converted", object=name)
    described = {material.name: _material(material) for material in materials}
    report: dict[str, Any] = {
        "scene": scene.name,
        "blender": bpy.app.version_string,
        "file_version": ".".join(str(v) for v in bpy.data.version),
        "objects": dict(sorted(types.items())),
        "instances": instances,
        "triangles": triangles,
        "triangles_by_object": by_object,
        "materials": described,
        "lights": _lights(scene),
        "world": _world(scene.world),
        "images": _images(findings),
        "node_groups": sorted({tree.name for tree in bpy.data.node_groups if tree.bl_idname == "ShaderNodeTree"}),
        "procedural_textures": _using(described, "procedural"),
        "transparency": _using(described, "transparent"),
        "transmission": _using(described, "transmissive"),
        "emission": _using(described, "emissive"),
        "subsurface": _using(described, "subsurface"),
        "metals": _using(described, "metallic"),
        "normal_maps": _using(described, "normal_map"),
        "view_dependent_nodes": _using(described, "view_dependent"),
        "volumes": sorted({*volumes, *_using(described, "volume")}),
        "hair": hair,
        "view_transform": scene.view_settings.view_transform,
        "render_engine": scene.render.engine,
    }
    report["findings"] = findings.to_list()
    return report


def _geometry(
    scene: bpy.types.Scene,
) -> tuple[int, int, Counter[str], list[Any], dict[str, int]]:
    """Instances, triangles, object types, materials in use, triangles by object; as the viewport evaluates them."""
    layer = next((layer for layer in scene.view_layers if layer.use), scene.view_layers[0])
    with bpy.context.temp_override(scene=scene, view_layer=layer):
        depsgraph = bpy.context.evaluated_depsgraph_get()
    types: Counter[str] = Counter(obj.type for obj in layer.objects if not obj.hide_render)
    counts: dict[str, int] = {}
    materials: dict[str, Any] = {}
    instances = triangles = 0
    for instance in depsgraph.object_instances:
        obj = instance.object
        source = obj.original
        if not instance.show_self or source.hide_render:
            continue
        if obj.type not in {"MESH", "CURVE", "SURFACE", "META", "FONT"}:
            continue
        if obj.name not in counts:
            counts[obj.name] = _triangles(obj)
        if counts[obj.name] == 0:
            continue
        instances += 1
        triangles += counts[obj.name]
        for slot in obj.material_slots:
            if slot.material is not None:
                original = slot.material.original
                materials[original.name] = original
    ordered = [materials[name] for name in sorted(materials)]
    return instances, triangles, types, ordered, {name: counts[name] for name in sorted(counts)}


def _triangles(obj: Any) -> int:
    mesh = obj.to_mesh()
    try:
        if mesh is None:
            return 0
        mesh.calc_loop_triangles()
        return len(mesh.loop_triangles)
    finally:
        obj.to_mesh_clear()


def _material(material: Any) -> dict[str, Any]:
    """Nodes of one material and what they imply."""
    tree = material.node_tree
    nodes = list(walk(tree))
    kinds = {node.type for node in nodes}
    principled = [node for node in nodes if node.type == "BSDF_PRINCIPLED"]
    return {
        "bsdfs": sorted({node.bl_label for node in nodes if _is_shader(node)}),
        "nodes": dict(sorted(Counter(node.bl_label for node in nodes).items())),
        "procedural": sorted(node.bl_label for node in nodes if node.type in PROCEDURAL),
        "transparent": "BSDF_TRANSPARENT" in kinds or any(_active(n, "Alpha", off=1.0) for n in principled),
        "transmissive": bool(kinds & TRANSMISSIVE)
        or any(_active(n, "Transmission Weight", "Transmission") for n in principled),
        "emissive": "EMISSION" in kinds or any(_emits(n) for n in principled),
        "subsurface": "SUBSURFACE_SCATTERING" in kinds
        or any(_active(n, "Subsurface Weight", "Subsurface") for n in principled),
        "metallic": bool(kinds & {"BSDF_GLOSSY", "BSDF_METALLIC"}) or any(_active(n, "Metallic") for n in principled),
        "normal_map": "NORMAL_MAP" in kinds,
        "bump": "BUMP" in kinds,
        "volume": bool(kinds & VOLUME_NODES) or surface_source(tree, "Volume") is not None,
        "displacement": surface_source(tree, "Displacement") is not None,
        "view_dependent": sorted({node.bl_label for node in nodes if node.type in VIEW_DEPENDENT}),
        "min_roughness": min((_roughness(n) for n in principled), default=None),
    }


def _is_shader(node: Any) -> bool:
    return any(socket.type == "SHADER" for socket in node.outputs) and node.type not in {
        "GROUP",
        "GROUP_INPUT",
        "REROUTE",
    }


def _active(node: Any, *names: str, off: float = 0.0) -> bool:
    """Whether a scalar input is linked or differs from the value that switches the feature off."""
    socket = find_input(node, *names)
    if socket is None:
        return False
    source = resolve(socket)
    return source.linked or abs(float(source.default) - off) > 1e-6


def _emits(node: Any) -> bool:
    colour = find_input(node, "Emission Color", "Emission")
    if colour is None or not _active(node, "Emission Strength"):
        return False
    source = resolve(colour)
    return source.linked or any(v > 0 for v in list(source.default)[:3])


def _roughness(node: Any) -> float:
    socket = find_input(node, "Roughness")
    source = None if socket is None else resolve(socket)
    return 1.0 if source is None or source.linked else float(source.default)


def _lights(scene: bpy.types.Scene) -> list[dict[str, Any]]:
    found = []
    for obj, _ in visible_lights(scene):
        light = obj.data
        entry: dict[str, Any] = {
            "name": obj.name,
            "type": light.type,
            "power": float(light.energy) * 2.0 ** float(light.exposure),
            "color": [float(v) for v in light.color],
        }
        if light.type == "SUN":
            entry["size"] = float(light.angle)
        elif light.type == "AREA":
            entry["shape"] = light.shape
            both = light.shape in {"RECTANGLE", "ELLIPSE"}
            entry["size"] = [float(light.size), float(light.size_y if both else light.size)]
        else:
            entry["size"] = float(light.shadow_soft_size)
        found.append(entry)
    return found


def _world(world: Any) -> dict[str, Any] | None:
    if world is None:
        return None
    tree = world.node_tree
    kinds = Counter(node.type for node in walk(tree))
    image = next((n.image.name for n in walk(tree) if n.type == "TEX_ENVIRONMENT" and n.image), None)
    return {
        "name": world.name,
        "kind": "hdri" if image else "sky" if kinds["TEX_SKY"] else "nodes" if tree else "color",
        "image": image,
        "volume": surface_source(tree, "Volume") is not None,
        "nodes": dict(sorted(kinds.items())),
    }


def _images(findings: Findings) -> list[dict[str, Any]]:
    """Images with users; those whose file is gone are recorded."""
    found = []
    for image in bpy.data.images:
        if image.users == 0 or image.source == "VIEWER":
            continue
        missing = is_missing(image)
        if missing:
            findings.add(
                "missing",
                f"image '{image.name}'",
                f"file not found: {image.filepath}; put it there or pack it into the .blend",
            )
        found.append(
            {
                "name": image.name,
                "size": [int(v) for v in image.size],
                "float": bool(image.is_float),
                "packed": image.packed_file is not None,
                "color_space": image.colorspace_settings.name,
                "missing": missing,
            }
        )
    return found


def is_missing(image: Any) -> bool:
    """Whether an image refers to a file that is neither packed nor on disk."""
    if image.source not in {"FILE", "SEQUENCE", "MOVIE", "TILED"} or image.packed_file is not None:
        return False
    if len(image.packed_files):
        return False
    path = bpy.path.abspath(image.filepath, library=image.library)
    if image.source == "TILED":
        return not any(Path(path.replace("<UDIM>", str(tile.number))).is_file() for tile in image.tiles)
    return not Path(path).is_file()


def _hair(scene: bpy.types.Scene) -> list[str]:
    """Objects with hair: curves objects and particle systems of type hair."""
    names = set()
    for obj in scene.objects:
        if obj.hide_render:
            continue
        strands = any(system.settings.type == "HAIR" for system in obj.particle_systems)
        if obj.type == "CURVES" or strands:
            names.add(obj.name)
    return sorted(names)


def _using(materials: dict[str, dict[str, Any]], feature: str) -> list[str]:
    return sorted(name for name, entry in materials.items() if entry[feature])

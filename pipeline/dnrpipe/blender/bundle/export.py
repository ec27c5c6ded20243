"""The portable Mitsuba bundle: ``scene.xml`` + ``meshes/*.ply`` + ``textures/*``. Text only: no mitsuba here.

The XML (version 3 format) uses relative paths, so the folder can be moved. It holds a default integrator and a
sensor that frames the scene, so that ``mitsuba scene.xml`` works as it is; the pipeline brings its own sensors.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence

import bpy
import numpy as np

from dnrtrain.atomic import write_text

from ..geometry.frozen import FrozenMesh
from ..lighting.lights import export_lights, report_ray_visibility
from ..lighting.world import export_world
from ..reading.framing import framing_pose
from ..reading.names import find_material
from ..shading.materials import Converted, MaterialConverter
from . import xmltree
from .shapes import export_shapes
from .units import rescale, unit_scale

FORMAT_VERSION = "3.0.0"
MAX_DEPTH = 12
DEFAULT_FOV = 40.0


def export_bundle(meshes: Sequence[FrozenMesh], converter: MaterialConverter) -> dict[str | None, Converted]:
    """Write the open scene (``bpy.context.scene``) as a bundle into the converter's folder; its materials by name.

    meshes: the frozen geometry, world space. Every deviation from Blender goes into the converter's findings.
    """
    scene = bpy.context.scene
    assert scene is not None
    center, radius = bounding_sphere(meshes)

    root = ET.Element("scene", {"version": FORMAT_VERSION})
    root.append(_sensor(center, radius))
    used = [
        [(int(slot), converter.convert(_material(mesh, int(slot)))) for slot in np.unique(mesh.material_index)]
        for mesh in meshes
    ]
    materials = {converted.id: converted for slots in used for _, converted in slots}
    shapes = export_shapes(meshes, used, converter)
    root.extend(converter.sheets_elements())
    media = [converted.medium for converted in materials.values() if converted.medium is not None]
    holes = any(
        bsdf.get("type") in ("mask", "dnr_transparent") for m in materials.values() for bsdf in m.bsdf.iter("bsdf")
    )
    root.insert(0, _integrator("volpath" if media or holes else "path"))
    root.extend(converted.bsdf for converted in materials.values())
    root.extend([*media, *shapes])
    report_ray_visibility((mesh.object_name for mesh in meshes), converter.findings)
    export_lights(scene, root, converter, center, radius)
    export_world(scene.world, root, converter, center, radius)
    if unit_scale(radius) != 1.0:
        rescale(root, unit_scale(radius))
    ET.indent(root)
    write_text(converter.store.scene_dir / "scene.xml", ET.tostring(root, encoding="unicode") + "\n")
    return {converted.name: converted for converted in materials.values()}


def _material(mesh: FrozenMesh, slot: int) -> bpy.types.Material | None:
    name = mesh.materials[slot]
    return None if name is None else find_material(name)


def bounding_sphere(meshes: Sequence[FrozenMesh]) -> tuple[np.ndarray, float]:
    """Centre of the bounding box and half its diagonal, scene units."""
    extents = [mesh.extent() for mesh in meshes]
    low = np.min([points.min(axis=0) for points in extents], axis=0)
    high = np.max([points.max(axis=0) for points in extents], axis=0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)


def _integrator(kind: str) -> ET.Element:
    """``path``, or ``volpath`` where there are media or holes, for Mitsuba by itself; the project's own is chosen by
    the effects (`raytrace.visibility.camera_integrator`).

    Emitters and environment are invisible to the camera, as Blender's lamps over a clear film.
    """
    element = xmltree.plugin("integrator", kind, id="integrator")
    xmltree.integer(element, "max_depth", MAX_DEPTH)
    xmltree.flag(element, "hide_emitters", True)
    return element


def _sensor(center: np.ndarray, radius: float) -> ET.Element:
    """``perspective`` sensor that sees the bounding sphere from the front right, 25 degrees above."""
    pose = framing_pose(center, 1.05 * radius / math.sin(math.radians(DEFAULT_FOV / 2)))
    sensor = xmltree.plugin("sensor", "perspective", id="sensor")
    xmltree.number(sensor, "fov", DEFAULT_FOV)
    xmltree.number(sensor, "near_clip", 0.01 * radius)
    xmltree.number(sensor, "far_clip", 1000.0 * radius)
    # Mitsuba's camera looks along +Z with +X to the left.
    xmltree.matrix(sensor, "to_world", pose @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    sampler = xmltree.plugin("sampler", "independent")
    xmltree.integer(sampler, "sample_count", 64)
    film = xmltree.plugin("film", "hdrfilm")
    xmltree.integer(film, "width", 512)
    xmltree.integer(film, "height", 512)
    xmltree.text(film, "pixel_format", "rgba")
    film.append(xmltree.plugin("rfilter", "box"))
    sensor.append(sampler)
    sensor.append(film)
    return sensor

"""The portable Mitsuba bundle: ``scene.xml`` + ``meshes/*.ply`` + ``textures/*``. Text only: no mitsuba here.

The XML (version 3 format) uses relative paths, so the folder can be moved. It holds a default integrator and a
sensor that frames the scene, so that ``mitsuba scene.xml`` works as it is; the pipeline brings its own sensors.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np

from dnrtrain.atomic import write_text

from . import xmltree
from .findings import Findings
from .frozen import FrozenMesh
from .lights import export_lights
from .materials import Converted, MaterialConverter
from .ply import write_ply
from .textures import ImageReader, TextureStore
from .world import export_world

FORMAT_VERSION = "3.0.0"
MAX_DEPTH = 12
DEFAULT_FOV = 40.0
OPEN_MESH = 1e-3
"""A surface whose area vectors sum to more than this share of its area has a rim."""


def export_bundle(meshes: Sequence[FrozenMesh], scene_dir: Path, findings: Findings) -> None:
    """Write the open scene (``bpy.context.scene``) as a bundle into ``scene_dir``.

    meshes: the frozen geometry, world space. Every deviation from Blender goes into ``findings``.
    """
    scene = bpy.context.scene
    assert scene is not None
    store = TextureStore(scene_dir)
    images = ImageReader(findings)
    converter = MaterialConverter(store, images, findings)
    center, radius = bounding_sphere(meshes)

    root = ET.Element("scene", {"version": FORMAT_VERSION})
    root.append(_integrator())
    root.append(_sensor(center, radius))
    shapes: list[ET.Element] = []
    used: dict[str, Converted] = {}
    ids = xmltree.Ids()
    for mesh in meshes:
        for slot in np.unique(mesh.material_index):
            name = mesh.materials[slot]
            material = None if name is None else bpy.data.materials.get(name)
            converted = converter.convert(material)
            used[converted.id] = converted
            shapes.append(_shape(mesh, int(slot), converted, converter, scene_dir, ids, findings))
    for converted in used.values():
        root.append(converted.bsdf)
    for shape in shapes:
        root.append(shape)
    export_lights(scene, root, store, findings, center, radius)
    export_world(scene, root, store, images, findings)
    ET.indent(root)
    write_text(scene_dir / "scene.xml", ET.tostring(root, encoding="unicode") + "\n")


def bounding_sphere(meshes: Sequence[FrozenMesh]) -> tuple[np.ndarray, float]:
    """Centre of the bounding box and half its diagonal, scene units."""
    low = np.min([mesh.positions.min(axis=0) for mesh in meshes], axis=0).astype(np.float64)
    high = np.max([mesh.positions.max(axis=0) for mesh in meshes], axis=0).astype(np.float64)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)


def _shape(
    mesh: FrozenMesh,
    slot: int,
    converted: Converted,
    converter: MaterialConverter,
    scene_dir: Path,
    ids: xmltree.Ids,
    findings: Findings,
) -> ET.Element:
    """``ply`` shape of one instance's faces with one material."""
    corners = np.repeat(mesh.material_index == slot, 3)
    positions, normals = mesh.positions[corners], mesh.normals[corners]
    uv = _texture_coordinates(mesh, converted, findings)
    uv = None if uv is None else uv[corners]
    emitter = converter.emitter(converted)
    if emitter is not None:
        balance, volume = closure(positions)
        if balance < OPEN_MESH and volume < 0:  # area emitters shine along the normal only
            order = np.arange(len(positions)).reshape(-1, 3)[:, ::-1].ravel()
            positions, normals = positions[order], -normals[order]
            uv = None if uv is None else uv[order]
        _note_emission(mesh, converted, balance, findings)
    suffix = "" if len(mesh.materials) == 1 else f"-{xmltree.safe_name(converted.name or 'default')}"
    identity = ids.take("mesh", mesh.name + suffix)
    relative = f"meshes/{identity.removeprefix('mesh-')}.ply"
    write_ply(scene_dir / relative, positions, normals, uv)
    element = xmltree.plugin("shape", "ply", id=identity)
    xmltree.text(element, "filename", relative)
    xmltree.reference(element, converted.id)
    if emitter is not None:
        element.append(emitter)
    return element


def _texture_coordinates(mesh: FrozenMesh, converted: Converted, findings: Findings) -> np.ndarray | None:
    """The UV layer that the material's images use, [3T, 2]; None when the mesh has none."""
    wanted = converted.uv or mesh.active_uv
    if wanted in mesh.uv_layers:
        return mesh.uv_layers[wanted]
    if converted.uv is not None:
        findings.add(
            "missing",
            f"UV layer '{converted.uv}'",
            "not on this mesh: coordinates are 0, as in Cycles",
            object=mesh.object_name,
            material=converted.name,
        )
        return np.zeros((len(mesh.positions), 2), dtype=np.float32)
    if not converted.textured:
        return next(iter(mesh.uv_layers.values()), None)
    findings.add(
        "missing",
        "UV layer",
        "the mesh has none: image coordinates are 0, as in Cycles",
        object=mesh.object_name,
        material=converted.name,
    )
    return np.zeros((len(mesh.positions), 2), dtype=np.float32)


def _note_emission(mesh: FrozenMesh, converted: Converted, balance: float, findings: Findings) -> None:
    if balance >= OPEN_MESH:
        findings.add(
            "approximated",
            "emissive surface with a rim",
            "emits from its front only; Blender's emits from both sides",
            object=mesh.object_name,
            material=converted.name,
        )


def closure(positions: np.ndarray) -> tuple[float, float]:
    """How open a surface is, and which way it faces.

    Returns |sum of area vectors| / sum of areas (0 for a closed surface, by the divergence theorem) and the
    signed volume (negative: normals point inwards).
    """
    triangles = positions.reshape(-1, 3, 3).astype(np.float64)
    triangles = triangles - triangles.mean(axis=(0, 1))
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    total = float(np.linalg.norm(cross, axis=1).sum())
    balance = float(np.linalg.norm(cross.sum(axis=0))) / max(total, 1e-20)
    volume = float(np.einsum("ij,ij->", triangles[:, 0], cross)) / 6
    return balance, volume


def _integrator() -> ET.Element:
    """``path``: emitters and environment are invisible to the camera, as Blender's lamps over a clear film."""
    element = xmltree.plugin("integrator", "path", id="integrator")
    xmltree.integer(element, "max_depth", MAX_DEPTH)
    xmltree.flag(element, "hide_emitters", True)
    return element


def _sensor(center: np.ndarray, radius: float) -> ET.Element:
    """``perspective`` sensor that sees the bounding sphere from the front right, 25 degrees above."""
    distance = 1.05 * radius / math.sin(math.radians(DEFAULT_FOV / 2))
    azimuth, elevation = math.radians(-60), math.radians(25)
    back = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = center + distance * back
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

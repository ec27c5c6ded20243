"""Worker: a scene file -> the folder ``scene/`` of a workspace (see DESIGN.md, data contract)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np

from dnrpipe.workspace import file_sha256
from dnrtrain.atomic import write_json
from dnrtrain.contract import SceneFrame

from .atlas import build_atlas
from .cameras import camera_animation, scene_cameras
from .census import take_census
from .display import export_display
from .export import export_bundle
from .findings import Findings
from .frozen import FrozenMesh, save_geometry
from .gbuffer_scene import add_gbuffer_scene
from .geometry import freeze_scene
from .light import has_light, light_warnings
from .opening import external_files, open_scene
from .packing import pack_everything, save_blend


class Worker:
    """Prepares one scene per task: ``source`` (file), ``scene_dir`` (folder to fill)."""

    def __init__(self, common: dict[str, Any]) -> None:
        del common

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        return prepare(Path(task["source"]), Path(task["scene_dir"]))


def prepare(source: Path, scene_dir: Path) -> dict[str, Any]:
    """Fill ``scene_dir`` from ``source`` and return summary.json's content.

    Writes source.blend, geometry.npz, census.json, frame.json, summary.json and the Mitsuba bundle
    (scene.xml, meshes/, textures/). All paths inside are relative. Raises UserError for unusable input.
    """
    scene_dir.mkdir(parents=True, exist_ok=True)
    warnings = open_scene(source)
    external = external_files(source)
    scene = bpy.context.scene
    frozen = freeze_scene(scene)
    warnings += frozen.warnings + light_warnings(scene, frozen.meshes)
    atlas = build_atlas(frozen.meshes)
    findings = Findings()
    census = take_census(scene, findings)
    export_bundle(frozen.meshes, scene_dir, findings)
    census["findings"] = findings.to_list()
    display = export_display(scene, scene_dir)
    save_geometry(scene_dir / "geometry.npz", frozen.meshes)
    bounds = scene_bounds(frozen.meshes)
    summary: dict[str, Any] = {
        "bounds": bounds,
        "triangles": sum(mesh.triangles for mesh in frozen.meshes),
        "objects": max(mesh.object_id for mesh in frozen.meshes),
        "instances": len(frozen.meshes),
        "object_names": {str(mesh.object_id): mesh.object_name for mesh in frozen.meshes},
        "cameras": scene_cameras(scene),
        "animation": camera_animation(scene),
        "resolution": _resolution(scene),
        "blender_version": bpy.app.version_string,
        "atlas": atlas,
        "repairs": frozen.repairs,
        "has_light": has_light(scene, frozen.meshes),
        "external": {str(path): file_sha256(path) for path in external},
    }
    warnings += pack_everything()
    add_gbuffer_scene(frozen.meshes)
    save_blend(scene_dir / "source.blend")
    summary["warnings"] = warnings
    write_json(scene_dir / "census.json", census)
    write_json(scene_dir / "frame.json", _frame(bounds, display).model_dump(mode="json"))
    write_json(scene_dir / "summary.json", summary)
    return summary


def scene_bounds(meshes: list[FrozenMesh]) -> dict[str, Any]:
    """Axis-aligned box, and a sphere about its centre that holds every vertex; scene units."""
    low = np.min([mesh.positions.min(0) for mesh in meshes], axis=0).astype(np.float64)
    high = np.max([mesh.positions.max(0) for mesh in meshes], axis=0).astype(np.float64)
    center = (low + high) / 2
    radius = max(float(np.linalg.norm(mesh.positions - center, axis=1).max()) for mesh in meshes)
    return {"min": low.tolist(), "max": high.tolist(), "center": center.tolist(), "radius": radius}


def _frame(bounds: dict[str, Any], display: dict[str, Any]) -> SceneFrame:
    """near and far are placeholders for a camera at four radii; camera placement replaces them."""
    radius = bounds["radius"]
    center = tuple(bounds["center"])
    return SceneFrame(near=1e-3 * radius, far=5 * radius, center=center, radius=radius, **display)


def _resolution(scene: bpy.types.Scene) -> list[int]:
    scale = scene.render.resolution_percentage / 100
    return [
        max(1, round(scene.render.resolution_x * scale)),
        max(1, round(scene.render.resolution_y * scale)),
    ]

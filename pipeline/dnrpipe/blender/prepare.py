"""Worker: a scene file -> the folder ``scene/`` of a workspace (see DESIGN.md, data contract)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from dnrpipe.core.workspace import file_sha256
from dnrtrain.atomic import write_json
from dnrtrain.contract import SceneFrame

from .baking.rehearsal import BakeOptions, convert_materials, missing_bakes, place_atlas
from .bundle.display import export_display
from .bundle.export import export_bundle
from .cameras import camera_animation, scene_cameras
from .census import take_census
from .geometry.frozen import save_geometry
from .passes.gbuffer_scene import add_gbuffer_scene
from .reading.loading import load_scene
from .reading.packing import pack_everything, save_blend


class Worker:
    """Prepares one scene per task: ``source`` (file), ``scene_dir`` (folder to fill), ``strict`` (bool, optional).

    ``bakes`` (optional): :class:`.baking.rehearsal.BakeOptions` as a dict. Where textures have to be baked first, the
    result is {"bakes": what :func:`.baking.rehearsal.missing_bakes` returns} and the task is to be run again after it.
    """

    def __init__(self, common: dict[str, Any]) -> None:
        del common

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        bakes = task.get("bakes")
        options = bakes and BakeOptions(Path(bakes["folder"]), int(bakes["size"]), tuple(bakes["refused"]))
        strict = bool(task.get("strict", False))
        return prepare(Path(task["source"]), Path(task["scene_dir"]), strict=strict, bakes=options)


def prepare(source: Path, scene_dir: Path, *, strict: bool = False, bakes: BakeOptions | None = None) -> dict[str, Any]:
    """Fill ``scene_dir`` from ``source`` and return summary.json's content, or {"bakes": ...} (see :class:`Worker`).

    Writes source.blend, geometry.npz, census.json, frame.json, summary.json and the Mitsuba bundle
    (scene.xml, meshes/, textures/). All paths inside are relative. A scene without camera or light gets a
    framing camera and a neutral studio environment; the summary's warnings say so.

    Raises UserError for unusable input, and with ``strict`` for a scene with missing files.
    """
    scene_dir.mkdir(parents=True, exist_ok=True)
    loaded = load_scene(source, strict=strict)
    scene, frozen, findings = loaded.scene, loaded.frozen, loaded.findings
    atlas = place_atlas(frozen.meshes, scene_dir)
    census = take_census(scene, findings, frozen.meshes)
    converter = convert_materials(frozen.meshes, scene_dir, findings, bakes)
    pending = missing_bakes(converter, frozen.meshes, atlas, scene_dir, scene.frame_current)
    if pending is not None:
        return {"bakes": pending}
    materials = export_bundle(frozen.meshes, scene_dir, findings, converter)
    census["findings"] = findings.to_list()
    display = export_display(scene, scene_dir)
    save_geometry(scene_dir / "geometry.npz", frozen.meshes)
    summary: dict[str, Any] = {
        "bounds": loaded.bounds,
        "triangles": sum(mesh.triangles for mesh in frozen.meshes),
        "objects": max(mesh.object_id for mesh in frozen.meshes),
        "instances": sum(1 + len(mesh.copies) for mesh in frozen.meshes),
        "object_names": {str(mesh.object_id): mesh.object_name for mesh in frozen.meshes},
        "cameras": scene_cameras(scene),
        "animation": camera_animation(scene),
        "resolution": _resolution(scene),
        "blender_version": bpy.app.version_string,
        "atlas": atlas,
        "repairs": frozen.repairs,
        "has_light": loaded.has_light,
        "bake_size": converter.baked_size(),
        # A missing file counts too: the scene is out of date when it turns up.
        "external": {str(path): "missing" for path in loaded.missing}
        | {str(path): file_sha256(path) for path in loaded.external},
    }
    warnings = loaded.warnings + pack_everything()
    add_gbuffer_scene(frozen.meshes, {name: converted.opacity for name, converted in materials.items()})
    save_blend(scene_dir / "source.blend")
    summary["warnings"] = warnings
    write_json(scene_dir / "census.json", census)
    write_json(scene_dir / "frame.json", _frame(loaded.bounds, display).model_dump(mode="json"))
    write_json(scene_dir / "summary.json", summary)
    if converter.book is not None:
        converter.book.prune()
    return summary


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

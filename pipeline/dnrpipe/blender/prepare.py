"""Worker that converts a scene file into the folder ``scene/`` of a workspace."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from dnrpipe.core.scene_records import SceneSummary
from dnrpipe.core.workspace import file_sha256
from dnrtrain.atomic import write_json
from dnrtrain.contract import SceneFrame

from .baking.pending import convert_materials, missing_bakes, place_atlas
from .bundle.display import export_display
from .bundle.export import export_bundle
from .cameras import camera_animation, picture_size, scene_cameras
from .census import take_census
from .geometry.frozen import save_geometry
from .geometry.surroundings import describe_surroundings
from .passes.gbuffer_scene import add_gbuffer_scene
from .reading.loading import load_scene
from .reading.packing import pack_everything, save_blend
from .tasks import BakeOptions, PendingBakes, PrepareAnswer, PrepareTask


class Worker:
    """Prepares one scene per task, a `PrepareTask`."""

    def __init__(self, common: dict[str, Any]) -> None:
        del common

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        wanted = PrepareTask.model_validate(task)
        made = prepare(wanted.source, wanted.scene_dir, strict=wanted.strict, bakes=wanted.bakes)
        return PrepareAnswer(bakes=made if isinstance(made, PendingBakes) else None).data()


def prepare(
    source: Path, scene_dir: Path, *, strict: bool = False, bakes: BakeOptions | None = None
) -> SceneSummary | PendingBakes:
    """Fill ``scene_dir`` from ``source``; where textures have to be baked first, say which and export nothing.

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
        return pending.model_copy(update={"external": tuple(loaded.external)})
    materials = export_bundle(frozen.meshes, converter)
    census = census.model_copy(update={"findings": list(findings)})
    radius = loaded.bounds.radius
    # near and far are placeholders for a camera at four radii; camera placement replaces them.
    frame = SceneFrame(
        near=1e-3 * radius,
        far=5 * radius,
        center=loaded.bounds.center,
        radius=radius,
        **export_display(scene, scene_dir),
    )
    save_geometry(scene_dir / "geometry.npz", frozen.meshes)
    cameras, animation = scene_cameras(scene), camera_animation(scene)
    # A missing file counts too: the scene is out of date when it turns up.
    external = {str(path): "missing" for path in loaded.missing}
    external |= {str(path): file_sha256(path) for path in loaded.external}
    warnings = loaded.warnings + pack_everything()
    gbuffer = add_gbuffer_scene(frozen.meshes, {name: converted.opacity for name, converted in materials.items()})
    summary = SceneSummary(
        bounds=loaded.bounds,
        triangles=sum(mesh.triangles for mesh in frozen.meshes),
        objects=max(mesh.object_id for mesh in frozen.meshes),
        instances=sum(1 + len(mesh.copies) for mesh in frozen.meshes),
        object_names={str(mesh.object_id): mesh.object_name for mesh in frozen.meshes},
        cameras=cameras,
        animation=animation,
        surroundings=describe_surroundings(gbuffer, cameras, animation),
        resolution=picture_size(scene),
        blender_version=bpy.app.version_string,
        atlas=atlas,
        repairs=frozen.repairs,
        has_light=loaded.has_light,
        bake_size=converter.baked_size(),
        external=external,
        warnings=warnings,
    )
    save_blend(scene_dir / "source.blend")
    write_json(scene_dir / "census.json", census.data())
    write_json(scene_dir / "frame.json", frame.model_dump(mode="json"))
    write_json(scene_dir / "summary.json", summary.data())
    if converter.bakes is not None:
        converter.bakes.prune()
    return summary

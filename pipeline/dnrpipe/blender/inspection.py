"""Worker of `dnrpipe inspect`: opens, freezes, counts, and converts into a folder that nobody keeps."""

from __future__ import annotations

from typing import Any

import bpy

from dnrpipe.core.errors import NothingVisible

from .baking.pending import convert_materials, place_atlas
from .bundle.export import export_bundle
from .census import take_census
from .findings import Findings
from .reading.loading import load_scene
from .reading.missing import note_missing
from .reading.scripts import note_drivers
from .tasks import BakeOptions, InspectAnswer, InspectTask


class Worker:
    """Inspects one scene per task, an `InspectTask`."""

    def __init__(self, common: dict[str, Any]) -> None:
        del common

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        return inspect(InspectTask.model_validate(task)).data()


def inspect(task: InspectTask) -> InspectAnswer:
    """Census, findings of the conversion, and warnings. Raises UserError for unusable input."""
    try:
        loaded = load_scene(task.source)
    except NothingVisible as nothing:  # what can be said of the open file
        findings = Findings()
        note_missing(findings)
        note_drivers(findings)
        return InspectAnswer(census=take_census(bpy.context.scene, findings, []), warnings=[str(nothing)])
    task.folder.mkdir(parents=True)
    meshes, findings = loaded.frozen.meshes, loaded.findings
    place_atlas(meshes, task.folder)
    census = take_census(loaded.scene, findings, meshes)
    # What would be baked is in the findings; placeholders stand for it in the bundle.
    bakes = BakeOptions(folder=task.folder / "bakes", size=task.bake_size)
    export_bundle(meshes, convert_materials(meshes, task.folder, findings, bakes))
    census = census.model_copy(update={"findings": list(findings)})
    return InspectAnswer(census=census, warnings=loaded.warnings)

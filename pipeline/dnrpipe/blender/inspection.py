"""Worker of `dnrpipe inspect`: open, freeze, count, and convert into a folder that nobody keeps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from dnrpipe.core.errors import NothingVisible

from .baking.rehearsal import BakeOptions, convert_materials, place_atlas
from .bundle.export import export_bundle
from .census import take_census
from .findings import Findings
from .reading.loading import load_scene
from .reading.missing import note_missing
from .reading.scripts import note_drivers


class Worker:
    """Inspects one scene per task: ``source`` (file), ``folder`` (scratch for the converted bundle), ``bake_size``."""

    def __init__(self, common: dict[str, Any]) -> None:
        del common

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        try:
            loaded = load_scene(Path(task["source"]))
        except NothingVisible as nothing:
            return _without_surface(str(nothing))
        folder = Path(task["folder"])
        folder.mkdir(parents=True)
        meshes, findings = loaded.frozen.meshes, loaded.findings
        place_atlas(meshes, folder)
        census = take_census(loaded.scene, findings, meshes)
        # What would be baked is in the findings; placeholders stand for it in the bundle.
        converter = convert_materials(meshes, folder, findings, BakeOptions(folder / "bakes", int(task["bake_size"])))
        export_bundle(meshes, folder, findings, converter)
        census["findings"] = findings.to_list()
        return {"census": census, "warnings": loaded.warnings}


def _without_surface(reason: str) -> dict[str, Any]:
    """What can be said of the open file when there is nothing to convert; ``reason`` is a warning."""
    findings = Findings()
    note_missing(findings)
    note_drivers(findings)
    census = take_census(bpy.context.scene, findings, [])
    census["findings"] = findings.to_list()
    return {"census": census, "warnings": [reason]}

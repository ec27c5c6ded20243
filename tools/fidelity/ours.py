"""The product's part, as a user runs it: conversion in worker processes, then the ray-tracing worker."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import dnrpipe
from dnrpipe.core.cameras import make_cameras, view_lenses
from dnrpipe.core.console import Console
from dnrpipe.core.scene_files import read_census, read_summary
from dnrpipe.core.settings import CameraSettings, resolve
from dnrpipe.core.workspace import Source, Workspace, file_sha256
from dnrpipe.raytrace.variants import choose_variant
from dnrpipe.stages.prepare import convert_scene
from dnrpipe.stages.stage import Run
from dnrpipe.workers.task_list import TaskResult, run_tasks
from dnrtrain.text import one_line

from .reference_settings import PATH_DEPTH


class FidelityError(RuntimeError):
    """A scene could not be converted or traced; one line says why."""


def convert(blend: Path, root: Path, *, quiet: bool = True) -> Workspace:
    """Convert ``blend`` into a fresh workspace at ``root``. Raises FidelityError with the conversion's own words."""
    if root.exists():
        shutil.rmtree(root)
    workspace = Workspace.create(root, Source(path=str(blend.resolve()), sha256=file_sha256(blend)))
    try:
        convert_scene(Run(workspace, resolve(None, {}), Console(quiet=quiet)))
    except Exception as error:
        raise FidelityError(f"{blend.stem}: {one_line(error)}") from error
    return workspace


def trace(
    workspace: Workspace, outputs: Sequence[Path], *, size: tuple[int, int], spp: int, bundle: Path | None = None
) -> list[dict[str, Any]]:
    """Trace the scene camera's view once per output, each with its own seed; linear premultiplied RGBA EXR."""
    summary = read_summary(workspace.scene)
    settings = CameraSettings(source="scene", train=1, val=0, test=0, width=size[0], height=size[1])
    summary = summary.model_copy(update={"cameras": [camera for camera in summary.cameras if camera.active]})
    view = make_cameras(summary, settings)["train"][0]
    lens = view_lenses(summary, settings).get(view.name)
    xml = bundle or workspace.scene / "scene.xml"
    choice = choose_variant("auto")
    tasks = [
        {
            "view": view.model_dump(mode="json"),
            "output": str(output),
            "spp": spp,
            "integrator": "volpath" if has_media(xml) else "path",
            "max_depth": PATH_DEPTH,
            "lens": lens,
            "seed": seed,
            "fingerprint": "fidelity",
        }
        for seed, output in enumerate(outputs)
    ]
    common = {"bundle": str(xml), "variant": choice.variant, "threads": 1}
    log = workspace.log("trace")
    done = _finish(
        run_tasks("dnrpipe.raytrace.tracer", common, tasks, workers=1, log=log, environment=choice.environment)
    )
    return [result.result or {} for result in done]


def _finish(outcomes: Iterable[TaskResult]) -> list[TaskResult]:
    finished = list(outcomes)
    for outcome in finished:
        if outcome.result is None:
            raise FidelityError(str(outcome.error))
    return finished


def has_media(xml: Path) -> bool:
    """Whether a bundle holds participating media, the only thing that ``path`` leaves out."""
    return "<medium" in xml.read_text(encoding="utf-8")


def findings(workspace: Workspace) -> list[dict[str, Any]]:
    """What the conversion said of the scene (``census.json``)."""
    return [finding.data() for finding in read_census(workspace.scene).findings]


CONVERSION = (
    "blender",
    "stages/prepare.py",
    *("core/cameras.py", "core/scene_files.py", "core/scene_records.py", "core/settings.py"),
)
TRACING = tuple(f"raytrace/{name}.py" for name in ("tracer", "engine", "sensors", "visibility"))
PLUGINS = ("raytrace/plugins",)


def code_hash(folders: Sequence[str]) -> str:
    """Hash of the product's Python files in these folders (or single files) of ``dnrpipe``."""
    root = Path(dnrpipe.__file__).parent
    digest = hashlib.sha256()
    for folder in folders:
        path = root / folder
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(f"{file.relative_to(root)}\0".encode() + file.read_bytes())
    return digest.hexdigest()[:16]


def tracing_hash(xml: Path) -> str:
    """Hash of the code that traces this bundle; our own Mitsuba plugins count where the bundle names one."""
    return code_hash((*TRACING, *PLUGINS) if '"dnr_' in xml.read_text(encoding="utf-8") else TRACING)


def bundle_hash(xml: Path) -> str:
    """Hash of a bundle's content: the XML and every file that it names."""
    folder = xml.parent
    digest = hashlib.sha256(xml.read_bytes())
    for name in ("meshes", "textures", "volumes"):
        for file in sorted((folder / name).glob("*")):
            digest.update(f"{file.name}\0".encode() + file.read_bytes())
    return digest.hexdigest()[:16]

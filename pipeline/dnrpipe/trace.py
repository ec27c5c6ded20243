"""Stage `raytrace-selected`: path tracing of the selected views, and of test views on demand."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

from dnrtrain.contract import View
from dnrtrain.exr import read_metadata

from .console import Console
from .costs import CostRecord
from .prepare import split_views
from .raytrace.variants import choose_variant
from .scene_files import scene_fingerprint
from .settings import Settings
from .stages import Outcome
from .tasks import is_made, run_view_tasks, view_record, worker_count
from .training import read_selection
from .workspace import Workspace, digest

TRACE_VERSION = 1


def run(workspace: Workspace, settings: Settings, console: Console, run_id: str) -> Outcome:
    """Trace the selected views that are not on disk yet."""
    by_name = {view.name: view for view in split_views(workspace)["train"]}
    selected = [by_name[name] for name in read_selection(workspace)["views"]]
    tasks = trace_views(
        workspace,
        settings,
        console,
        run_id,
        views=selected,
        split="train",
        spp=settings.raytrace.spp,
        stage="raytrace",
        purpose="training",
    )
    return Outcome(
        digest([task["fingerprint"] for task in tasks]),
        {"views": [view.name for view in selected], "spp": settings.raytrace.spp},
    )


def progress(workspace: Workspace, settings: Settings) -> tuple[int, int]:
    """(selected views on disk, selected views)."""
    if not workspace.selection.exists():
        return 0, settings.select.budget
    names = read_selection(workspace)["views"]
    return sum(workspace.raytraced("train", name).exists() for name in names), len(names)


def trace_views(
    workspace: Workspace,
    settings: Settings,
    console: Console,
    run_id: str,
    *,
    views: list[View],
    split: str,
    spp: int,
    stage: str,
    purpose: str,
) -> list[dict[str, Any]]:
    """Path-trace ``views`` into ``raytraced/<split>``; views already there are kept. Returns all tasks."""
    bundle = scene_fingerprint(workspace)
    tasks = [
        {
            "view": view.model_dump(mode="json"),
            "output": str(workspace.raytraced(split, view.name)),
            "spp": spp,
            "max_depth": settings.raytrace.max_depth,
            "seed": view_seed(settings.raytrace.seed, split, view.name),
        }
        for view in views
    ]
    for task in tasks:
        decisive = {key: task[key] for key in ("view", "spp", "max_depth", "seed")}
        task["fingerprint"] = digest([TRACE_VERSION, bundle, decisive])
    if all(is_made(task) for task in tasks):
        return tasks
    choice = choose_variant(settings.raytrace.variant)
    console.say(f"ray tracing with Mitsuba {choice.variant}")
    workers = 1 if choice.variant.startswith("cuda") else worker_count(settings.raytrace.workers)

    def book(task: dict[str, Any], result: dict[str, Any], count: int) -> CostRecord:
        return view_record(
            run=run_id,
            stage=stage,
            purpose=purpose,
            task=task,
            result=result,
            workers=count,
            device=f"mitsuba {choice.variant}",
        )

    run_view_tasks(
        "ray tracing" if split == "train" else "ray tracing test views",
        "dnrpipe.raytrace.tracer",
        {"bundle": str(workspace.scene / "scene.xml"), "variant": choice.variant, "threads": 1},
        tasks,
        workspace=workspace,
        console=console,
        stage=stage,
        workers=workers,
        book=book,
        environment=choice.environment,
    )
    _warn_repairs(tasks, console)
    return tasks


def view_seed(seed: int, split: str, name: str) -> int:
    """A seed of its own for every view, stable across runs and machines; below 2^18 (passes add bits)."""
    return zlib.crc32(f"{seed}/{split}/{name}".encode()) & 0x3FFFF


def _warn_repairs(tasks: list[dict[str, Any]], console: Console) -> None:
    for task in tasks:
        metadata = read_metadata(Path(task["output"])) or {}
        if metadata.get("repaired") or metadata.get("masked"):
            console.warn(
                f"view {task['view']['name']}: repaired {metadata['repaired']} non-finite pixels by tracing"
                f" them again, set {metadata['masked']} to zero"
            )

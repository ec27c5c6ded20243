"""Stage `raytrace-selected`: path tracing of the selected views, and of test views on demand."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

from dnrtrain.contract import ContractError, View
from dnrtrain.exr import read_metadata

from ..core.scene_files import read_selection, scene_fingerprint, split_views
from ..core.settings import Settings
from ..core.workspace import RaytraceDetail, Workspace, digest
from ..effects.plan import EffectPlan
from ..effects.store import lenses, plan_of, trace_config, variant_for
from ..raytrace.sample_schedule import Goal
from ..workers.view_tasks import is_made, task_name, warn_of_repairs, worker_count
from .adaptive_sampling import sample_adaptively
from .base_images import RENDERED, base_path, base_renderer, base_views
from .effect_plan import resolve_plan
from .stage import Outcome, Run

TRACE_VERSION = 4
SAMPLES_VERSION = 1


def raytrace_selected(run: Run) -> Outcome:
    """Trace the selected views that are not on disk yet, and render the base images that go with them."""
    workspace, settings = run.workspace, run.settings
    by_name = {view.name: view for view in split_views(workspace)["train"]}
    selected = [by_name[name] for name in read_selection(workspace).views]
    tasks = trace_views(run, selected, "train")
    bases = base_views(run, selected, "train")
    made: list[Any] = [task["fingerprint"] for task in [*tasks, *bases]]
    if not selected:  # then base images are all that frames are made of
        made.append(base_renderer(workspace, settings, resolve_plan(run)).fingerprint)
    spp = [(read_metadata(Path(task["output"])) or {}).get("spp") for task in tasks]
    if goal_of(settings, "train") is not None:
        made.append(spp)  # with a time, how many samples were taken is not known before
    traced = settings.raytrace.spp if goal_of(settings, "train") is None else spp
    return Outcome(digest(made), RaytraceDetail(views=[view.name for view in selected], spp=traced).model_dump())


def progress(workspace: Workspace, settings: Settings) -> tuple[int, int]:
    """(selected views on disk, selected views)."""
    wanted = settings.select.most
    if not workspace.selection.exists():
        return 0, wanted
    try:
        names = read_selection(workspace).views
    except ContractError:
        return 0, wanted  # damaged: the stage mends it when it runs
    rendered = settings.model.base in RENDERED
    made = [
        workspace.raytraced("train", name).exists() and (not rendered or base_path(workspace, "train", name).exists())
        for name in names
    ]
    return sum(made), len(names)


def trace_views(run: Run, views: list[View], split: str, *, spp: int | None = None) -> list[dict[str, Any]]:
    """Path-trace the views into ``raytraced/<split>``; views already there are kept. Returns all tasks.

    spp: samples per pixel instead of the settings', where these name no noise or time for the split (`goal_of`).
    """
    settings = run.settings
    plan = resolve_plan(run)
    goal = goal_of(settings, split)
    tasks = _tasks(run.workspace, settings, plan, views, split, spp)
    if all(is_made(task) for task in tasks):
        return tasks
    choice = variant_for(plan, settings)
    config = trace_config(run.workspace, plan, choice.variant)
    run.console.say(f"ray tracing with Mitsuba {choice.variant}, {plan.integrator}, depth {plan.max_depth}")
    workers = 1 if choice.variant.startswith("cuda") else worker_count(settings.raytrace.workers)
    book = run.book_views(f"mitsuba {choice.variant}")
    label = {"train": "ray tracing", "test": "ray tracing test views"}.get(split, "ray tracing small views")
    common = {"bundle": config["bundle"], "variant": choice.variant, "threads": 1}
    if goal is None:
        module = "dnrpipe.raytrace.tracer"
        run.view_tasks(label, module, common, tasks, workers=workers, book=book, environment=choice.environment)
    else:
        environment = choice.environment
        sample_adaptively(run, label, common, tasks, goal, workers=workers, book=book, environment=environment)
    warn_of_repairs(tasks, run.console)
    return tasks


def reference_is_made(workspace: Workspace, settings: Settings, view: View) -> bool:
    """Whether a test view's reference is on disk and up to date."""
    plan = plan_of(workspace, settings)
    if plan.max_depth is None:
        return False  # the pilot that decides it has not run, or was of another scene
    (task,) = _tasks(workspace, settings, plan, [view], "test")
    return is_made(task)


def _tasks(
    workspace: Workspace,
    settings: Settings,
    plan: EffectPlan,
    views: list[View],
    split: str,
    spp: int | None = None,
) -> list[dict[str, Any]]:
    """What `trace_views` has to do, with the fingerprints of the files that come out."""
    scene = scene_fingerprint(workspace)
    spp = spp or (settings.raytrace.evaluation_spp if split == "test" else settings.raytrace.spp)
    known = lenses(workspace, settings) if plan.on("depth-of-field") else {}
    goal = goal_of(settings, split)
    tasks: list[dict[str, Any]] = [
        {
            "view": view.model_dump(mode="json"),
            "output": str(workspace.raytraced(split, view.name)),
            "spp": spp,
            "integrator": plan.integrator,
            "max_depth": plan.max_depth,
            "lens": known.get(view.name),
            "seed": view_seed(settings.raytrace.seed, split, view.name),
        }
        for view in views
    ]
    light = [sorted(plan.left_out), plan.on("spectral")]
    wanted = settings.raytrace.evaluation_denoise if split == "test" else settings.raytrace.denoise
    for task in tasks:
        decisive = {key: task[key] for key in ("view", "spp", "integrator", "max_depth", "lens", "seed")}
        if goal is not None:
            del task["spp"], decisive["spp"]
            path = workspace.raytraced(split, task_name(task).partition("/")[2])
            task["samples"] = str(path.parent / "samples" / f"{path.stem}.npz")
            task["samples_fingerprint"] = digest([SAMPLES_VERSION, scene, decisive, light])
            decisive["goal"] = [goal.noise, goal.seconds, goal.limit]
        if wanted:
            task["denoise"] = decisive["denoise"] = True
        task["fingerprint"] = digest([TRACE_VERSION, scene, decisive, light])
    return tasks


def goal_of(settings: Settings, split: str) -> Goal | None:
    """The noise or time that views of the split are traced to; None: the samples per pixel are set."""
    raytrace = settings.raytrace
    targets = {"test": (raytrace.evaluation_noise, None), "train": (raytrace.noise, raytrace.time)}
    noise, seconds = targets.get(split, (None, None))
    return None if noise is None and seconds is None else Goal(noise, seconds, raytrace.max_spp)


def view_seed(seed: int, split: str, name: str) -> int:
    """A seed of its own for every view, stable across runs and machines; below 2^18 (passes add bits)."""
    return zlib.crc32(f"{seed}/{split}/{name}".encode()) & 0x3FFFF

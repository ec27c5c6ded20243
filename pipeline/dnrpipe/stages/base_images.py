"""Base images: what the network corrects. Bakes the scene's light once, then renders views from it, on demand.

Which one it is says ``model.base``: ``none``; ``raster``, the rasterised colour of the passes; ``baked``, baked light
and specular paths; ``direct`` or ``path``, a few path-traced samples, denoised (direct light alone, or the plan's
depth).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import NPZ_ERRORS, View

from ..core.console import Console
from ..core.errors import UserError
from ..core.ledger import CostRecord
from ..core.scene_files import scene_fingerprint
from ..core.settings import Settings
from ..core.workspace import Workspace, digest
from ..effects.plan import EffectPlan
from ..effects.store import plan_of, resolve_plan, trace_config
from ..raytrace.variants import VariantChoice, choose_variant
from ..workers.processes import Retry, run_tasks
from ..workers.view_tasks import is_made, run_view_tasks, task_name, view_record, warn_repairs

LIGHT_VERSION, BASE_VERSION = 5, 11
RENDERED = ("baked", "direct", "path")
"""Kinds of base images that are rendered into files of their own."""
AUTOMATIC_TEXELS = 4
"""Light map texels per pixel of an image's side: about one texel a pixel where the atlas shows a part of itself."""
SIZES = (256, 4096)
SPP = (32, 128)


def base_path(workspace: Workspace, split: str, name: str) -> Path:
    """``base/<split>/<view>.exr``."""
    return workspace.root / "base" / split / f"{name}.exr"


def light_path(workspace: Workspace) -> Path:
    """The baked light of the scene."""
    return workspace.root / "base" / "light.npz"


def light_size(settings: Settings) -> int:
    """Texels of the light map's side: the setting, else a power of two that suits the images."""
    if settings.base.light_size != "auto":
        return settings.base.light_size
    wanted = AUTOMATIC_TEXELS * max(settings.cameras.width, settings.cameras.height)
    return int(min(max(2 ** round(np.log2(wanted)), SIZES[0]), SIZES[1]))


def light_spp(settings: Settings) -> int:
    """Paths per texel: the setting, else as many as keep their sum what it is at 512², within SPP.

    A finer map has more texels on the same surface, and the denoiser averages over them.
    """
    if settings.base.light_spp != "auto":
        return settings.base.light_spp
    return int(min(max(SPP[1] * (512 / light_size(settings)) ** 2, SPP[0]), SPP[1]))


def base_views(
    workspace: Workspace,
    settings: Settings,
    console: Console,
    run_id: str,
    *,
    views: Sequence[View],
    split: str,
    stage: Any,
    purpose: Any,
    paths: Sequence[Path] | None = None,
    held_out: View | None = None,
) -> list[dict[str, Any]]:
    """Render the base images of ``views`` that are missing or out of date; returns all tasks ([] where none is due).

    paths: where they go instead of ``base/<split>``. held_out: a test view, which evaluation will want, rendered by
    the same worker while it is there and booked as evaluation's; its task is not returned. Raises UserError where this
    machine has no jit variant of Mitsuba.
    """
    kind = settings.model.base
    if kind not in RENDERED or not views:
        return []
    plan = resolve_plan(workspace, settings, console, run_id, stage)
    common, environment, stamp = _prepared(workspace, settings, console, run_id, plan, stage)
    paths = paths or [base_path(workspace, split, view.name) for view in views]
    tasks = [_task(view, path, stamp) for view, path in zip(views, paths, strict=True)]
    ahead = [] if held_out is None else [_task(held_out, base_path(workspace, "test", held_out.name), stamp)]

    def book(task: dict[str, Any], result: dict[str, Any], workers: int) -> CostRecord:
        record = view_record(
            run=run_id,
            stage="evaluate" if task in ahead else stage,
            purpose="evaluation" if task in ahead else purpose,
            task=task,
            result=result,
            workers=workers,
            device=f"mitsuba {common['variant']}",
        )
        return record.model_copy(update={"name": f"base/{task_name(task)}"})

    run_view_tasks(
        "base images",
        "dnrpipe.raytrace.base_worker",
        common,
        [*tasks, *ahead],
        workspace=workspace,
        console=console,
        stage=stage,
        workers=1,  # a kernel to compile; its threads fill the machine
        book=book,
        environment=environment,
    )
    warn_repairs(tasks, console)
    return tasks


def base_is_made(workspace: Workspace, settings: Settings, split: str, view: View) -> bool:
    """Whether the view's base image is on disk and up to date; looks at files alone, without Mitsuba."""
    # No file depends on the variant that rendered it.
    *_, stamp = renderer_inputs(workspace, settings, plan_of(workspace, settings), VariantChoice("llvm_ad_rgb", {}, ""))
    return is_made(_task(view, base_path(workspace, split, view.name), stamp))


def _task(view: View, path: Path, stamp: str) -> dict[str, Any]:
    data = view.model_dump(mode="json")
    return {"view": data, "output": str(path), "fingerprint": digest([BASE_VERSION, stamp, data])}


def _prepared(
    workspace: Workspace, settings: Settings, console: Console, run_id: str, plan: EffectPlan, stage: Any
) -> tuple[dict[str, Any], dict[str, str], str]:
    """(what the workers share, their environment, a hash of all that decides the images but for the view)."""
    common, environment, task, stamp = renderer_inputs(workspace, settings, plan)
    if task is not None:
        bake_light(workspace, console, run_id, stage, common, environment, task)
    return common, environment, stamp


def ready_inputs(workspace: Workspace, settings: Settings) -> tuple[dict[str, Any], dict[str, str]]:
    """(what base image workers share, their environment) of a workspace whose light is baked; writes no results.

    Raises UserError: ``model.base`` is not rendered, or the light is not baked or out of date.
    """
    if settings.model.base not in RENDERED:
        raise UserError(f"base images of kind {settings.model.base} are not rendered")
    common, environment, task, _ = renderer_inputs(workspace, settings, plan_of(workspace, settings))
    if task is not None and not light_is_baked(task):
        raise UserError(f"{workspace.root}: the baked light is out of date; run `dnrpipe raytrace-selected` first")
    return common, environment


def renderer_inputs(
    workspace: Workspace, settings: Settings, plan: EffectPlan, choice: VariantChoice | None = None
) -> tuple[dict[str, Any], dict[str, str], dict[str, Any] | None, str]:
    """(what the workers share, their environment, the task that bakes the light or None, a hash of all that decides
    the images but for the view). choice: instead of the variant that this machine can run."""
    chosen, kind = settings.base, settings.model.base
    choice = choice or choose_variant(settings.raytrace.variant)
    if choice.variant.startswith("scalar"):
        raise UserError(
            f"model.base={kind} needs a jit variant of Mitsuba (LLVM or CUDA; see `dnrpipe doctor`);"
            " or choose --set model.base=raster"
        )
    config = trace_config(workspace, plan, choice.variant)
    light = [config["integrator"], config["max_depth"], sorted(plan.left_out), scene_fingerprint(workspace)]
    common: dict[str, Any] = {
        "bundle": config["bundle"],
        "variant": choice.variant,
        "kind": kind,
        "samples": chosen.samples,
    }
    if kind == "baked":
        common |= {"light": str(light_path(workspace)), "denoise": chosen.denoise}
        task = {
            "output": common["light"],
            "size": light_size(settings),
            "spp": light_spp(settings),
            "integrator": config["integrator"],
            "max_depth": config["max_depth"],
            "seed": settings.raytrace.seed,
        }
        task["fingerprint"] = digest([LIGHT_VERSION, light, {k: v for k, v in task.items() if k != "output"}])
        return common, choice.environment, task, digest([task["fingerprint"], chosen.samples, chosen.denoise])
    direct = kind == "direct"
    common |= {
        "integrator": "path" if direct else config["integrator"],
        "max_depth": 2 if direct else config["max_depth"],
        "spp": chosen.spp,
        "seed": settings.raytrace.seed,
    }
    stamp = digest([kind, light, chosen.spp, chosen.samples, settings.raytrace.seed])
    return common, choice.environment, None, stamp


def light_is_baked(task: dict[str, Any]) -> bool:
    """Whether the light of :func:`renderer_inputs` is on disk."""
    return _light_print(Path(task["output"])) == task["fingerprint"]


def bake_light(
    workspace: Workspace,
    console: Console,
    run_id: str,
    stage: Any,
    common: dict[str, Any],
    environment: dict[str, str],
    task: dict[str, Any],
) -> dict[str, Any] | None:
    """Bake the light where it is missing or of other inputs -> the worker's answer; None where nothing was due.

    common, environment, task: of :func:`renderer_inputs`. Booked in the ledger under ``stage``.
    Raises UserError: it failed twice.
    """
    if light_is_baked(task):
        return None
    result: dict[str, Any] = {}
    shared = {"bundle": common["bundle"], "variant": common["variant"]}
    with console.bar("baking light", 1) as bar:
        outcomes = run_tasks(
            "dnrpipe.raytrace.light_worker",
            shared,
            [task],
            workers=1,
            log=workspace.log(stage),
            environment=environment,
        )
        for outcome in outcomes:
            if isinstance(outcome, Retry):
                console.warn(f"baking light: {outcome.reason}; trying once more")
                continue
            if outcome.result is None:
                raise UserError(f"baking light failed twice: {outcome.error}; see {workspace.log(stage)}")
            result = outcome.result
            bar.advance(note=f"{task['size']}² texels, {task['spp']} spp")
            if result["lost"]:
                console.warn(f"repaired: {result['lost']} samples of the baked light were not finite and are left out")
            workspace.ledger.append(
                CostRecord(
                    time=time.time(),
                    run=run_id,
                    stage=stage,
                    purpose="training",
                    unit="scene",
                    name="light",
                    seconds=result["seconds"],
                    cpu_seconds=result["cpu_seconds"],
                    device=f"mitsuba {common['variant']}",
                    spp=task["spp"],
                    peak_mb=result["peak_mb"],
                    detail={"texels": result["texels"], "lost": result["lost"]},
                )
            )
    return result


def _light_print(path: Path) -> str | None:
    try:
        with np.load(path, allow_pickle=False) as data:
            return str(data["fingerprint"])
    except NPZ_ERRORS:
        return None

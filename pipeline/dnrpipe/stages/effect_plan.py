"""The effect plan with its path depth: runs the pilot that finds how deep paths must go."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..effects.plan import DepthPilot, EffectPlan
from ..effects.store import (
    PILOT_RESOLUTION,
    PILOT_SPP,
    keep_plan,
    pilot_fingerprint,
    pilot_views,
    plan_of,
    trace_config,
    variant_for,
)
from ..raytrace.statistics import REFERENCE_DEPTH
from ..raytrace.variants import VariantChoice
from ..workers.view_tasks import only_answer
from .stage import Run


def resolve_plan(run: Run) -> EffectPlan:
    """The whole plan: runs the path depth pilot where the plan needs it, and writes ``scene/effects.json``."""
    workspace, settings = run.workspace, run.settings
    plan = plan_of(workspace, settings)
    if plan.max_depth is None:
        with run.timed("path depth pilot: process"):
            pilot = _run_pilot(run, plan)
        keep_plan(workspace, plan.model_copy(update={"pilot": pilot}))
        plan = plan_of(workspace, settings)
        assert plan.max_depth is not None
        run.console.say(f"path depth {plan.max_depth}: {plan.effect('indirect').evidence[0].partition(': ')[2]}")
    keep_plan(workspace, plan)
    return plan


def _run_pilot(run: Run, plan: EffectPlan) -> DepthPilot:
    choice = variant_for(plan, run.settings)
    views = pilot_views(run.workspace, run.settings, plan)
    chosen = run.settings.effects
    task = {
        "kind": "depth",
        "config": trace_config(run.workspace, plan, choice.variant),
        "views": views,
        "spp": PILOT_SPP,
        "tolerance": chosen.tolerance,
        "pixel_tolerance": chosen.pixel_tolerance,
    }
    (answer,) = run_pilots([task], choice, run, "path depth pilot", run.log)
    run.book(
        "training",
        "scene",
        "path depth pilot",
        answer["seconds"],
        cpu_seconds=answer["cpu_seconds"],
        device=f"mitsuba {choice.variant}",
        detail={"max_depth": answer["max_depth"], "spp": answer["spp"]},
    )
    return DepthPilot(
        fingerprint=pilot_fingerprint(run.workspace, run.settings, plan),
        max_depth=answer["max_depth"],
        reference_depth=REFERENCE_DEPTH,
        tolerance=chosen.tolerance,
        pixel_tolerance=chosen.pixel_tolerance,
        views=len(views),
        resolution=PILOT_RESOLUTION,
        spp=answer["spp"],
        seconds=answer["seconds"],
        steps=answer["steps"],
    )


def run_pilots(
    tasks: list[dict[str, Any]], choice: VariantChoice, run: Run, label: str, log: Path
) -> list[dict[str, Any]]:
    """Run pilot tasks, each in a process of its own (bundles add up in memory); answers in the tasks' order.

    Raises UserError when one fails twice.
    """
    results: list[dict[str, Any]] = []
    console = run.console
    with console.bar(label, len(tasks)) as bar:
        for task in tasks:
            common = {"configs": [task[key] for key in ("config", "with_effect", "without_effect") if key in task]}
            module, environment = "dnrpipe.raytrace.pilot", choice.environment
            result = only_answer(
                label, module, common, task, log=log, console=console, environment=environment, place=run.place
            )
            if lost := result["masked"]:
                console.warn(f"repaired: {lost} pixels of {label} pictures were not finite and are black")
            results.append(result)
            bar.advance()
    return results

"""The effect plan of a workspace: made from ``scene/``, kept in ``scene/effects.json``, carried out by the tracer."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from dnrtrain.atomic import write_json
from dnrtrain.contract import read_cameras

from ..core.cameras import scaled_to, view_lenses
from ..core.console import Console
from ..core.effect_names import EffectName
from ..core.errors import UserError
from ..core.ledger import CostRecord
from ..core.scene_files import read_json, read_summary, scene_fingerprint
from ..core.settings import Settings
from ..core.workspace import Workspace, digest
from ..raytrace.statistics import REFERENCE_DEPTH, Measured
from ..raytrace.variants import VariantChoice, choose_variant
from ..workers.processes import Retry, run_tasks
from .bundle import bundle_facts, write_without
from .plan import DepthPilot, EffectPlan, plan_effects

PILOT_VERSION = 1
PILOT_VIEWS = 4
PILOT_RESOLUTION = 96
PILOT_SPP = 8  # of each half
FILE = "effects.json"


def plan_of(
    workspace: Workspace,
    settings: Settings,
    *,
    enable: Sequence[EffectName] | None = None,
    disable: Sequence[EffectName] | None = None,
    pilot: DepthPilot | None = None,
) -> EffectPlan:
    """The plan as far as it is known; ``max_depth`` is None while its pilot has not run.

    enable, disable: instead of the settings'. pilot: instead of the one on disk, even if it is of another plan.
    Raises UserError where the scene is not prepared.
    """
    chosen = settings.effects
    census = read_json(workspace.scene / "census.json")
    arguments: dict[str, Any] = {
        "census": census,
        "bundle": bundle_facts(workspace.scene / "scene.xml"),
        "enable": chosen.enable if enable is None else enable,
        "disable": chosen.disable if disable is None else disable,
        "max_depth": settings.raytrace.max_depth,
        "lenses": tuple(lenses(workspace, settings)),
    }
    plan = plan_effects(**arguments)
    stored = _stored(workspace)
    if plan.max_depth is None:
        if pilot is None and stored is not None and stored.pilot is not None:
            fits = stored.pilot.fingerprint == _pilot_print(workspace, settings, plan)
            pilot = stored.pilot if fits else None
        plan = plan if pilot is None else plan_effects(**arguments, pilot=pilot)
    return plan if stored is None else _with_measurements(plan, stored)


def resolve_plan(workspace: Workspace, settings: Settings, console: Console, run_id: str, stage: Any) -> EffectPlan:
    """The whole plan: runs the path depth pilot where the plan needs it, and writes ``scene/effects.json``."""
    plan = plan_of(workspace, settings)
    if plan.max_depth is None:
        pilot = _run_pilot(workspace, settings, plan, console, run_id, stage)
        keep_plan(workspace, plan.model_copy(update={"pilot": pilot}))
        plan = plan_of(workspace, settings)
        assert plan.max_depth is not None
        console.say(f"path depth {plan.max_depth}: {plan.effect('indirect').evidence[0].partition(': ')[2]}")
    keep_plan(workspace, plan)
    return plan


def keep_plan(workspace: Workspace, plan: EffectPlan) -> None:
    """Write ``scene/effects.json`` where it changed; a pilot that this plan does not need stays known."""
    stored = _stored(workspace)
    if stored is not None and plan.pilot is None:
        plan = plan.model_copy(update={"pilot": stored.pilot})
    if plan != stored:
        write_json(workspace.scene / FILE, plan.model_dump(mode="json"))


def trace_config(workspace: Workspace, plan: EffectPlan, variant: str) -> dict[str, Any]:
    """How views are traced under the plan: {"bundle", "integrator", "max_depth", "variant", "lenses"}.

    ``bundle`` is scene.xml, or a copy beside it without the effects that the user switched off.
    """
    bundle = workspace.scene / "scene.xml"
    if plan.left_out:
        edited = workspace.scene / f"scene-{digest(sorted(plan.left_out))[:8]}.xml"
        write_without(bundle, plan.left_out, edited)
        bundle = edited
    return {
        "bundle": str(bundle),
        "integrator": plan.integrator,
        "max_depth": REFERENCE_DEPTH if plan.max_depth is None else plan.max_depth,
        "variant": variant.replace("_rgb", "_spectral") if plan.on("spectral") else variant,
        "lenses": plan.on("depth-of-field"),
    }


def variant_for(plan: EffectPlan, settings: Settings) -> VariantChoice:
    """The Mitsuba variant: the settings', its spectral twin where the plan wants spectra."""
    choice = choose_variant(settings.raytrace.variant)
    return choose_variant(choice.variant.replace("_rgb", "_spectral")) if plan.on("spectral") else choice


def lenses(workspace: Workspace, settings: Settings) -> dict[str, dict[str, float]]:
    """Lenses of the views that have depth of field, by view name."""
    return view_lenses(read_summary(workspace), settings.cameras)


def pilot_views(workspace: Workspace, settings: Settings, plan: EffectPlan) -> list[dict[str, Any]]:
    """A few training views, spread over all, at pilot resolution: [{"view": JSON, "lens": dict | None}].

    Raises UserError where no views have been placed yet.
    """
    path = workspace.cameras("train")
    if not path.exists():
        raise UserError(f"{workspace.root}: no views yet; run `dnrpipe prepare` first")
    views = read_cameras(path)
    count = min(PILOT_VIEWS, len(views))
    chosen = [views[(2 * i + 1) * len(views) // (2 * count)] for i in range(count)]
    known = lenses(workspace, settings) if plan.on("depth-of-field") else {}
    return [
        {"view": scaled_to(view, PILOT_RESOLUTION).model_dump(mode="json"), "lens": known.get(view.name)}
        for view in chosen
    ]


def _pilot_print(workspace: Workspace, settings: Settings, plan: EffectPlan) -> str:
    chosen = settings.effects
    return digest(
        [
            PILOT_VERSION,
            scene_fingerprint(workspace),
            pilot_views(workspace, settings, plan),
            PILOT_SPP,
            [chosen.tolerance, chosen.pixel_tolerance],
            sorted(plan.left_out),
            [plan.integrator, plan.on("spectral")],
        ]
    )


def _run_pilot(
    workspace: Workspace, settings: Settings, plan: EffectPlan, console: Console, run_id: str, stage: Any
) -> DepthPilot:
    choice = variant_for(plan, settings)
    views = pilot_views(workspace, settings, plan)
    chosen = settings.effects
    task = {
        "kind": "depth",
        "config": trace_config(workspace, plan, choice.variant),
        "views": views,
        "spp": PILOT_SPP,
        "tolerance": chosen.tolerance,
        "pixel_tolerance": chosen.pixel_tolerance,
    }
    (answer,) = run_pilots(workspace, [task], choice, console, "path depth pilot", stage)
    workspace.ledger.append(
        CostRecord(
            time=time.time(),
            run=run_id,
            stage=stage,
            purpose="training",
            unit="scene",
            name="path depth pilot",
            seconds=answer["seconds"],
            cpu_seconds=answer["cpu_seconds"],
            device=f"mitsuba {choice.variant}",
            detail={"max_depth": answer["max_depth"], "spp": answer["spp"]},
        )
    )
    return DepthPilot(
        fingerprint=_pilot_print(workspace, settings, plan),
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
    workspace: Workspace,
    tasks: list[dict[str, Any]],
    choice: VariantChoice,
    console: Console,
    label: str,
    stage: str,
) -> list[dict[str, Any]]:
    """Run pilot tasks, each in a process of its own (bundles add up in memory); answers in the tasks' order.

    Raises UserError when one fails twice.
    """
    answers: list[dict[str, Any]] = []
    log = workspace.log(stage)
    with console.bar(label, len(tasks)) as bar:
        for task in tasks:
            common = {"configs": [task[key] for key in ("config", "with_effect", "without_effect") if key in task]}
            outcomes = run_tasks(
                "dnrpipe.raytrace.pilot", common, [task], workers=1, log=log, environment=choice.environment
            )
            try:
                for outcome in outcomes:
                    if isinstance(outcome, Retry):
                        console.warn(f"{label}: {outcome.reason}; trying once more")
                    elif outcome.result is None:
                        raise UserError(f"{label}: {outcome.error}; see {log}")
                    else:
                        answers.append(outcome.result)
                        if lost := outcome.result["masked"]:
                            console.warn(f"repaired: {lost} pixels of {label} pictures were not finite and are black")
            finally:
                outcomes.close()  # type: ignore[attr-defined]
            bar.advance()
    return answers


def _stored(workspace: Workspace) -> EffectPlan | None:
    path = workspace.scene / FILE
    if not path.exists():
        return None
    try:
        return EffectPlan.model_validate(read_json(path))
    except (ValidationError, UserError):  # of another version, or torn: the plan is made again
        return None


def _with_measurements(plan: EffectPlan, stored: EffectPlan) -> EffectPlan:
    """Columns measured before, where nothing that they depend on changed."""
    same = (plan.integrator, plan.max_depth, plan.left_out) == (stored.integrator, stored.max_depth, stored.left_out)
    known: dict[str, tuple[Measured | None, Measured | None]] = {e.name: (e.cost, e.error) for e in stored.effects}
    if not same:
        return plan
    rows = [
        e.model_copy(update=dict(zip(("cost", "error"), known.get(e.name, (None, None)), strict=True)))
        for e in plan.effects
    ]
    return plan.model_copy(update={"effects": tuple(rows)})

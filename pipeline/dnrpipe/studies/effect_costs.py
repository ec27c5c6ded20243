"""`dnrpipe effects`: the plan as a table, its overrides, and what each effect costs and changes, measured."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..core.effect_names import FORCEABLE, NAMES, EffectName
from ..core.errors import UserError
from ..effects.plan import Effect, EffectPlan
from ..effects.store import keep_plan, pilot_views, plan_of, trace_config, variant_for
from ..raytrace.statistics import Measured
from ..stages.effect_plan import resolve_plan, run_pilots
from ..stages.stage import Run

if TYPE_CHECKING:
    from ..core.settings import Settings
    from ..stages.session import Session

MEASURE_SPP = 16  # of each half


def override_settings(
    enable: Sequence[str], disable: Sequence[str], auto: Sequence[str]
) -> Callable[[Settings], dict[str, Any]]:
    """The settings that the flags change, given those in force. Raises UserError for a name that is no effect."""
    for name in (*enable, *disable, *auto):
        if name not in NAMES:
            raise UserError(f"no effect '{name}'; they are {', '.join(NAMES)}")
    if twice := set(enable) & set(disable):
        raise UserError(f"--enable and --disable {sorted(twice)[0]}: give one of them")

    def change(settings: Settings) -> dict[str, Any]:
        if not (enable or disable or auto):
            return {}
        now, dropped = settings.effects, {*enable, *disable, *auto}
        enabled = [*(n for n in now.enable if n not in dropped), *dict.fromkeys(enable)]
        disabled = [*(n for n in now.disable if n not in dropped), *dict.fromkeys(disable)]
        return {"effects": {"enable": enabled, "disable": disabled}}

    return change


def show_effects(session: Session, *, measure: bool) -> None:
    """Print the plan; with ``measure``, fill its columns first."""
    from ..stages.pipeline import STAGES, state

    run = session.run
    workspace, settings, console = run.workspace, run.settings, run.console
    if (found := state(STAGES["prepare"], workspace, settings)) in ("missing", "stale"):
        why = {"missing": "has not run", "stale": "is out of date"}[found]
        raise UserError(f"effects: prepare {why} for {workspace.root}; run `dnrpipe prepare` first")
    plan = plan_of(workspace, settings)
    for name in settings.effects.disable:
        if plan.on(name):
            raise UserError(f"--disable {name}: cannot be left out of this scene; undo with --auto {name}")
    for name in settings.effects.enable:
        if not plan.on(name) and name not in settings.effects.disable:
            raise UserError(f"--enable {name}: there is nothing to simulate ({plan.effect(name).evidence[0]})")
    workspace.save()
    if measure:
        run = replace(run, id=f"effects-{int(time.time()):x}")
        plan = measure_plan(run, resolve_plan(run))
        keep_plan(workspace, plan)
    if not console.json_mode:
        console.say(table(plan))
    console.result({"workspace": str(workspace.root), **plan.model_dump(mode="json")})


def measure_plan(run: Run, plan: EffectPlan) -> EffectPlan:
    """The plan with cost and error of every effect that changes how views are traced.

    Each effect is compared with the same plan but for that effect, on a few training views with the same seeds.
    """
    workspace, settings = run.workspace, run.settings
    choice = variant_for(plan, settings)
    base = trace_config(workspace, plan, choice.variant)
    tasks: dict[EffectName, dict[str, Any]] = {}
    for effect in plan.effects:
        other = _toggled(run, plan, effect)
        if other is None or (config := trace_config(workspace, other, choice.variant)) == base:
            continue
        on, off = (base, config) if effect.on else (config, base)
        views = pilot_views(workspace, settings, plan if plan.on("depth-of-field") else other)
        compare = {"kind": "compare", "with_effect": on, "without_effect": off, "views": views, "spp": MEASURE_SPP}
        tasks[effect.name] = compare
    results = run_pilots(list(tasks.values()), choice, run, "measuring effects", workspace.log("effects"))
    measured = {}
    for name, result in zip(tasks, results, strict=True):
        measured[name] = {key: Measured.model_validate(result[key]) for key in ("cost", "error")}
        device = f"mitsuba {choice.variant}"
        run.book("evaluation", "scene", f"effect/{name}", result["seconds"], device=device)
    effects = tuple(effect.model_copy(update=measured.get(effect.name, {})) for effect in plan.effects)
    return plan.model_copy(update={"effects": effects})


def _toggled(run: Run, plan: EffectPlan, effect: Effect) -> EffectPlan | None:
    """The plan with one light effect the other way round; None where there is nothing to switch."""
    if effect.part == "neural" or not (effect.present or effect.name in FORCEABLE):
        return None
    chosen = run.settings.effects
    enable: list[EffectName] = [name for name in chosen.enable if name != effect.name]
    disable: list[EffectName] = [name for name in chosen.disable if name != effect.name]
    (disable if effect.on else enable).append(effect.name)
    return plan_of(run.workspace, run.settings, enable=enable, disable=disable, pilot=plan.pilot)


def table(plan: EffectPlan) -> str:
    """The plan as aligned lines: effect, on or off, evidence, cost, error."""
    depth = "not known before its pilot" if plan.max_depth is None else str(plan.max_depth)
    lines = [f"ray tracing: {plan.integrator}, path depth {depth}"]
    rows = [("effect", "", "cost", "error", "evidence")]
    for effect in plan.effects:
        state = ("on" if effect.on else "off") + (" (user)" if effect.by == "user" else "")
        evidence = effect.evidence[0] + (f" (+{len(effect.evidence) - 1})" if len(effect.evidence) > 1 else "")
        rows.append((effect.name, state, _percent(effect.cost), _percent(effect.error), evidence))
    a, b, c, d = (max(len(row[i]) for row in rows) for i in range(4))
    for name, state, cost, error, evidence in rows:
        lines.append(f"{name:<{a}}  {state:<{b}}  {cost:>{c}}  {error:>{d}}  {evidence}".rstrip())
    if all(effect.cost is None for effect in plan.effects):
        lines.append("cost and error are not measured yet: dnrpipe effects --measure")
    return "\n".join(lines)


def _percent(value: Measured | None) -> str:
    return "-" if value is None else f"{value.mean:.1%} ± {value.half_width:.1%}"

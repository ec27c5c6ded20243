"""The effect plan of a workspace: made from ``scene/``, kept in ``scene/effects.json``, followed by the tracer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from dnrtrain.atomic import write_json
from dnrtrain.contract import read_cameras

from ..core.cameras import scaled_to, spread, view_lenses
from ..core.effect_names import EffectName
from ..core.errors import UserError
from ..core.scene_files import read_census, read_json, read_summary, scene_fingerprint
from ..core.scene_records import Lens
from ..core.settings import Settings
from ..core.workspace import Workspace, digest
from ..raytrace.statistics import REFERENCE_DEPTH
from ..raytrace.variants import VariantChoice, choose_variant
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
    census = read_census(workspace.scene)
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
            fits = stored.pilot.fingerprint == pilot_fingerprint(workspace, settings, plan)
            pilot = stored.pilot if fits else None
        plan = plan if pilot is None else plan_effects(**arguments, pilot=pilot)
    return plan if stored is None else _with_measurements(plan, stored)


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


def lenses(workspace: Workspace, settings: Settings) -> dict[str, Lens]:
    """Lenses of the views that have depth of field, by view name."""
    return view_lenses(read_summary(workspace.scene), settings.cameras)


def pilot_views(workspace: Workspace, settings: Settings, plan: EffectPlan) -> list[dict[str, Any]]:
    """A few training views, spread over all, at pilot resolution: [{"view": JSON, "lens": dict | None}].

    Raises UserError where no views have been placed yet.
    """
    path = workspace.cameras("train")
    if not path.exists():
        raise UserError(f"{workspace.root}: no views yet; run `dnrpipe prepare` first")
    views = read_cameras(path)
    chosen = spread(views, PILOT_VIEWS)
    known = lenses(workspace, settings) if plan.on("depth-of-field") else {}
    return [
        {"view": scaled_to(view, PILOT_RESOLUTION).model_dump(mode="json"), "lens": known.get(view.name)}
        for view in chosen
    ]


def pilot_fingerprint(workspace: Workspace, settings: Settings, plan: EffectPlan) -> str:
    """Hash of all that the path depth pilot measures."""
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


def _stored(workspace: Workspace) -> EffectPlan | None:
    path = workspace.scene / FILE
    if not path.exists():
        return None
    try:
        return EffectPlan.model_validate(read_json(path))
    except ValidationError:  # of another version: the plan is made again
        return None


def _with_measurements(plan: EffectPlan, stored: EffectPlan) -> EffectPlan:
    """Columns measured before, where nothing that they depend on changed."""
    same = (plan.integrator, plan.max_depth, plan.left_out) == (stored.integrator, stored.max_depth, stored.left_out)
    known = {e.name: {"cost": e.cost, "error": e.error} for e in stored.effects}
    if not same:
        return plan
    rows = [e.model_copy(update=known.get(e.name, {})) for e in plan.effects]
    return plan.model_copy(update={"effects": tuple(rows)})

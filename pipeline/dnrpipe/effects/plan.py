"""Which light-transport effects a scene calls for: census and bundle in, an `EffectPlan` out.

Pure data in, pure data out: no Blender, no Mitsuba, no files. An effect is on where the scene has what makes it
and the converted bundle holds it; the evidence names the materials, lights and objects. Path depth is on top of
that a measurement (see `raytrace.statistics`), handed in as a `DepthPilot`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from pydantic import Field

from dnrtrain.settings import ModelSettings, Strict

from ..core.effect_names import FORCEABLE, NAMES, NEURAL, REMOVABLE, EffectName
from ..core.scene_records import Census
from ..raytrace.statistics import REFERENCE_DEPTH, DepthStep, Measured
from .evidence import WORDS, Evidence, gather

DIRECT_DEPTH = 2

Integrator = Literal["direct", "path", "path-without-caustics", "volpath"]


class DepthPilot(Strict):
    """Outcome of the path depth pilot. ``max_depth``: path vertices; 2 is direct light."""

    fingerprint: str
    max_depth: int = Field(ge=1)
    reference_depth: int
    tolerance: float
    pixel_tolerance: float
    views: int
    resolution: int
    spp: int
    seconds: float
    steps: tuple[DepthStep, ...]

    def beyond(self, depth: int) -> float:
        """Share of the light on paths of more vertices, by the least depth looked at that is as large; 0 where none is.

        Direct light and ``max_depth`` are looked at: beyond the latter is less than the tolerance.
        """
        return next((step.mean for step in self.steps if step.depth >= depth), 0.0)


class Effect(Strict):
    """One row of the plan.

    by: who decided: the scene, or the user (``--enable``, ``--disable``). present: whether there is anything to
    switch off. cost: seconds it adds, as a share of the frame without it. error: what leaving it out would change,
    as a share of the picture's display range (RMSE). Both None until measured.
    """

    name: EffectName
    title: str
    part: Literal["light", "neural"]
    on: bool
    by: Literal["scene", "user"]
    present: bool
    evidence: tuple[str, ...]
    cost: Measured | None = None
    error: Measured | None = None


class EffectPlan(Strict):
    """What the ray tracer and the trainer do for this scene. ``max_depth`` is None until the pilot has run."""

    effects: tuple[Effect, ...]
    integrator: Integrator
    max_depth: int | None
    depth_by: Literal["pilot", "settings", "scene"]
    pilot: DepthPilot | None = None

    def on(self, name: EffectName) -> bool:
        """Whether an effect is simulated."""
        return self.effect(name).on

    def effect(self, name: EffectName) -> Effect:
        return next(effect for effect in self.effects if effect.name == name)

    @property
    def left_out(self) -> tuple[EffectName, ...]:
        """Effects that the bundle holds and the user switched off: the bundle is edited before tracing."""
        return tuple(e.name for e in self.effects if e.name in REMOVABLE and e.present and not e.on)

    def model(self, settings: ModelSettings) -> ModelSettings:
        """The neural renderer's settings with what the plan leaves off taken away; nothing is ever added."""
        off = {effect.name for effect in self.effects if not effect.on}
        kept = [modality for modality in settings.modalities.split("+") if modality not in off]
        harmonics = settings.spherical_harmonics and self.on("view-dependence")
        return settings.model_copy(update={"modalities": "+".join(kept), "spherical_harmonics": harmonics})


def plan_effects(
    census: Census,
    bundle: Mapping[str, Sequence[str]],
    *,
    enable: Sequence[EffectName] = (),
    disable: Sequence[EffectName] = (),
    max_depth: int | Literal["auto"] = "auto",
    lenses: Sequence[str] = (),
    pilot: DepthPilot | None = None,
) -> EffectPlan:
    """Decide every effect.

    Args:
        bundle: what the Mitsuba scene holds, effect name -> ids (`bundle.bundle_facts`).
        enable, disable: the user's overrides; ``disable`` wins.
        max_depth: the user's path depth, or "auto": the pilot's.
        lenses: names of the cameras in use that have depth of field.
    """
    evidence = gather(census, bundle, lenses)
    depth, depth_by = _depth(evidence, enable, disable, max_depth, pilot)
    evidence["indirect"] = _indirect(evidence["indirect"], depth, depth_by, pilot)
    effects = []
    for name in NAMES:
        found, (title, nothing) = evidence[name], WORDS[name]
        on = found.called_for
        if name in disable and (found.present or not on):
            on = False
        elif name in enable and (found.present or name in FORCEABLE):
            on = True
        effects.append(
            Effect(
                name=name,
                title=title,
                part="neural" if name in NEURAL else "light",
                on=on,
                by="scene" if on == found.called_for else "user",
                present=found.present,
                evidence=found.words or (nothing,),
            )
        )
    plan = EffectPlan(effects=tuple(effects), integrator="path", max_depth=depth, depth_by=depth_by, pilot=pilot)
    return plan.model_copy(update={"integrator": _integrator(plan, bundle)})


def _depth(
    evidence: Mapping[EffectName, Evidence],
    enable: Sequence[EffectName],
    disable: Sequence[EffectName],
    setting: int | Literal["auto"],
    pilot: DepthPilot | None,
) -> tuple[int | None, Literal["pilot", "settings", "scene"]]:
    """(path depth, who says so); None: the pilot has to run first."""
    if "indirect" in disable:
        return DIRECT_DEPTH, "settings"
    if setting != "auto":
        return setting, "settings"
    if not evidence["indirect"].called_for and "indirect" not in enable:
        return DIRECT_DEPTH, "scene"
    if pilot is None:
        return None, "pilot"
    if "indirect" in enable and pilot.max_depth <= DIRECT_DEPTH:
        return REFERENCE_DEPTH, "settings"
    return pilot.max_depth, "pilot"


def _indirect(found: Evidence, depth: int | None, by: str, pilot: DepthPilot | None) -> Evidence:
    """Indirect light after the pilot: off where direct light is all there is, within the tolerance."""
    if not found.called_for or depth is None:
        return found
    if by == "settings":
        return Evidence(depth > DIRECT_DEPTH, True, (f"path depth {depth} by setting", *found.words))
    assert pilot is not None
    said = f"path depth {depth}: deeper paths hold {pilot.beyond(depth):.2%} of the light (pilot)"
    if depth > DIRECT_DEPTH:
        said += f"; direct light alone would miss {pilot.beyond(DIRECT_DEPTH):.1%}"
    return Evidence(depth > DIRECT_DEPTH, found.present, (said, *found.words))


def _integrator(plan: EffectPlan, bundle: Mapping[str, Sequence[str]]) -> Integrator:
    if plan.on("volumes"):
        return "volpath"
    shallow = plan.max_depth is not None and plan.max_depth <= DIRECT_DEPTH
    caustics = plan.effect("caustics")
    if caustics.present and not caustics.on and not shallow:
        return "path-without-caustics"
    # Mitsuba's `direct` stops at surfaces that let light straight through, where `path` goes on.
    passing = plan.on("alpha") or bool(bundle.get("null"))
    return "direct" if plan.max_depth == DIRECT_DEPTH and not passing else "path"

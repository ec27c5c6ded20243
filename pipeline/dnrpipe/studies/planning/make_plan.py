"""`dnrpipe plan` behind its options: pilot, prediction, choice; writes ``plan/plan.json``."""

from __future__ import annotations

import time
from typing import Any

from dnrtrain.selector.names import TRAINED_NAMES

from ...core.errors import UserError
from ...core.scene_files import split_views
from ...core.settings import Settings
from ...core.workspace import Workspace
from ...effects.store import plan_of
from ...stages.base_images import base_renderer
from ...stages.stage import Run
from ...stages.trainer import trained_pixels
from .choose import Predictor, best_within, budgets, cheapest_reaching
from .pilot import run_pilot
from .quality import Prior, Quality, load_prior, measured_gains, scene_gain, views_error, with_noise
from .records import Pilot, PilotFacts, Plan, Prediction, PriorFacts, Route, Wanted, read_plan, write_plan
from .routes import TRAINED, as_reported, break_even, routes
from .seconds import Costs, Work, noise_at


def make_plan(run: Run, wanted: Wanted, prior: Prior | None = None) -> Plan:
    """Run the pilot where it is missing, write ``plan/plan.json`` and return it. prior: by default the package's.

    Raises UserError: a budget that not even the smallest choice fits in, or a target that nothing reaches.
    """
    workspace, settings = run.workspace, run.settings
    pilot = run_pilot(run)
    prior = prior or load_prior()
    predictor = make_predictor(workspace, settings, pilot, prior)
    candidates = len(split_views(workspace)["train"])
    grid = list(predictor.grid(candidates))
    chosen = _choose(grid, wanted)
    views, epochs = min(settings.select.most, candidates), settings.finetune.step2.epochs
    default = predictor.choice(views, settings.raytrace.spp, epochs * -(-views // predictor.batch))
    asked: dict[str, Any] = {}
    if wanted.frames is not None:
        found, at = whether_to_train(predictor, grid, wanted, chosen)
        train = found[0].reaches and found[0].name == TRAINED
        asked = {"routes": found, "routes_psnr": at, "break_even": break_even(found), "train": train}
    plan = Plan(
        made=time.time(),
        wanted=wanted,
        pilot=PilotFacts(fingerprint=pilot.fingerprint, seconds=pilot.seconds, load=pilot.load),
        policy=policy_of(workspace, settings),
        base_psnr=with_noise(predictor.quality.base, predictor.quality.reference),
        gain=predictor.quality.gain.most,
        chosen=chosen,
        table=budgets(grid),
        prior=PriorFacts(source=prior.source, scenes=prior.scenes, sd=prior.sd),
        settings_default=predictor.predict(default),
        **asked,
    )
    if carried_out := _carried_out(workspace, plan):
        plan = plan.model_copy(update={"carried_out": carried_out})
    write_plan(workspace.root, plan)
    return plan


def make_predictor(workspace: Workspace, settings: Settings, pilot: Pilot, prior: Prior) -> Predictor:
    """Costs and quality of any choice in this workspace, by its pilot."""
    frames, training, trace = pilot.frames, pilot.training, settings.raytrace
    assert frames is not None and training is not None and pilot.trace is not None  # the pilot is complete
    plan = plan_of(workspace, settings)
    renderer = base_renderer(workspace, settings, plan)
    light = renderer.light
    due = None if light is None or renderer.light_is_baked else (light["size"], light["spp"])
    width, height = settings.cameras.width, settings.cameras.height
    splits = split_views(workspace)
    trains = policy_of(workspace, settings) in TRAINED_NAMES or settings.starts_coarse
    work = Work(
        pixels=width * height,
        trained=trained_pixels(settings, width, height),
        light=due,
        step1=settings.select.step1.epochs * len(splits["train"]) if trains else 0,
        tests=len(splits.get("test", [])),
        evaluation_spp=trace.evaluation_spp,
    )
    base, noise = frames.base.psnr, noise_at(pilot.trace, training.spp)
    networks = zip(training.steps, (point.psnr for point in frames.neural), strict=True)
    reference = noise_at(pilot.trace, trace.evaluation_spp, raw=not trace.evaluation_denoise)
    if trace.evaluation_denoise and not trace.denoise:  # the pilot denoised nothing, so it cannot tell
        reference = 0.0
    return Predictor(
        pilot=pilot,
        wall=Costs(pilot, work, "seconds"),
        processor=Costs(pilot, work, "cpu_seconds"),
        quality=Quality(
            prior=prior,
            base=base,
            gain=scene_gain(prior, measured_gains(prior, base, training.views, noise, networks)),
            judged=views_error(frames.deviation, frames.views, work.tests),
            reference=reference,
        ),
        batch=settings.finetune.step2.batch,
    )


def whether_to_train(
    predictor: Predictor,
    grid: list[Prediction],
    wanted: Wanted,
    chosen: Prediction | None,
) -> tuple[list[Route], float]:
    """(routes, the cheapest first; the PSNR they are compared at).

    That PSNR is what was wanted, else what the choice is expected to give, else the highest of the grid.
    """
    assert wanted.frames is not None and predictor.pilot.frames is not None
    best = max(grid, key=lambda p: p.psnr.expected)
    at = wanted.psnr or (chosen or best).psnr.expected
    neural = cheapest_reaching(grid, at)
    width, height = predictor.pilot.size
    scale = predictor.wall.work.pixels / (width * height)
    part = as_reported(predictor.pilot.frames, predictor.quality.reference)
    found = routes(part, neural, predictor.wall.light(), predictor.wall.untrained(), scale, at, wanted.frames)
    return found, at


def policy_of(workspace: Workspace, settings: Settings) -> str:
    """The policy that the plan counts on: the settings', or farthest points for a trained one that nobody named."""
    named = workspace.manifest.overrides.get("select", {}).get("policy")
    trained = settings.select.policy in TRAINED_NAMES
    return "farthest" if trained and named is None else settings.select.policy


def _choose(grid: list[Prediction], wanted: Wanted) -> Prediction | None:
    if wanted.seconds is not None:
        found = best_within(grid, wanted.seconds)
        if found is None:
            least = min(grid, key=lambda p: p.seconds.total.expected).seconds.total.expected
            raise UserError(
                f"--time: {wanted.seconds:.0f} s are not enough; the smallest choice is expected to take {least:.0f} s"
            )
        if wanted.psnr is not None and found.psnr.expected < wanted.psnr:
            raise UserError(
                f"--target-psnr {wanted.psnr:g}: within {wanted.seconds:.0f} s at most {found.psnr.expected:.1f} dB are"
                " expected; give more time or ask for less"
            )
        if wanted.psnr is None:
            return found
    if wanted.psnr is not None:
        found = cheapest_reaching(grid, wanted.psnr)
        if found is None and wanted.frames is None:
            top = max(p.psnr.expected for p in grid)
            raise UserError(
                f"--target-psnr {wanted.psnr:g}: the neural renderer is expected to end at {top:.1f} dB on this scene;"
                " `dnrpipe plan --frames N` says what path tracing would take"
            )
        return found
    return None


def _carried_out(workspace: Workspace, plan: Plan) -> Prediction | None:
    """What the plan in the file was carried out as, if it is the same plan: its training may have been interrupted."""
    try:
        before = read_plan(workspace.root)
    except UserError:  # truncated, or of another version
        return None

    def decisive(one: Plan) -> tuple[Any, ...]:
        return one.wanted, one.policy, one.pilot.fingerprint, one.chosen and one.chosen.choice

    return before.carried_out if before is not None and decisive(before) == decisive(plan) else None

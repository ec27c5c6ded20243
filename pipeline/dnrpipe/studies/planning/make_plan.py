"""`dnrpipe plan` behind its options: pilot, prediction, choice; ``plan/plan.json``."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dnrtrain.atomic import write_json
from dnrtrain.contract import DamagedFile
from dnrtrain.selector.names import TRAINED_NAMES

from ...core.console import Console
from ...core.errors import UserError
from ...core.scene_files import read_json, split_views
from ...core.settings import Settings
from ...core.workspace import Workspace
from ...effects.store import plan_of
from ...stages.base_images import base_renderer
from .choose import Predictor, best_within, budgets, cheapest_reaching
from .pilot import FOLDER, run_pilot
from .quality import Gain, Prior, load_prior, measured_gains, scene_gain, views_error, with_noise
from .records import Pilot, Prediction, Route
from .routes import as_reported, break_even, routes
from .seconds import Costs, Work, noise_at

SCHEMA = 1
BLIND_POLICY = "farthest"
RULE_SECONDS = 2.0
"""Wall seconds allowed for a choice of views that trains nothing."""


@dataclass(frozen=True)
class Wanted:
    """What was asked for; all None: a table of budgets. seconds: of work from here on. frames: to be rendered."""

    seconds: float | None = None
    psnr: float | None = None
    frames: int | None = None


def plan_path(workspace: Workspace) -> Path:
    """``plan/plan.json``."""
    return workspace.root / FOLDER / "plan.json"


def make_plan(
    workspace: Workspace, settings: Settings, console: Console, wanted: Wanted, prior: Prior | None = None
) -> dict[str, Any]:
    """Run the pilot where it is missing and write ``plan/plan.json`` -> its content. prior: by default the package's.

    Raises UserError: a budget that not even the smallest choice fits in, or a target that nothing reaches.
    """
    pilot = run_pilot(workspace, settings, console)
    prior = prior or load_prior()
    predictor = make_predictor(workspace, settings, pilot, prior)
    candidates = len(split_views(workspace)["train"])
    grid = list(predictor.grid(candidates))
    chosen = _choose(grid, wanted)
    record: dict[str, Any] = {
        "schema": SCHEMA,
        "made": time.time(),
        "wanted": {"seconds": wanted.seconds, "psnr": wanted.psnr, "frames": wanted.frames},
        "pilot": {"fingerprint": pilot.fingerprint, "seconds": pilot.seconds, "load": pilot.load},
        "policy": policy_of(workspace, settings),
        "base_psnr": with_noise(predictor.base, predictor.reference),
        "gain": predictor.gain.most,
        "chosen": chosen.model_dump(mode="json") if chosen else None,
        "table": [p.model_dump(mode="json") for p in budgets(grid)],
        "prior": {"source": prior.source, "scenes": prior.scenes, "sd": prior.sd},
        "settings_default": predictor.predict(_default(predictor, settings, candidates)).model_dump(mode="json"),
    }
    if wanted.frames is not None:
        found, at = whether_to_train(predictor, grid, settings, wanted, chosen)
        record |= {"routes": [r.model_dump(mode="json") for r in found], "routes_psnr": at}
        record |= {"break_even": break_even(found), "train": found[0].reaches and found[0].name == "neural renderer"}
    if carried_out := _carried_out(plan_path(workspace), record):
        record["carried_out"] = carried_out
    write_json(plan_path(workspace), record)
    return record


def make_predictor(workspace: Workspace, settings: Settings, pilot: Pilot, prior: Prior) -> Predictor:
    """Costs and quality of any choice in this workspace, by its pilot."""
    assert pilot.frames is not None and pilot.training is not None  # the pilot is complete
    plan = plan_of(workspace, settings)
    renderer = base_renderer(workspace, settings, plan)
    light = renderer.light
    due = None if light is None or renderer.light_is_baked else (light["size"], light["spp"])
    width, height = settings.cameras.width, settings.cameras.height
    patch = settings.finetune.step2.patch or max(width, height)
    frames, training = pilot.frames, pilot.training
    work = Work(
        pixels=width * height,
        trained=min(patch, width) * min(patch, height),
        light=due,
        policy_seconds=_policy_seconds(workspace, settings, training.seconds),
        tests=len(split_views(workspace).get("test", [])),
        evaluation_spp=settings.raytrace.evaluation_spp,
    )
    base = frames.base.psnr
    return Predictor(
        pilot=pilot,
        wall=Costs(pilot, work, "seconds"),
        processor=Costs(pilot, work, "cpu_seconds"),
        prior=prior,
        base=base,
        gain=_gain(pilot, prior),
        judged=views_error(frames.deviation, frames.views, work.tests),
        reference=_reference_noise(settings, pilot),
        batch=settings.finetune.step2.batch,
    )


def _gain(pilot: Pilot, prior: Prior) -> Gain:
    """What is known of the scene's gain after its pilot."""
    assert pilot.frames is not None and pilot.training is not None and pilot.trace is not None
    training, frames = pilot.training, pilot.frames
    noise = noise_at(pilot.trace, training.spp)
    networks = zip(training.steps, (point.psnr for point in frames.neural), strict=True)
    return scene_gain(prior, measured_gains(prior, frames.base.psnr, training.views, noise, networks))


def _reference_noise(settings: Settings, pilot: Pilot) -> float:
    """RMSE of the test views' references; 0 where the pilot cannot tell, for it denoised nothing."""
    assert pilot.trace is not None
    trace = settings.raytrace
    if trace.evaluation_denoise and not trace.denoise:
        return 0.0
    return noise_at(pilot.trace, trace.evaluation_spp, raw=not trace.evaluation_denoise)


def whether_to_train(
    predictor: Predictor, grid: list[Prediction], settings: Settings, wanted: Wanted, chosen: Prediction | None
) -> tuple[list[Route], float]:
    """(routes, the cheapest first; the PSNR they are compared at): what was wanted, else what the choice, else what
    the settings as they are, are expected to give."""
    assert wanted.frames is not None and predictor.pilot.frames is not None
    best = max(grid, key=lambda p: p.psnr.expected)
    at = wanted.psnr or (chosen or best).psnr.expected
    neural = cheapest_reaching(grid, at)
    width, height = predictor.pilot.size
    scale = predictor.wall.work.pixels / (width * height)
    part = as_reported(predictor.pilot.frames, predictor.reference)
    found = routes(part, neural, predictor.wall.light(), scale, at, wanted.frames)
    return found, at


def policy_of(workspace: Workspace, settings: Settings) -> str:
    """The policy that the plan counts on: the settings', or farthest points in place of a trained one that nobody
    asked for by name."""
    named = workspace.manifest.overrides.get("select", {}).get("policy")
    trained = settings.select.policy in TRAINED_NAMES
    return BLIND_POLICY if trained and named is None else settings.select.policy


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


def _carried_out(path: Path, record: dict[str, Any]) -> dict[str, Any] | None:
    """What the plan in the file was carried out as, if it is the same plan: its training may have been interrupted."""
    try:
        before = read_json(path)
        same = all(before[key] == record[key] for key in ("wanted", "policy"))
        same = same and before["pilot"]["fingerprint"] == record["pilot"]["fingerprint"]
        same = same and before["chosen"]["choice"] == record["chosen"]["choice"]
    except (UserError, DamagedFile, KeyError, TypeError):  # none, torn, of another version, or without a choice
        return None
    return before.get("carried_out") if same else None


def _default(predictor: Predictor, settings: Settings, candidates: int) -> Any:
    views = min(settings.select.budget, candidates)
    steps = settings.finetune.step2.epochs * -(-views // predictor.batch)
    return predictor.choice(views, settings.raytrace.spp, steps)


def _policy_seconds(workspace: Workspace, settings: Settings, step_seconds: float) -> float:
    """Of the selection. A trained policy's steps are taken to last as long as the pilot's."""
    trains = policy_of(workspace, settings) in TRAINED_NAMES or settings.finetune.step2.start == "coarse"
    if not trains:
        return RULE_SECONDS
    return settings.select.step1.epochs * len(split_views(workspace)["train"]) * step_seconds

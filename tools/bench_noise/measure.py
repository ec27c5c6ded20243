"""One workspace: views traced to targets as `raytrace-selected --noise` does, and measured against a reference.

Notation
    truth    sqrt(mean (f(M) - f(R))² - noise(R)²) / rms f(R): M the picture, R the reference, of other seeds and many
             more samples, whose own noise (estimated from its groups) is taken off; f: linear -> sRGB over white
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from dnrpipe.core.cameras import scaled_to, spread
from dnrpipe.core.errors import UserError
from dnrpipe.core.scene_files import read_json, split_views
from dnrpipe.core.workspace import Workspace
from dnrpipe.effects.store import plan_of, trace_config, variant_for
from dnrpipe.raytrace.grouped import GroupedSensor
from dnrpipe.raytrace.noise import GROUPS, group_noise
from dnrpipe.raytrace.pass_worker import Worker
from dnrpipe.raytrace.sample_schedule import Goal, Schedule, ViewProgress
from dnrpipe.raytrace.samples import read_samples
from dnrpipe.raytrace.statistics import display
from dnrpipe.stages.raytrace import view_seed
from dnrpipe.stages.session import resolve_settings
from dnrtrain.contract import View


@dataclass(frozen=True)
class Options:
    """targets: relative noise; spp: of the reference; most: spp of a run; seeds: runs a view and target."""

    targets: tuple[float, ...]
    resolution: int
    spp: int
    most: int
    views: int
    seeds: int


def environment(root: Path) -> dict[str, str]:
    """What must be in the environment before Mitsuba is imported."""
    workspace = Workspace.open(root)
    settings = resolve_settings(workspace, {}, None)
    return variant_for(plan_of(workspace, settings), settings).environment


def bench(root: Path, options: Options, tell: Callable[[str], None]) -> dict[str, Any]:
    """All runs of a workspace: {"scene", "integrator", "max_depth", "runs": [...]}.

    Raises UserError: not prepared, or the path depth of its plan is not known yet.
    """
    workspace = Workspace.open(root)
    settings = resolve_settings(workspace, {}, None)
    plan = plan_of(workspace, settings)
    if plan.max_depth is None:  # any depth of this scene's will do here: one found by another version, say
        stored = read_json(workspace.scene / "effects.json") if (workspace.scene / "effects.json").exists() else {}
        depth = stored.get("max_depth") or (stored.get("pilot") or {}).get("max_depth")
        if depth is None:
            raise UserError(f"{root}: no path depth yet; run `dnrpipe raytrace-selected` first")
        plan = plan.model_copy(update={"max_depth": depth})
    config = trace_config(workspace, plan, variant_for(plan, settings).variant)
    worker = Worker({"bundle": config["bundle"], "variant": config["variant"], "threads": 1})
    every = split_views(workspace)["test"]
    chosen = spread(every, options.views)
    runs: list[dict[str, Any]] = []
    for view in (scaled_to(view, options.resolution) for view in chosen):
        common = {
            "view": view.model_dump(mode="json"),
            "integrator": plan.integrator,
            "max_depth": plan.max_depth,
            "lens": None,
        }
        reference = _reference(worker, Path(config["bundle"]), common, view, options.spp)
        tell(f"{root.stem} view {view.name}: reference {options.spp} spp, noise {100 * reference.noise:.2f}%")
        for seed in range(options.seeds):
            for target in options.targets:
                run = _run(worker, common, view, target, options.most, view_seed(seed, "bench", view.name))
                truth = _truth(run.pop("picture"), reference)
                runs.append({"view": view.name, "seed": seed, "target": target, **run, "truth": truth})
                tell(
                    f"  {100 * target:g}%: {run['spp']} spp, estimated {100 * run['estimate']:.2f}"
                    f" ± {100 * run['error']:.2f}%, measured {100 * truth:.2f}%"
                )
    return {"scene": root.stem, "integrator": plan.integrator, "max_depth": plan.max_depth, "runs": runs}


@dataclass(frozen=True)
class _Reference:
    shown: np.ndarray
    noise: float
    rmse: float


def _reference(worker: Worker, bundle: Path, task: dict[str, Any], view: View, spp: int) -> _Reference:
    integrator, _ = worker.engine.integrator(bundle, task["integrator"], task["max_depth"])
    sensor = GroupedSensor(worker.engine, bundle, view, None)
    groups, _ = sensor.render(integrator, max(1, spp // GROUPS), view_seed(0, "reference", view.name), 0)
    groups = np.nan_to_num(groups, posinf=0.0, neginf=0.0)
    noise = group_noise(groups)
    return _Reference(display(groups.mean(axis=0)), noise.relative, noise.rmse)


def _run(worker: Worker, common: dict[str, Any], view: View, target: float, most: int, seed: int) -> dict[str, Any]:
    """One view to one target, from nothing."""
    cpu = time.process_time()
    schedule = Schedule(Goal(target, None, most), {view.name: ViewProgress()}, 1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "samples.npz"
        task = {**common, "seed": seed, "samples": str(path), "samples_fingerprint": "bench"}
        passes = 0
        while (step := schedule.next()) is not None and step.add:
            answer = cast(dict[str, Any], worker({**task, "add": step.add}))
            schedule.passed(view.name, add=step.add, **answer)
            passes += 1
        assert step is not None  # a view that is idle has a step: samples, or its end
        samples = read_samples(path, "bench", view.height, view.width)
    facts = samples.facts
    return {
        "picture": samples.mean,
        "spp": facts.spp,
        "passes": passes,
        "estimate": facts.noise,
        "error": facts.error,
        "ended_by": step.why,
        "cpu_seconds": time.process_time() - cpu,
    }


def _truth(picture: np.ndarray, reference: _Reference) -> float:
    square = float(np.mean((display(picture) - reference.shown) ** 2)) - reference.rmse**2
    return math.sqrt(max(square, 0.0)) / float(np.sqrt(np.mean(reference.shown**2)))

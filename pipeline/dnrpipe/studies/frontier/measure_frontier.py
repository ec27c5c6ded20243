"""`dnrpipe frontier` behind its options: the sweep, the baselines, and what it writes into ``frontier/``.

Every point is a row of an ablation, so that it shares its workers, coarse models and resuming. Views, references and
base images are traced once, into the workspace itself.

results.json  results.csv  frontier-<N>.png (one per number of frames)  report.md
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from dnrtrain.atomic import atomic_path, write_json, write_text

from ...core.errors import UserError
from ...core.presets import SIZES
from ...core.scene_files import scene_fingerprint, split_views
from ...core.settings import Settings
from ...core.workspace import Workspace, digest
from ...stages.stage import Run
from ...workers.view_tasks import worker_count
from ..ablation.ablate import Ablation
from ..ablation.rows import ROWS, Row
from ..cells.request import epochs_of
from ..cells.results import made_by
from ..cells.scenes import Scene, prepared, without_left_out
from ..cells.study import WorkerPool
from .frontier_plots import plot
from .frontier_report import markdown
from .point_costs import break_evens, pareto, point_of, settle_frames
from .records import (
    SCHEMA,
    BaselineFile,
    BaselinePoint,
    CyclesFramesTask,
    CyclesMeasureTask,
    FrontierResults,
    PathTracingTask,
)

BASELINE_VERSION, CYCLES_VERSION = 1, 2
BASELINE_WORKER = "dnrpipe.studies.frontier.baseline_worker"
CYCLES = "cycles"
OTHERS = ("random", "all", "paper")
"""Other ways to train, compared at the settings' own samples and epochs."""
SAMPLE_COUNTS = (1, 2, 4, 8, 16, 64)
COLUMNS: tuple[str, ...] = (
    "name", "kind", "seed", "views", "spp", "steps", "upfront", "frame_ms", "psnr", "ssim", "lpips_vgg", "flip",
    "rival_ms", "break_even",
)  # fmt: skip


@dataclass(frozen=True)
class Sweep:
    """budgets (views), samples per pixel, optimiser steps: every combination is trained. also: of OTHERS."""

    budgets: tuple[int, ...]
    samples: tuple[int, ...]
    steps: tuple[int, ...]
    also: tuple[str, ...] = OTHERS

    def rows(self, settings: Settings) -> list[Row]:
        """All points as rows; the base image alone last. Raises UserError: no paper row at these sizes."""
        batch = settings.finetune.step2.batch
        found = [
            self._row(f"{views} views, {spp} spp, {steps} steps", views, spp, epochs_of(steps, views, batch))
            for views in self.budgets
            for spp in self.samples
            for steps in self.steps
        ]
        spp, epochs = settings.raytrace.spp, settings.finetune.step2.epochs
        if "random" in self.also:
            found += [self._row(f"{views} random views", views, spp, epochs, "random") for views in self.budgets]
        if "all" in self.also:
            found.append(self._row("all candidates", None, spp, epochs))
        if "paper" in self.also:
            if settings.preset not in SIZES:
                raise UserError(f"the paper's row has sizes for the presets {', '.join(SIZES)}; leave it out of --also")
            found.append(replace(ROWS["paper"], budget=max(self.budgets)))
        if settings.model.base != "none":
            found.append(Row("base image alone", ROWS["base"].what, "dnr", network=False))
        return found

    @staticmethod
    def _row(name: str, views: int | None, spp: int, epochs: int, policy: str = "farthest") -> Row:
        """views: None trains on all candidates."""
        changes = {"finetune": {"step2": {"epochs": epochs}}, "select": {"policy": policy}}
        return Row(name, name, "dnr", changes, everything=views is None, budget=views, spp=spp)


@dataclass(kw_only=True)
class Frontier(Ablation):
    """An ablation of one scene: the workspace that is open."""

    workspace: Workspace

    def _open(self, source: Path) -> Scene:
        return prepared(source.stem, Run(self.workspace, self.base, self.console), "frontier")


def numbers(text: str | None, option: str, default: Sequence[int], most: int | None = None) -> tuple[int, ...]:
    """``"6,12,25"`` in rising order; the default where not given.

    Raises UserError: not positive whole numbers, or more than ``most``.
    """
    if text is None:
        return tuple(sorted({n if most is None else min(n, most) for n in default}))
    found = set()
    for part in text.split(","):
        if not part.strip().isdecimal() or int(part) < 1 or (most is not None and int(part) > most):
            limit = "" if most is None else f" from 1 to {most}"
            raise UserError(f"{option} {text}: expected whole numbers{limit}, e.g. {','.join(map(str, default))}")
        found.add(int(part))
    return tuple(sorted(found))


def run_frontier(
    run: Run,
    *,
    budgets: str | None,
    spp: str | None,
    iterations: str | None,
    frames: str | None,
    also: str,
    ladder: str | None,
    seeds: int,
    jobs: int,
) -> FrontierResults:
    """Measure what is due and write it -> the results. All but ``run`` are options of the command.

    Raises:
        UserError: unknown names, numbers that do not fit. TasksFailed: some cells failed; the others are written.
    """
    workspace, settings = run.workspace, run.settings
    if settings.raytrace.noise is not None or settings.raytrace.time is not None:
        raise UserError(
            "frontier compares numbers of samples, and views are to be traced to a noise level or a time here"
            " (raytrace.noise, raytrace.time); `dnrpipe raytrace-selected --spp N` goes back to samples"
        )
    candidates = len(split_views(workspace)["train"])
    counts = numbers(frames, "--frames", (200, 2000))
    others = () if also.strip() == "none" else tuple(filter(None, (part.strip() for part in also.split(","))))
    if unknown := set(others) - {*OTHERS, CYCLES}:
        raise UserError(f"--also {', '.join(sorted(unknown))}: choose of {', '.join((*OTHERS, CYCLES))}, or none")
    sweep = Sweep(
        budgets=numbers(budgets, "--budgets", (6, 12, settings.select.most), candidates),
        samples=numbers(spp, "--spp", (16, settings.raytrace.spp)),
        steps=numbers(iterations, "--iterations", (150, 600)),
        also=tuple(name for name in others if name != CYCLES),
    )
    samples = numbers(ladder, "--ladder", SAMPLE_COUNTS)
    rows = sweep.rows(settings)
    out = workspace.root / "frontier"
    name, base = workspace.root.name.removesuffix(".dnr"), settings.model_copy(deep=True)
    base.select.budget = max((row.budget or 1 for row in rows), default=1)
    swept = Frontier(
        sources=[Path(f"{name}.blend")],
        rows=rows,
        seeds=seeds,
        base=base,
        overrides={},
        seconds=None,
        out=out,
        jobs=jobs,
        console=run.console,
        workspace=workspace,
    )
    swept.run()
    (scene,) = swept.scenes
    cores = worker_count(0)
    worker_pool = replace(swept.worker_pool, threads=cores, workers=1)
    traced = _trace_baselines(swept, scene, samples, worker_pool)
    baselines = traced.baselines
    if CYCLES in others:
        baselines = [*baselines, *_cycles_baselines(swept, scene, samples, worker_pool)]
    points = [
        point
        for seed in range(seeds)
        for row in rows
        if (row.network or seed == 0) and (point := point_of(swept, scene, row, seed, traced.base_ms, cores))
    ]
    points = break_evens(settle_frames(points), baselines)
    results = FrontierResults(
        schema_version=SCHEMA,
        **made_by(),
        scene=name,
        preset=settings.preset,
        resolution=f"{settings.cameras.width}x{settings.cameras.height}",
        sweep=asdict(sweep),
        frames=list(counts),
        cores=cores,
        test_views=len(scene.test),
        evaluation_spp=settings.raytrace.evaluation_spp,
        threads=swept.threads,
        baseline_threads=traced.threads,
        points=points,
        baselines=baselines,
        pareto={str(count): pareto([*points, *baselines], count) for count in counts},
    )
    _write(results, out)
    return results


def _trace_baselines(swept: Ablation, scene: Scene, samples: tuple[int, ...], worker_pool: WorkerPool) -> BaselineFile:
    """Path tracing of the test views, rendered where it is not on disk."""
    settings = without_left_out(scene.workspace, swept.base)
    facts = [swept.references[scene.name], samples, settings.model.base, settings.base.model_dump()]
    fingerprint = digest([BASELINE_VERSION, *facts, worker_pool.threads, swept.perceptual])
    task = PathTracingTask(
        fingerprint=fingerprint,
        workspace=scene.workspace.root,
        settings=settings,
        samples=list(samples),
        output=swept.out / "rivals" / f"{fingerprint}.json",
        label="path tracing",
    )
    worker_pool.work("path tracing of the test views", BASELINE_WORKER, [task])
    found = BaselineFile.model_validate_json(task.output.read_bytes())
    if lost := sum(one.masked for one in found.baselines if not one.denoised):
        worker_pool.console.warn(f"repaired: {lost} pixels of the path-traced test views were not finite and are black")
    return found


def _cycles_baselines(
    swept: Ablation, scene: Scene, samples: tuple[int, ...], worker_pool: WorkerPool
) -> list[BaselinePoint]:
    """Cycles on the test views, rendered and measured where that is not on disk."""
    workspace, views = scene.workspace, list(scene.test.values())
    reference_spp, folder = swept.base.raytrace.evaluation_spp, swept.out / "rivals"
    facts = [scene_fingerprint(workspace), [v.model_dump() for v in views], samples, reference_spp]
    fingerprint = digest([CYCLES_VERSION, *facts, worker_pool.threads])
    pictures = folder / f"cycles-{fingerprint}"
    render = CyclesFramesTask(
        scene_dir=workspace.scene,
        views=tuple(views),
        samples=samples,
        reference_spp=reference_spp,
        folder=pictures,
        output=pictures / "frames.json",
        label="Cycles",
    )
    worker_pool.work("Cycles on the test views", "dnrpipe.blender.passes.cycles_frames", [render])
    measure = CyclesMeasureTask(
        workspace=workspace.root,
        views=[view.name for view in views],
        frames=render.output,
        folder=pictures,
        output=folder / f"{digest([fingerprint, swept.perceptual])}.json",
        label="Cycles",
    )
    worker_pool.work("measuring Cycles", BASELINE_WORKER, [measure])
    return BaselineFile.model_validate_json(measure.output.read_bytes()).baselines


def _write(results: FrontierResults, out: Path) -> None:
    data = results.data()
    write_json(out / "results.json", data)
    with atomic_path(out / "results.csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore", restval="")
        writer.writeheader()
        writer.writerows(data["points"])
        for baseline in results.baselines:
            tracer = "Cycles" if baseline.by_cycles else "path tracing"
            kind = f"{tracer} + denoiser" if baseline.denoised else tracer
            writer.writerow({**baseline.data(), "kind": kind, "frame_ms": baseline.ms, "upfront": baseline.upfront})
    for count in results.frames:
        plot(results, count, out / f"frontier-{count}.png")
    write_text(out / "report.md", markdown(results))

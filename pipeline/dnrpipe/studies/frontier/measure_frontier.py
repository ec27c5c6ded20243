"""`dnrpipe frontier` behind its options: the sweep, the rivals, and what it writes into ``frontier/``.

results.json  results.csv  frontier-<N>.png (one per number of frames)  report.md
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from dnrtrain.atomic import atomic_path, write_json, write_text

from ...core.errors import UserError
from ...core.scene_files import scene_fingerprint, split_views
from ...core.settings import Settings
from ...core.workspace import digest
from ...workers.view_tasks import worker_count
from ..cells.provenance import made_by, read_made
from ..cells.worker_pool import WorkerPool, check_amounts
from .cycles_worker import PREFIX
from .frontier_plots import plot
from .frontier_report import markdown
from .point_costs import break_evens, pareto, point_of, settle_frames
from .sweep import RIVALS, Frontier, Sweep, make_frontier

if TYPE_CHECKING:
    from pathlib import Path

    from ...stages.session import Session

SCHEMA, RIVAL_VERSION, CYCLES_VERSION = 1, 1, 1
CYCLES = "cycles"
LADDER = (1, 2, 4, 8, 16, 64)
COLUMNS = (
    "name", "kind", "seed", "views", "spp", "steps", "upfront", "frame_ms", "psnr", "ssim", "lpips_vgg", "flip",
    "rival_ms", "break_even",
)  # fmt: skip


def numbers(text: str | None, option: str, default: Sequence[int], most: int | None = None) -> tuple[int, ...]:
    """``"6,12,25"`` in rising order; the default where not given. Raises UserError: not positive whole numbers, or
    more than ``most``."""
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
    session: Session,
    *,
    budgets: str | None,
    spp: str | None,
    iterations: str | None,
    frames: str | None,
    also: str,
    ladder: str | None,
    seeds: int,
    jobs: int,
) -> dict[str, Any]:
    """Measure what is due and write it -> the results.

    Raises:
        UserError: unknown names, numbers that do not fit. TasksFailed: some cells failed; the others are written.
    """
    workspace, settings, console = session.workspace, session.settings, session.console
    check_amounts(None, seeds, jobs)
    candidates = len(split_views(workspace)["train"])
    counts = numbers(frames, "--frames", (200, 2000))
    also_names = _rivals(also)
    sweep = Sweep(
        budgets=numbers(budgets, "--budgets", (6, 12, settings.select.budget), candidates),
        samples=numbers(spp, "--spp", (16, settings.raytrace.spp)),
        steps=numbers(iterations, "--iterations", (150, 600)),
        also=tuple(name for name in also_names if name != CYCLES),
    )
    rungs = numbers(ladder, "--ladder", LADDER)
    rows = sweep.rows(settings)
    out = workspace.root / "frontier"
    run = make_frontier(workspace, settings, rows, out, jobs, seeds, console)
    run.check()
    run.run()
    cores = worker_count(0)
    rivals = _rival(run, settings, rungs, cores)
    if CYCLES in also_names:
        rivals["rungs"] += _cycles(run, settings, rungs, cores)
    points = [
        point
        for seed in range(seeds)
        for row in rows
        if (row.network or seed == 0) and (point := point_of(run, row, seed, rivals, cores))
    ]
    for point in points:
        point["name"] += f", seed {point['seed']}" if seeds > 1 and point["kind"] != "base" else ""
    settle_frames(points)
    break_evens(points, rivals["rungs"])
    results: dict[str, Any] = {
        "schema": SCHEMA,
        **made_by(),
        "scene": workspace.root.name.removesuffix(".dnr"),
        "preset": settings.preset,
        "resolution": f"{settings.cameras.width}x{settings.cameras.height}",
        "sweep": asdict(sweep),
        "frames": list(counts),
        "cores": cores,
        "test_views": len(run.scene.test),
        "evaluation_spp": settings.raytrace.evaluation_spp,
        "threads": run.threads,
        "rival_threads": rivals["threads"],
        "points": points,
        "rungs": rivals["rungs"],
    }
    results["pareto"] = {str(count): pareto(results, count) for count in counts}
    _write(results, out)
    return results


def read_frontier(path: Path) -> dict[str, Any]:
    """``frontier/results.json``. Raises UserError: missing, damaged or of another schema."""
    return read_made(path, "frontier", SCHEMA, "points")


def _rivals(text: str) -> tuple[str, ...]:
    names = tuple(filter(None, (part.strip() for part in text.split(","))))
    if text.strip() == "none":
        return ()
    if unknown := set(names) - {*RIVALS, CYCLES}:
        raise UserError(f"--also {', '.join(sorted(unknown))}: choose of {', '.join((*RIVALS, CYCLES))}, or none")
    return names


def _rival(run: Frontier, settings: Settings, samples: tuple[int, ...], cores: int) -> dict[str, Any]:
    """Path tracing of the test views, rendered where it is not on disk."""
    references = sorted(run.references[run.scene.name].values())
    base = settings.model_copy(update={"model": run._settings(run.request.rows[0], run.scene).model})
    key = digest([RIVAL_VERSION, references, samples, base.model.base, base.base.model_dump(), cores, run.perceptual])
    output = run.request.out / "rivals" / f"{key}.json"
    task = {
        "key": key,
        "workspace": str(run.scene.workspace.root),
        "settings": base.model_dump(mode="json"),
        "samples": list(samples),
        "output": str(output),
        "label": "path tracing",
    }
    worker_pool: WorkerPool = replace(run.worker_pool, threads=cores, workers=1)
    worker_pool.work("path tracing of the test views", "dnrpipe.studies.frontier.path_tracing_worker", [task])
    found = json.loads(output.read_text(encoding="utf-8"))
    if lost := sum(rung.get("masked", 0) for rung in found["rungs"] if not rung["denoised"]):
        worker_pool.console.warn(f"repaired: {lost} pixels of the path-traced test views were not finite and are black")
    return found


def _cycles(run: Frontier, settings: Settings, samples: tuple[int, ...], cores: int) -> list[dict[str, Any]]:
    """Rungs of Cycles on the test views, rendered where they are not on disk."""
    workspace, views = run.scene.workspace, split_views(run.scene.workspace)["test"]
    reference_spp = settings.raytrace.evaluation_spp
    key = digest(
        [CYCLES_VERSION, scene_fingerprint(workspace), [v.model_dump() for v in views], samples, reference_spp, cores]
    )
    folder = run.request.out / "rivals" / f"cycles-{key}"
    task = {
        "scene_dir": str(workspace.scene),
        "views": [view.model_dump(mode="json") for view in views],
        "samples": list(samples),
        "reference_spp": reference_spp,
        "folder": str(folder),
        "output": str(folder / "frames.json"),
        "label": "Cycles",
    }
    worker_pool: WorkerPool = replace(run.worker_pool, threads=cores, workers=1)
    worker_pool.work("Cycles on the test views", "dnrpipe.blender.passes.cycles_frames", [task])
    measured = digest([key, run.perceptual])
    output = run.request.out / "rivals" / f"{measured}.json"
    names = {"workspace": str(workspace.root), "views": [view.name for view in views], "label": "Cycles"}
    task = {**names, "frames": task["output"], "folder": str(folder), "output": str(output)}
    worker_pool.work("measuring Cycles", "dnrpipe.studies.frontier.cycles_worker", [task])
    return json.loads(output.read_text(encoding="utf-8"))["rungs"]


def _write(results: dict[str, Any], out: Path) -> None:
    write_json(out / "results.json", results)
    with atomic_path(out / "results.csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore", restval="")
        writer.writeheader()
        for one in results["points"]:
            writer.writerow(one)
        for rung in results["rungs"]:
            tracer = "Cycles" if rung["name"].startswith(PREFIX) else "path tracing"
            kind = f"{tracer} + denoiser" if rung["denoised"] else tracer
            writer.writerow({**rung, "kind": kind, "frame_ms": rung["ms"], "upfront": 0.0})
    for count in results["frames"]:
        plot(results, count, out / f"frontier-{count}.png")
    write_text(out / "report.md", markdown(results))

"""`dnrpipe bench-select` behind its options: settings, the run, and what it writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dnrtrain.atomic import write_json, write_text

from ...core.console import Console
from ...core.errors import UserError
from ...core.settings import merge, resolve
from ...core.workspace import locked
from ..cells.measure import METRICS, mean_of
from ..cells.request import merged
from ..cells.scenes import find_scenes
from ..cells.tasks import read_cell
from ..cells.worker_pool import make_pool
from .bench import Bench, Place, PlannedCell, Request, read_choice
from .bench_plots import plot
from .bench_tables import SCHEMA, markdown
from .policies import choose_policies
from .pools import Pool, choose_pools

SMOKE: dict[str, Any] = {
    "cameras": {"train": 10, "test": 2, "width": 32, "height": 32},
    "passes": {"raster": "cycles-direct", "coverage_samples": 16},
    "raytrace": {"spp": 16, "evaluation_spp": 32, "max_depth": 3},
    "model": {"base": "none", "chain": False, "filter": 0, "output": "display", "guides": False},
    "select": {"step1": {"epochs": 2}},
    "finetune": {"step2": {"epochs": 4}},
}
SMOKE_SCENE = "emissive_only"
SMOKE_REQUEST = {"pools": "dome,path", "budgets": "2,4", "policies": "random,farthest,kmedoids"}
CORE = {"pools": "all", "budgets": "10,25", "policies": "core"}
CANDIDATES = 100


def run_bench(
    *,
    scenes: str | None,
    pools: str | None,
    budgets: str | None,
    policies: str | None,
    seeds: int,
    views: int | None,
    preset: str,
    seconds: float | None,
    jobs: int,
    assignments: Sequence[str],
    out: Path,
    smoke: bool,
    console: Console,
) -> dict[str, Any]:
    """Run what is due and write results.json, report.md, views.png and seconds.png into ``out`` -> the results.

    Settings come from the preset and these arguments alone, neither from the environment nor from
    dnrpipe.toml: the command that is kept in the results says all.

    Raises:
        UserError: unknown names, settings that do not fit. TasksFailed: some cells failed; the others are written.
    """
    # Step 2 trains all cells; validation views would cost passes and decide nothing.
    cameras = {"train": CANDIDATES, "val": 0}
    given = {} if views is None else {"cameras": {"train": views}}
    overrides = merged([{"cameras": cameras}, SMOKE if smoke else {}, given], assignments)
    count = resolve(preset, overrides, environment={}).cameras.train
    defaults = SMOKE_REQUEST if smoke else CORE
    wanted = choose_budgets(budgets or defaults["budgets"], count)
    base = resolve(preset, merge(overrides, {"select": {"budget": max(wanted)}}), environment={})
    if base.cameras.source != "auto":
        raise UserError(f"cameras.source={base.cameras.source}: the pools decide where cameras stand; use --pools")
    request = Request(
        scenes=find_scenes(scenes or (SMOKE_SCENE if smoke else None)),
        pools=choose_pools(pools or defaults["pools"]),
        budgets=wanted,
        policies=choose_policies(policies or defaults["policies"]),
        seeds=seeds,
        base=base,
        seconds=seconds,
        out=out,
        jobs=jobs,
    )
    bench = Bench(request, console, make_pool(base, jobs, out / "logs" / "cells.log", console, single=True))
    with locked(out, "bench-select"):
        try:
            for _ in bench.run():
                _write(bench)
        finally:
            results = _write(bench)
    return results


def choose_budgets(text: str, candidates: int) -> list[int]:
    """``"10,25"``, or ``"full"``: 5 to 30 by 5, then by 10 up to all candidates.

    Raises UserError: not a number, or not between 1 and the number of candidates.
    """
    found: set[int] = set()
    for part in filter(None, (part.strip() for part in text.split(","))):
        if part == "full":
            found |= {n for n in [*range(5, 31, 5), *range(40, candidates, 10), candidates] if n <= candidates}
        elif not part.isdecimal() or not 1 <= int(part) <= candidates:
            raise UserError(f"--budgets {part}: name numbers of views from 1 to {candidates} (--views), or full")
        else:
            found.add(int(part))
    if not found:
        raise UserError("--budgets: names none; for example 10,25")
    return sorted(found)


def _gather(bench: Bench) -> dict[str, Any]:
    """Everything that tables and plots need; cells whose file is missing are left out."""
    pools = {(pool.scene, pool.name): pool for pool in bench.pools}
    request = bench.request
    return {
        **request.facts(SCHEMA),
        "candidates": request.base.cameras.train,
        "pools": request.pools,
        "budgets": request.budgets,
        "device": bench.worker_pool.device,
        "threads": bench.worker_pool.threads,
        "policies": {contender.name: contender.what for contender in request.policies},
        "cells": [
            _line(bench, pools[place.scene, place.pool], place, cell)
            for place, cell in bench.cells.items()
            if cell.task.output.exists()
        ],
    }


def _line(bench: Bench, pool: Pool, place: Place, planned: PlannedCell) -> dict[str, Any]:
    """One cell: metrics as means over the test views, and the seconds of each part.

    select_seconds: choosing, step 1 included where it chooses; view_seconds: tracing the views and their base images;
    train_seconds: step 2, and step 1 where it only gives the start; total_seconds: all of them.
    """
    cell, choice = read_cell(planned.task.output), read_choice(planned.choice)
    training, clock = cell.training, bench.clock
    assert training is not None  # every cell has a network
    step1 = training.step1
    chooses = step1 is not None and step1.key == choice.key
    train = getattr(training.step2, clock) + (getattr(step1, clock) if step1 and not chooses else 0.0)
    seconds = {
        "select_seconds": getattr(choice, clock),
        "view_seconds": bench.view_seconds(pool, cell.views),
        "train_seconds": train,
    }
    return {
        **asdict(place),
        "key": cell.key,
        **{name: mean_of(cell.tests, name) for name in METRICS},
        "views": choice.views,
        **{name: round(value, 3) for name, value in seconds.items()},
        "total_seconds": round(sum(seconds.values()), 3),
        "select_peak_mb": choice.peak_mb and round(choice.peak_mb),
        "epochs": training.epochs,
        "steps": training.step2.steps,
        "commit": cell.code["commit"],
    }


def _write(bench: Bench) -> dict[str, Any]:
    """Results, report and curves of the cells that are there."""
    out, results = bench.request.out, _gather(bench)
    if results["cells"]:
        write_json(out / "results.json", results)
        write_text(out / "report.md", markdown(results))
        plot(results, out / "views.png", "views")
        plot(results, out / "seconds.png", "total_seconds")
    return results

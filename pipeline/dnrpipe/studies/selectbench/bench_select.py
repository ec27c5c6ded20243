"""`dnrpipe bench-select` behind its options: settings, the run, and what it writes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dnrtrain.atomic import write_json, write_text

from ...core.console import Console
from ...core.errors import UserError
from ...core.settings import merge, parse_assignment, resolve
from ...core.workspace import locked
from ..cells.scenes import find_scenes
from ..cells.worker_pool import check_amounts, make_pool
from .bench import Bench, Request
from .bench_plots import plot
from .bench_results import gather
from .bench_tables import markdown
from .policies import choose_policies
from .pools import choose_pools

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
    overrides: dict[str, Any] = merge({"cameras": {"train": CANDIDATES, "val": 0}}, SMOKE if smoke else {})
    if views is not None:
        overrides = merge(overrides, {"cameras": {"train": views}})
    for text in assignments:
        overrides = merge(overrides, parse_assignment(text))
    count = resolve(preset, overrides, environment={}).cameras.train
    defaults = SMOKE_REQUEST if smoke else CORE
    wanted = choose_budgets(budgets or defaults["budgets"], count)
    base = resolve(preset, merge(overrides, {"select": {"budget": max(wanted)}}), environment={})
    check_amounts(seconds, seeds, jobs)
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
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out}: is a file; name a folder")
    facts = {
        "preset": base.preset,
        "resolution": f"{base.cameras.width}x{base.cameras.height}",
        "candidates": base.cameras.train,
        "seconds": seconds,
        "seeds": seeds,
        "scenes": [path.stem for path in request.scenes],
        "pools": request.pools,
        "budgets": request.budgets,
        "spp": {"training": base.raytrace.spp, "test": base.raytrace.evaluation_spp},
    }
    bench = Bench(request, console, make_pool(base, jobs, out / "logs" / "cells.log", console, single=True))
    with locked(out, "bench-select"):
        try:
            for _ in bench.run():
                _write(bench, facts)
        finally:
            results = _write(bench, facts)
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


def _write(bench: Bench, facts: dict[str, Any]) -> dict[str, Any]:
    """Results, report and curves of the cells that are there."""
    out = bench.request.out
    results = gather(bench, {**facts, "device": bench.worker_pool.device, "threads": bench.worker_pool.threads})
    if results["cells"]:
        write_json(out / "results.json", results)
        write_text(out / "report.md", markdown(results))
        plot(results, out / "views.png", "views")
        plot(results, out / "seconds.png", "total_seconds")
    return results

"""The Markdown report of a benchmark: ``python -m dnrpipe.studies.selectbench.bench_tables results.json``.

With several files, runs on other scenes with the same pools, one table of all of them.
"""

from __future__ import annotations

import functools
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..cells.intervals import LEVEL, Difference, difference
from ..cells.results import NONE, made_line, read_made, spread, table
from .figures import SPHERICAL, Figures
from .pools import POOLS
from .views_table import by_views

SCHEMA = 1
read_results = functools.partial(read_made, command="bench-select", schema=SCHEMA, part="pools")
METRICS = (("psnr", "PSNR", 2), ("psnr_mask", "PSNR in mask", 2), ("ssim", "SSIM", 4), ("lpips_vgg", "LPIPS VGG", 4))
TIMES = (("select_seconds", "selection, s", 2), ("total_seconds", "total, s", 0))


def markdown(results: Mapping[str, Any], *, pictures: bool = True) -> str:
    """All tables that the results can fill. pictures: refer to the curves beside the report."""
    figures = Figures(results)
    parts = ["# View selection, measured", _provenance(results, figures)]
    if pictures:
        parts.append("![Quality by number of views](views.png)\n\n![Quality by total seconds](seconds.png)")
    parts.append(_how(figures))
    parts += [_overall(figures, budget) for budget in figures.budgets]
    for pool in figures.pools:
        parts += [f"## Pool `{pool}`: {POOLS[pool]}", by_views(figures, pool)]
        for budget in figures.budgets:
            parts += [_pool(figures, pool, budget), _per_scene(figures, pool, budget)]
    return "\n\n".join(part for part in parts if part) + "\n"


def together(runs: Sequence[Mapping[str, Any]]) -> str:
    """Differences over the scenes of several runs: the policies that all have. A cell in two runs counts once.

    Differences are paired within a scene, so runs may differ in machine, number of candidates and samples.
    """
    shared = set.intersection(*({cell["policy"] for cell in run["cells"]} for run in runs))
    names = ("scene", "pool", "budget", "policy", "seed")
    cells = {
        tuple(cell[name] for name in names): cell for run in runs for cell in run["cells"] if cell["policy"] in shared
    }
    scenes = list(dict.fromkeys(scene for run in runs for scene in run["scenes"]))
    figures = Figures({"cells": list(cells.values()), "scenes": scenes})
    parts = [f"# {len(runs)} runs together", _how(figures)]
    for budget in figures.budgets:
        parts.append(_overall(figures, budget))
        parts += [_per_scene(figures, pool, budget) for pool in figures.pools]
    return "\n\n".join(part for part in parts if part) + "\n"


def _provenance(results: Mapping[str, Any], figures: Figures) -> str:
    time = "the preset's epochs"
    if results["seconds"]:
        time = f"about {results['seconds']:g} s of training for every cell"
    elif results.get("step2_steps"):
        time = f"{results['step2_steps']} steps of step 2 for every cell"
    mixed = ""
    if len(figures.devices) > 1:
        named = [f"{', '.join(scenes)} on {device}" for device, scenes in figures.devices.items()]
        mixed = f" Trained: {'; '.join(named)}; seconds are the CPU's."
    return (
        f"{made_line(results)}, {results['candidates']}"
        f" candidates a pool, {len(figures.scenes)} scene(s) ({', '.join(figures.scenes)}), {len(figures.seeds)}"
        f" seed(s), {time}, {len(results['cells'])} cells.{mixed}"
    )


def _how(figures: Figures) -> str:
    unit = "scenes" if len(figures.scenes) > 1 else "seeds of the one scene"
    return (
        "± is the standard deviation, over seeds, of the mean over scenes. Δ is the mean of paired differences in PSNR,"
        f" dB: same scene, candidates, budget and seed. In brackets the {LEVEL:.0%} interval of Student's t over {unit}"
        " (a scene's value is its mean over seeds); bold where it leaves out 0. The best simple rule is the best of"
        " these very figures among `farthest`, `kmedoids` and `coverage`, so that it is flattered, if anything. Total"
        " is selection, ray tracing of the chosen views with their base images, and training: processor seconds of one"
        " core where the model trains on a CPU."
    )


def _worst(found: Difference | None) -> str:
    if found is None:
        return NONE
    scene = min(found.scenes, key=found.scenes.__getitem__)
    return f"{found.scenes[scene]:+.2f} ({scene})"


def _overall(figures: Figures, budget: int) -> str:
    """Over all pools at one budget, each pool with its own best simple rule."""
    if len(figures.pools) < 2:
        return ""
    others = [pool for pool in figures.pools if pool not in SPHERICAL]
    rows = []
    for policy in figures.policies:
        found = [figures.against(policy, kind, figures.pools, budget) for kind in ("random", "simple")]
        line = [f"`{policy}`", *[difference(one) for one in found], _worst(found[1])]
        if 0 < len(others) < len(figures.pools):
            line.append(difference(figures.against(policy, "simple", others, budget)))
        rows.append(line)
    head = ["policy", "Δ to `random`", "Δ to each pool's best simple rule", "worst scene"]
    if 0 < len(others) < len(figures.pools):
        head.append(f"Δ to the best simple rule, {' and '.join(f'`{pool}`' for pool in others)} only")
    return f"## {budget} views, mean over {len(figures.pools)} pools\n\n{table(head, rows)}"


def _pool(figures: Figures, pool: str, budget: int) -> str:
    present = [policy for policy in figures.policies if (pool, budget, policy) in figures.cells]
    if not present:
        return ""
    best = figures.best_simple(pool, budget)
    rows = []
    for policy in present:
        line = [f"`{policy}`"]
        line += [spread(figures.means(pool, budget, policy, metric), digits) for metric, _, digits in METRICS]
        line.append(difference(figures.against(policy, "random", [pool], budget)))
        found = figures.against(policy, "simple", [pool], budget)
        line += ["the best rule", ""] if policy == best else [difference(found), _worst(found)]
        for metric, _, digits in TIMES:
            means = figures.means(pool, budget, policy, metric)
            line.append(f"{statistics.fmean(means):.{digits}f}" if means else NONE)
        rows.append(line)
    head = ["policy", *[title for _, title, _ in METRICS], "Δ to `random`"]
    head += [f"Δ to `{best}`" if best else "Δ to a simple rule", "worst scene", *[title for _, title, _ in TIMES]]
    return f"### `{pool}`, {budget} views\n\n{table(head, rows)}"


def _per_scene(figures: Figures, pool: str, budget: int) -> str:
    present = [policy for policy in figures.policies if (pool, budget, policy) in figures.cells]
    if not present or len(figures.scenes) < 2:
        return ""
    rows = []
    for scene in figures.scenes:
        found = [figures.values(pool, budget, policy, "psnr") for policy in present]
        ours = [[value for place, value in values.items() if place[0] == scene] for values in found]
        if any(ours):
            rows.append([scene, *[spread(values, 2) for values in ours]])
    return f"PSNR by scene, `{pool}`, {budget} views:\n\n{table(['scene', *[f'`{p}`' for p in present]], rows)}"


if __name__ == "__main__":
    files = [read_results(Path(argument)) for argument in sys.argv[1:]]
    print(together(files) if len(files) > 1 else markdown(files[0], pictures=False), end="")

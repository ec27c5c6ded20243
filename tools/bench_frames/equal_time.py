"""What a workspace cost before its first frame, and what that means for N frames.

    total(N) = upfront + N * frame
    N*       = upfront / (frame of path tracing at our PSNR - our frame)

Processor seconds of the ledger (`upfront_work`), which other work on the machine does not stretch. Passes, tracing,
baked light and base images are divided by the threads, which they keep busy; training is not, as its steps keep hardly
more than one thread busy. All epochs do the same work, and other work on the machine only adds to them, so each counts
as much as the least disturbed quarter. The conversion of the scene, which both sides need, is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from dnrpipe.core.ledger import CostRecord, UpfrontPart, break_even_frames, total, upfront_work
from dnrpipe.studies.frames.ours import BASE, NEURAL, SMOOTH, is_own
from dnrpipe.studies.frames.pareto_front import Point, crossover, frontier, quality_at

COUNTS = (200, 2000)
"""Numbers of frames that the tables speak of."""
Figure = Literal["psnr", "lpips_alex"]
BETTER: dict[Figure, int] = {"psnr": 1, "lpips_alex": -1}
SHOWN: dict[Figure, str] = {"psnr": "PSNR", "lpips_alex": "LPIPS"}
TRACING: tuple[UpfrontPart, ...] = ("selection", "tracing", "light", "base images")
"""What the tables call tracing."""


def upfront(records: Sequence[CostRecord], threads: int) -> dict[str, float]:
    """Seconds by kind of work, ``total`` among them; each unit at its last cost."""
    work = upfront_work(records)
    views = [record for part in TRACING for record in work[part]]
    epochs = [record.cpu_seconds for record in work["training"]]
    found = {
        "passes": total(work["passes"]).cpu_seconds / threads,
        "tracing": total(views).cpu_seconds / threads,
        "training": len(epochs) * float(np.quantile(epochs, 0.25)) if epochs else 0.0,
    }
    return {**found, "total": sum(found.values())}


def at_equal_time(scene: Mapping[str, Any], frames: int) -> dict[str, Any]:
    """The best of our numbers of rays for so many frames.

    Its name, dB, ms per frame all told, and as ``rival`` the dB of path tracing in that time.
    """
    line = _line(scene)
    found = []
    for name in scene["standing"]:
        row = scene["rows"][name]
        ms = row["ms"] + 1000 * scene["upfront"]["total"] / frames
        traced = quality_at(line, ms)
        traced = line[0][1] if traced is None else traced
        found.append({"name": name, "psnr": row["psnr"], "ms": ms, "rival": traced})
    return max(found, key=lambda one: one["psnr"] - one["rival"])


def break_even(scene: Mapping[str, Any], figure: Figure = "psnr") -> tuple[str, int, bool] | None:
    """From how many frames on ours is cheaper than path tracing at an equal figure; None: never.

    (our number of rays, frames, whether path tracing ends below us, so that it is that many at most): the fewest frames
    of all numbers of rays.
    """
    rows, line = scene["rows"], _line(scene, figure)
    found = []
    for name in scene["standing"] if line else ():
        level = crossover(line, BETTER[figure] * rows[name][figure])
        traced = line[-1][0] if level is None else level
        frames = break_even_frames(scene["upfront"]["total"], traced / 1000, rows[name]["ms"] / 1000)
        if frames is not None:
            found.append((name, frames, level is None))
    return min(found, key=lambda one: one[1]) if found else None


def lines(scenes: Sequence[Mapping[str, Any]]) -> list[str]:
    """The table of all scenes whose ledger was read; empty where there is none."""
    known = [scene for scene in scenes if "upfront" in scene]
    if not known:
        return []
    heads = [f"{count} frames: ours, rival, lead | a frame, ms" for count in COUNTS]
    figures: list[Figure] = ["psnr"]
    if all("lpips_alex" in row for scene in known for row in scene["rows"].values()):
        figures.append("lpips_alex")
    ends = [f"cheaper at equal {SHOWN[figure]} from" for figure in figures]
    table = [
        f"| scene | before the first frame, s | of which training | {' | '.join([*heads, *ends])} |",
        "|---|---|---|" + "---|---|" * len(COUNTS) + "---|" * len(ends),
    ]
    for scene in known:
        cells = [scene["scene"], f"{scene['upfront']['total']:.0f}", f"{scene['upfront']['training']:.0f}"]
        for count in COUNTS:
            one = at_equal_time(scene, count)
            lead = one["psnr"] - one["rival"]
            cells += [f"{one['psnr']:.1f}, {one['rival']:.1f}, {lead:+.1f} dB ({short(one['name'])})"]
            cells += [f"{one['ms']:.0f}"]
        cells += [_told(break_even(scene, figure)) for figure in figures]
        table.append(f"| {' | '.join(cells)} |")
    return table


def _told(even: tuple[str, int, bool] | None) -> str:
    if even is None:
        return "never"
    name, frames, bound = even
    return f"{'at most ' if bound else ''}{frames} frames ({short(name)})"


def _line(scene: Mapping[str, Any], figure: Figure = "psnr") -> list[Point]:
    """The baselines that nothing beats: (ms, figure, the larger the better), cheapest first."""
    points = {
        name: (row["ms"], BETTER[figure] * row[figure])
        for name, row in scene["rows"].items()
        if figure in row and not is_own(name)
    }
    return [points[name] for name in frontier(points)]


def short(name: str) -> str:
    """What a cell of a table has room for: "3 rays" of our frames, "base, 3 rays" where nothing is neural, "smoothed, 3
    rays" where that took the denoiser's place."""
    return name.replace(f"{BASE}, ", "base, ").replace(f"{SMOOTH}, ", "base, smoothed, ").removeprefix(f"{NEURAL}, ")

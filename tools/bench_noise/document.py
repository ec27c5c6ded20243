"""Results of the noise benchmark as Markdown tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from dnrpipe.raytrace.sample_schedule import FIRST

WITHIN = 0.15


def markdown(record: dict[str, Any]) -> str:
    """A row per scene and target, and what share of the runs hit it."""
    lines = [
        f"Views of {record['resolution']}² pixels, {record['views']} per scene, {record['seeds']} runs each of other"
        f" seeds; at most {record['most']} spp; reference {record['spp']} spp, its own noise taken off.",
        "",
        "| scene | target | spp | estimated | measured | estimated / measured | measured / target | ended by |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for scene in record["scenes"]:
        for target in sorted({run["target"] for run in scene["runs"]}, reverse=True):
            lines.append(_row(scene["scene"], target, [run for run in scene["runs"] if run["target"] == target]))
    runs = [run for scene in record["scenes"] for run in scene["runs"]]
    return "\n".join([*lines, "", *_sums(runs)])


def _row(name: str, target: float, runs: Sequence[dict[str, Any]]) -> str:
    estimated, measured = (_rms([run[key] for run in runs]) for key in ("estimate", "truth"))
    hits = [run["truth"] / target for run in runs]
    ends = ", ".join(sorted({_end(run) for run in runs}))
    cells = [
        name,
        _percent(target),
        _span([run["spp"] for run in runs], "d"),
        f"{100 * estimated:.2f}%",
        f"{100 * measured:.2f}%",
        f"{estimated / measured if measured else math.nan:.2f}",
        _span(hits, ".2f"),
        ends,
    ]
    return f"| {' | '.join(cells)} |"


def _sums(runs: Sequence[dict[str, Any]]) -> list[str]:
    """What share of runs hit the target: of those that ended by it, and had more than the first pass to do."""
    lines = []
    for target in sorted({run["target"] for run in runs}, reverse=True):
        these = [run for run in runs if run["target"] == target]
        tried = [run for run in these if _end(run) == "target"]
        hits = [abs(run["truth"] / target - 1) <= WITHIN for run in tried]
        below = [run["truth"] <= (1 + WITHIN) * target for run in tried]
        mean = _rms([run["truth"] / target for run in tried]) if tried else math.nan
        lines.append(
            f"Target {_percent(target)}: {len(tried)} of {len(these)} runs came to an end by it, after more than the"
            f" first pass; of these {sum(hits)} are within {100 * WITHIN:.0f}% of it, {sum(below)} within or below;"
            f" measured / target {mean:.2f} (root mean square)."
        )
    return ["\n\n".join(lines)] if lines else []


def _end(run: dict[str, Any]) -> str:
    return "first pass" if run["ended_by"] == "target" and run["spp"] <= FIRST else run["ended_by"]


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(math.fsum(value**2 for value in values) / len(values))


def _percent(value: float) -> str:
    return f"{100 * value:g}%"


def _span(values: Sequence[float], form: str) -> str:
    low, high = format(min(values), form), format(max(values), form)
    return low if low == high else f"{low} to {high}"

"""Cost and benefit in the report: what it cost, what it bought, what the next minute would buy.

Reads `plan/plan.json` (`dnrpipe plan`) and `frontier/results.json` (`dnrpipe frontier`) where they exist.
"""

from __future__ import annotations

import base64
import re
from pathlib import Path

from ..core.errors import UserError
from ..core.units import duration
from ..studies.frames.pareto_front import quality_at
from ..studies.planning.plan_text import route_lines, why
from ..studies.planning.records import RENDERER_STAGES, Plan, read_plan
from .data import Budget, PlannedRow, Quality

NEXT = 60.0
"""Seconds of further work that the report weighs."""


def build_budget(root: Path, quality: Quality | None, upfront: float | None) -> Budget | None:
    """The part's sentences; None while nothing was spent and nothing is planned."""
    try:
        plan = read_plan(root)
    except UserError:  # damaged, which its own command reports
        plan = None
    frontier = _frontier_pictures(root)
    if upfront is None and plan is None and frontier is None:
        return None
    psnr = next((row.mean for row in quality.rows if row.key == "psnr"), None) if quality else None
    return Budget(
        cost=_cost(upfront, plan),
        bought=_bought(psnr, plan, quality),
        following=_following(plan),
        rows=_rows(plan) if plan else [],
        why=why(plan) if plan else [],
        routes=[re.sub(r" {2,}", " · ", line.strip()) for line in route_lines(plan)] if plan else [],  # no columns here
        pictures=frontier or [],
    )


def _cost(upfront: float | None, plan: Plan | None) -> str:
    if upfront is None:
        return "Nothing was spent yet."
    text = f"{duration(upfront)} until the renderer was there"
    if plan and plan.chosen and plan.actual:
        predicted, actual = plan.chosen.seconds.total.expected, plan.actual.seconds["total"]
        text += f". The planned part took {duration(actual)}; {duration(predicted)} were predicted"
    return text + "."


def _bought(psnr: float | None, plan: Plan | None, quality: Quality | None) -> str:
    if psnr is None:
        return "Not measured yet; `dnrpipe evaluate` measures it."
    text = f"{psnr:.1f} dB on views that it never saw"
    if plan and plan.chosen and plan.actual and plan.actual.psnr is not None:
        text += f" ({plan.chosen.psnr.expected:.1f} dB were predicted)"
    if plan:
        text += f"; its base image alone, which needs no training, has about {plan.base_psnr:.1f} dB"
    if quality and quality.frame_seconds and quality.traced_seconds:
        text += f". A frame takes {duration(quality.frame_seconds)} instead of {duration(quality.traced_seconds)}"
    return text + "."


def _following(plan: Plan | None) -> str:
    if plan is None:
        return "Unknown; `dnrpipe plan` predicts it."
    line = [(row.seconds.total.expected, row.psnr.expected) for row in plan.table]
    chosen = plan.chosen or plan.settings_default
    now = max(chosen.seconds.total.expected, line[0][0])  # the plan knows nothing below its smallest choice
    here, later = quality_at(line, now), quality_at(line, now + NEXT)
    assert here is not None and later is not None  # both lie on the line
    gain = later - here
    return (
        f"About {gain:.1f} dB, on top of the {duration(now)} that are planned."
        if gain >= 0.05
        else "Less than 0.1 dB: the renderer is as good as its model gets on this scene."
    )


def _rows(plan: Plan) -> list[PlannedRow]:
    chosen, actual = plan.chosen, plan.actual
    if chosen is None or actual is None:
        return []
    rows = []
    for name in RENDERER_STAGES:
        spent = duration(actual.seconds[name]) if actual.ran[name] else "was done before"
        rows.append((name, duration(getattr(chosen.seconds, name)), spent))
    total, psnr = chosen.seconds.total, chosen.psnr
    predicted = f"{duration(total.expected)} ({duration(total.low)} to {duration(total.high)})"
    rows.append(("all three", predicted, duration(actual.seconds["total"])))
    if plan.carried_out is not None:
        rows.append(("steps, by the time left", str(chosen.choice.steps), str(plan.carried_out.choice.steps)))
    if actual.psnr is not None:
        predicted = f"{psnr.expected:.1f} dB ({psnr.low:.1f} to {psnr.high:.1f})"
        rows.append(("PSNR, held-out", predicted, f"{actual.psnr:.1f} dB"))
    return [PlannedRow(what=what, predicted=predicted, actual=spent) for what, predicted, spent in rows]


def _frontier_pictures(root: Path) -> list[tuple[str, str]] | None:
    """What `dnrpipe frontier` measured; None where it is missing or damaged, which that command reports."""
    from ..studies.frontier.frontier_report import verdict
    from ..studies.frontier.records import read_frontier

    try:
        results = read_frontier(root / "frontier" / "results.json")
    except UserError:
        return None
    pictures = []
    for frames in results.frames:
        path = root / "frontier" / f"frontier-{frames}.png"
        if path.exists():
            uri = "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
            pictures.append((verdict(results, frames), uri))
    return pictures

"""A plan in tables and sentences."""

from __future__ import annotations

from ...core.units import duration
from .records import RENDERER_STAGES, Plan, Prediction
from .routes import PATH_TRACING, TRAINED, UNTRAINED

BUSY = 1.5
"""Processes waiting per core from which on wall seconds say more of the other work than of this."""


def lines(plan: Plan, cores: int) -> list[str]:
    load = plan.pilot.load
    found = [f"pilot: {duration(plan.pilot.seconds)}; base image alone {plan.base_psnr:.1f} dB"]
    if load is not None and load > BUSY * cores:
        found.append(
            f"The machine was busy during the pilot (load {load:.1f} on {cores} cores): seconds are those of a"
            " busy machine; CPU seconds are not affected."
        )
    if plan.chosen is not None:
        found += ["", *choice(plan, plan.chosen)]
    elif plan.wanted.psnr is None:
        found += ["", *table(plan.table), "", "Choose one with --time or --target-psnr; --apply carries it out."]
    if plan.routes is not None:
        found += ["", *route_lines(plan)]
    return found


def table(rows: list[Prediction]) -> list[str]:
    found = [f"{'expected time':>14}  {'PSNR, dB (9 in 10)':>22}  {'views':>5}  {'spp':>4}  {'steps':>5}  CPU"]
    for row in rows:
        choice, psnr = row.choice, row.psnr
        between = f"{psnr.expected:.1f} ({psnr.low:.1f} to {psnr.high:.1f})"
        took, cpu = duration(row.seconds.total.expected), duration(row.cpu_seconds)
        found.append(f"{took:>14}  {between:>22}  {choice.views:>5}  {choice.spp:>4}  {choice.steps:>5}  {cpu}")
    return found


def choice(plan: Plan, chosen: Prediction) -> list[str]:
    what, seconds, psnr = chosen.choice, chosen.seconds, chosen.psnr
    span = seconds.total
    stages = ", ".join(f"{name} {duration(getattr(seconds, name))}" for name in RENDERER_STAGES)
    return [
        f"{what.views} views at {what.spp} spp, {what.epochs} epochs ({what.steps} steps), views by {plan.policy}",
        f"expected {duration(span.expected)} ({duration(span.low)} to {duration(span.high)}): {stages};"
        f" evaluation, for the report alone, {duration(seconds.evaluate)}",
        f"expected {psnr.expected:.1f} dB on new views ({psnr.low:.1f} to {psnr.high:.1f}, nine in ten)",
        *why(plan),
    ]


def why(plan: Plan) -> list[str]:
    """Two or three plain sentences; none without a choice."""
    if plan.chosen is None:
        return []
    seconds, psnr, default = plan.chosen.seconds, plan.chosen.psnr.expected, plan.settings_default
    most = "training" if seconds.finetune > seconds.raytrace else "ray tracing and the baked light"
    share = max(seconds.finetune, seconds.raytrace) / seconds.total.expected
    found = [
        f"The base image alone gives {plan.base_psnr:.1f} dB; the network is expected to add"
        f" {psnr - plan.base_psnr:.1f}, of at most {plan.gain:.1f} with many views and steps.",
        f"{100 * share:.0f} % of the time goes to {most}.",
    ]
    if plan.chosen.choice != default.choice:
        other, took = default.choice, duration(default.seconds.total.expected)
        found.append(
            f"The settings as they are ({other.views} views, {other.spp} spp, {other.steps} steps) would give"
            f" {default.psnr.expected:.1f} dB in {took}."
        )
    better = next((row for row in plan.table if row.psnr.expected > psnr + 0.1), None)
    if better is None:
        found.append("More time is not expected to buy as much as 0.1 dB.")
    elif (more := better.seconds.total.expected - seconds.total.expected) > 0:
        found.append(f"{duration(more)} more would buy {better.psnr.expected - psnr:.1f} dB.")
    return found


def route_lines(plan: Plan) -> list[str]:
    """Whether to train; nothing where that was not asked."""
    if plan.routes is None:
        return []
    found = [f"{plan.wanted.frames} frames at {plan.routes_psnr:.1f} dB:"]
    for route in plan.routes:
        psnr = f"{route.psnr:.1f} dB" if route.psnr is not None else "?"
        total = duration(route.total) if route.reaches else "does not reach it"
        found.append(
            f"  {route.name:<24} {total:>18}   {duration(route.upfront)} first, {duration(route.frame)} a"
            f" frame, {psnr}; {route.what}"
        )
    best = plan.routes[0]
    if not best.reaches:
        found.append("None of the routes is expected to reach it.")
    elif plan.train:
        found.append("Train: the neural renderer is the cheapest.")
    else:
        found.append(f"Do not train: {best.name} is cheaper.")
    return [*found, break_even_line(plan)]


def break_even_line(plan: Plan) -> str:
    """From how many frames on the neural renderer pays for itself, or why that cannot be said. A plan with routes."""
    reach = {route.name for route in plan.routes or [] if route.reaches}
    if plan.break_even is not None:
        return f"Break-even against path tracing + denoiser: {plan.break_even} frames."
    if PATH_TRACING not in reach:
        return "Path tracing is not expected to reach that PSNR, so there is no break-even."
    if not reach & {UNTRAINED, TRAINED}:
        return "The neural renderer is not expected to reach that PSNR, so there is no break-even."
    return "The neural renderer never pays for itself against path tracing at that PSNR."


def actual_lines(plan: Plan) -> list[str]:
    actual, chosen = plan.actual, plan.chosen
    assert actual is not None and chosen is not None  # it was carried out
    found = [f"{'':<10}{'predicted':>14}{'actual':>14}"]
    for name in RENDERER_STAGES:
        took = duration(actual.seconds[name]) if actual.ran[name] else "was done"
        found.append(f"{name:<10}{duration(getattr(chosen.seconds, name)):>14}{took:>14}")
    total = chosen.seconds.total.expected
    found.append(f"{'total':<10}{duration(total):>14}{duration(actual.seconds['total']):>14}")
    found.append(f"{'CPU':<10}{duration(chosen.cpu_seconds):>14}{duration(actual.cpu_seconds):>14}")
    if plan.carried_out is not None:
        found.append(f"{'steps':<10}{chosen.choice.steps:>14}{plan.carried_out.choice.steps:>14}")
    if actual.psnr is not None:
        found.append(f"{'PSNR':<10}{chosen.psnr.expected:>11.1f} dB{actual.psnr:>11.1f} dB")
    return found

"""A plan in tables and sentences."""

from __future__ import annotations

from typing import Any

from ...core.units import duration

BUSY = 1.5
"""Processes waiting per core from which on wall seconds say more of the other work than of this."""


def lines(record: dict[str, Any], cores: int) -> list[str]:
    """What the command prints."""
    found: list[str] = []
    pilot = record["pilot"]
    found.append(f"pilot: {duration(pilot['seconds'])}; base image alone {record['base_psnr']:.1f} dB")
    if pilot["load"] is not None and pilot["load"] > BUSY * cores:
        found.append(
            f"The machine was busy during the pilot (load {pilot['load']:.1f} on {cores} cores): seconds are those of a"
            " busy machine; CPU seconds are not affected."
        )
    chosen = record["chosen"]
    if chosen is None and record["wanted"]["psnr"] is None:
        found += ["", *table(record["table"]), "", "Choose one with --time or --target-psnr; --apply carries it out."]
    elif chosen is not None:
        found += ["", *choice(record)]
    if "routes" in record:
        found += ["", *route_lines(record)]
    if record.get("actual"):
        found += ["", *actual_lines(record)]
    return found


def table(rows: list[dict[str, Any]]) -> list[str]:
    """What each budget buys."""
    found = [f"{'expected time':>14}  {'PSNR, dB (9 in 10)':>22}  {'views':>5}  {'spp':>4}  {'steps':>5}  CPU"]
    for row in rows:
        choice, psnr = row["choice"], row["psnr"]
        between = f"{psnr['expected']:.1f} ({psnr['low']:.1f} to {psnr['high']:.1f})"
        took, cpu = duration(row["seconds"]["total"]["expected"]), duration(row["cpu_seconds"])
        found.append(
            f"{took:>14}  {between:>22}  {choice['views']:>5}  {choice['spp']:>4}  {choice['steps']:>5}  {cpu}"
        )
    return found


def choice(record: dict[str, Any]) -> list[str]:
    """The choice, its seconds, and why."""
    one = record["chosen"]
    what, seconds, psnr = one["choice"], one["seconds"], one["psnr"]
    span = seconds["total"]
    stages = ", ".join(f"{name} {duration(seconds[name])}" for name in ("select", "raytrace", "finetune"))
    return [
        f"{what['views']} views at {what['spp']} spp, {what['epochs']} epochs ({what['steps']} steps),"
        f" views by {record['policy']}",
        f"expected {duration(span['expected'])} ({duration(span['low'])} to {duration(span['high'])}): {stages};"
        f" evaluation, for the report alone, {duration(seconds['evaluate'])}",
        f"expected {psnr['expected']:.1f} dB on new views ({psnr['low']:.1f} to {psnr['high']:.1f}, nine in ten)",
        *why(record),
    ]


def why(record: dict[str, Any]) -> list[str]:
    """Two or three plain sentences."""
    one, default = record["chosen"], record["settings_default"]
    seconds, psnr, what = one["seconds"], one["psnr"]["expected"], one["choice"]
    found = [
        f"The base image alone gives {record['base_psnr']:.1f} dB; the network is expected to add"
        f" {psnr - record['base_psnr']:.1f}, of at most {record['gain']:.1f} with many views and steps."
    ]
    most = "training" if seconds["finetune"] > seconds["raytrace"] else "ray tracing and the baked light"
    share = max(seconds["finetune"], seconds["raytrace"]) / seconds["total"]["expected"]
    found.append(f"{100 * share:.0f} % of the time goes to {most}.")
    if what != default["choice"]:
        other, took = default["choice"], duration(default["seconds"]["total"]["expected"])
        found.append(
            f"The settings as they are ({other['views']} views, {other['spp']} spp, {other['steps']} steps) would give"
            f" {default['psnr']['expected']:.1f} dB in {took}."
        )
    following = next((row for row in record["table"] if row["psnr"]["expected"] > psnr + 0.1), None)
    if following is None:
        found.append("More time is not expected to buy as much as 0.1 dB.")
    else:
        more = following["seconds"]["total"]["expected"] - seconds["total"]["expected"]
        if more > 0:
            found.append(f"{duration(more)} more would buy {following['psnr']['expected'] - psnr:.1f} dB.")
    return found


def route_lines(record: dict[str, Any]) -> list[str]:
    """Whether to train."""
    frames, at = record["wanted"]["frames"], record["routes_psnr"]
    found = [f"{frames} frames at {at:.1f} dB:"]
    for route in record["routes"]:
        psnr = f"{route['psnr']:.1f} dB" if route["psnr"] is not None else "?"
        total = duration(route["total"]) if route["reaches"] else "does not reach it"
        found.append(
            f"  {route['name']:<24} {total:>18}   {duration(route['upfront'])} first, {duration(route['frame'])} a"
            f" frame, {psnr}; {route['what']}"
        )
    best = record["routes"][0]
    if not best["reaches"]:
        found.append("None of the routes is expected to reach it.")
    elif record["train"]:
        found.append("Train: the neural renderer is the cheapest.")
    else:
        found.append(f"Do not train: {best['name']} is cheaper.")
    even = record["break_even"]
    found.append(
        "The neural renderer never pays for itself against path tracing at that PSNR."
        if even is None
        else f"Break-even against path tracing + denoiser: {even} frames."
    )
    return found


def actual_lines(record: dict[str, Any]) -> list[str]:
    """Predicted against actual."""
    actual, one = record["actual"], record["chosen"]
    found = [f"{'':<10}{'predicted':>14}{'actual':>14}"]
    for name in ("select", "raytrace", "finetune"):
        took = duration(actual["seconds"][name]) if actual["ran"][name] else "was done"
        found.append(f"{name:<10}{duration(one['seconds'][name]):>14}{took:>14}")
    total = one["seconds"]["total"]["expected"]
    found.append(f"{'total':<10}{duration(total):>14}{duration(actual['seconds']['total']):>14}")
    found.append(f"{'CPU':<10}{duration(one['cpu_seconds']):>14}{duration(actual['cpu_seconds']):>14}")
    if carried_out := record.get("carried_out"):
        found.append(f"{'steps':<10}{one['choice']['steps']:>14}{carried_out['choice']['steps']:>14}")
    if actual["psnr"] is not None:
        found.append(f"{'PSNR':<10}{one['psnr']['expected']:>11.1f} dB{actual['psnr']:>11.1f} dB")
    return found

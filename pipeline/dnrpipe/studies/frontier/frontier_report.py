"""The frontier as Markdown: the front, the baselines, break-even, and plain words on who wins."""

from __future__ import annotations

from ...core.units import duration
from ..cells.results import number
from .point_costs import pareto, total_seconds
from .records import FrontierResults


def markdown(results: FrontierResults) -> str:
    code = f", commit {results.commit[:7]}" if results.commit else ""
    lines = [
        f"# What accuracy costs in time: {results.scene}",
        "",
        f"`{results.command}` on {results.machine['processor']}, {results.cores} cores, {results.date}{code}.",
        "",
        f"{results.resolution}, {results.test_views} test views against {results.evaluation_spp} spp."
        " Processor seconds: tracing, light and base images over the cores, training over its threads. The conversion"
        " of the scene, which all need, is left out.",
    ]
    for frames in results.frames:
        lines += ["", *_front(results, frames)]
    return "\n".join([*lines, "", *_break_even(results)]) + "\n"


def _front(results: FrontierResults, frames: int) -> list[str]:
    everything = results.everything
    lines = [
        f"## {frames} frames",
        "",
        "| what nothing beats | seconds | before the first frame | a frame, ms | dB | SSIM | LPIPS (VGG) | FLIP |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in pareto(everything.values(), frames):
        one = everything[name]
        lines.append(
            f"| {name} | {total_seconds(one, frames):.1f} | {one.upfront:.1f} |"
            f" {one.ms:.1f} | {one.psnr:.2f} | {number(one.ssim, 4)} |"
            f" {number(one.lpips_vgg, 4)} | {number(one.flip, 4)} |"
        )
    return [*lines, "", verdict(results, frames)]


def verdict(results: FrontierResults, frames: int) -> str:
    """Who is on the front for so many frames, and how far ahead the best of ours is at its own time."""
    ours = [p for p in results.points if p.kind in ("ours", "random", "all", "paper")]
    on_front = set(pareto(results.everything.values(), frames))
    best = max(ours, key=lambda p: p.psnr)
    seconds = total_seconds(best, frames)
    within = [r for r in results.baselines if total_seconds(r, frames) <= seconds]
    baseline = max(within, key=lambda r: r.psnr) if within else None
    if baseline is None:
        text = f"No path-traced frames are so cheap as the {duration(seconds)} of the best neural renderer."
    elif baseline.psnr >= best.psnr:
        text = (
            f"Do not train for {frames} frames: in the {duration(seconds)} of the best neural renderer"
            f" ({best.psnr:.1f} dB), path tracing ({baseline.name}) gives {baseline.psnr:.1f} dB."
        )
    else:
        text = (
            f"In the {duration(seconds)} of the best neural renderer ({best.name}, {best.psnr:.1f} dB), path"
            f" tracing gives {baseline.psnr:.1f} dB ({baseline.name})."
        )
    count = sum(p.name in on_front for p in ours)
    return f"{text} Of {len(on_front)} points on the front, {count} are neural."


def _break_even(results: FrontierResults) -> list[str]:
    lines = [
        "## Break-even",
        "",
        "N* = upfront / (path-traced frame at equal PSNR - our frame): the number of frames from which on training is"
        " cheaper than path tracing and the denoiser at the same PSNR.",
        "",
        "| renderer | views | spp | steps | before the first frame, s | a frame, ms | dB | rival at that dB, ms | N* |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for p in sorted(results.points, key=lambda p: p.upfront):
        level = "not by its last rung" if p.baseline_ms is None else f"{p.baseline_ms:.1f}"
        even = "-" if p.baseline_ms is None else "never" if p.break_even is None else str(p.break_even)
        lines.append(
            f"| {p.name} | {p.views} | {p.spp or '-'} | {p.steps or '-'} | {p.upfront:.1f} |"
            f" {p.frame_ms:.1f} | {p.psnr:.2f} | {level} | {even} |"
        )
    return lines

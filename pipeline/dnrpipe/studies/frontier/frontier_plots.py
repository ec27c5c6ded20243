"""Metrics against total seconds (log axis): shapes and line styles tell the kinds apart without colour, too."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from dnrtrain.atomic import atomic_path

from .point_costs import pareto, total_seconds
from .records import BaselinePoint, FrontierResults, Metric, Point

# Okabe and Ito's palette; filled and hollow shapes differ in grey as well.
LOOKS: dict[str, dict[str, Any]] = {
    "ours": {"label": "ours: views x spp x steps", "marker": "o", "color": "#0072B2"},
    "random": {"label": "random views", "marker": "s", "color": "#56B4E9", "fillstyle": "none"},
    "all": {"label": "all candidates", "marker": "D", "color": "#009E73"},
    "paper": {"label": "the paper's model", "marker": "P", "color": "#CC79A7"},
    "base": {"label": "base image alone", "marker": "X", "color": "#000000"},
}
BASELINES: dict[tuple[bool, bool], dict[str, Any]] = {
    (False, False): {"label": "path tracing", "marker": "v", "color": "#D55E00", "linestyle": ":", "fillstyle": "none"},
    (False, True): {"label": "path tracing + denoiser", "marker": "^", "color": "#D55E00", "linestyle": "--"},
    (True, False): {"label": "Cycles", "marker": "<", "color": "#E69F00", "linestyle": ":", "fillstyle": "none"},
    (True, True): {"label": "Cycles + its denoiser", "marker": ">", "color": "#E69F00", "linestyle": "--"},
}
"""By (whether it is Cycles, whether denoised)."""
TITLES: dict[Metric, str] = {
    "psnr": "PSNR, dB (higher is better)",
    "ssim": "SSIM (higher is better)",
    "lpips_vgg": "LPIPS VGG (lower is better)",
    "flip": "FLIP (lower is better)",
}


def plot(results: FrontierResults, frames: int, path: Path) -> None:
    """Write a PNG: a panel per metric; x: seconds until ``frames`` frames are there. The front is a grey line."""
    from matplotlib.figure import Figure

    everything = results.everything.values()
    metrics: list[Metric] = [name for name in TITLES if any(getattr(one, name) is not None for one in everything)]
    figure = Figure(figsize=(11, 8), layout="constrained")
    axes = figure.subplots(2, 2).ravel()
    for axis, metric in zip(axes, metrics, strict=False):
        _panel(axis, results, frames, metric)
    for axis in axes[len(metrics) :]:
        axis.set_visible(False)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=9)
    figure.suptitle(
        f"{results.scene}, {results.resolution}: {frames} frames, everything before the first one included",
        fontsize=11,
    )
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _panel(axis: Any, results: FrontierResults, frames: int, metric: Metric) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    front = _front(results.everything.values(), frames, metric)
    axis.plot(*zip(*front, strict=True), color="0.75", linewidth=6, solid_capstyle="round", zorder=0, label="front")
    for kind, look in LOOKS.items():
        found = [(total_seconds(p, frames), getattr(p, metric)) for p in results.points if p.kind == kind]
        found = [(x, y) for x, y in found if y is not None]
        if found:
            axis.plot(*zip(*found, strict=True), linestyle="none", markersize=6, zorder=3, **look)
    for which, look in BASELINES.items():
        best = _front((one for one in results.baselines if (one.by_cycles, one.denoised) == which), frames, metric)
        if best:
            axis.plot(*zip(*best, strict=True), markersize=5, linewidth=1.2, zorder=2, **look)
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_xlabel(f"seconds of processor time for {frames} frames")
    axis.set_title(TITLES[metric], fontsize=10)
    axis.grid(color="0.9", which="both")
    axis.set_axisbelow(True)


def _front(everything: Iterable[Point | BaselinePoint], frames: int, metric: Metric) -> list[tuple[float, float]]:
    """(seconds, metric) of those that no other of them beats, cheapest first."""
    by_name = {one.name: one for one in everything}
    names = pareto(by_name.values(), frames, metric)
    return [(total_seconds(by_name[name], frames), getattr(by_name[name], metric)) for name in names]

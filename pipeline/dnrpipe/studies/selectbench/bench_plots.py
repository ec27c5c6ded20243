"""Curves of quality against the number of views, and against all seconds that the views and the model took.

python -m dnrpipe.studies.selectbench.bench_plots results.json views.png
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

from dnrtrain.atomic import atomic_path

from .bench_tables import read_results
from .figures import Figures
from .policies import CONTENDERS

# Okabe and Ito's palette without its yellow, which is faint on white; markers tell lines apart without colour, too.
COLOURS = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7")
MARKERS = "osD^vPX*<>"
STYLES = ("-", "--", "-.", ":")
METRICS = (("psnr", "PSNR, dB"), ("ssim", "SSIM"), ("lpips_vgg", "LPIPS VGG (lower is better)"))
AXES = {"views": "views", "total_seconds": "selection + ray tracing + training, s"}
LOOKS = {
    policy: {"color": colour, "marker": marker, "linestyle": style}
    for policy, colour, marker, style in zip(CONTENDERS, cycle(COLOURS), cycle(MARKERS), cycle(STYLES), strict=False)
}
"""Of each policy, the same in every plot."""


def plot(results: Mapping[str, Any], path: Path, across: str) -> None:
    """Write a PNG: a row per pool, a column per metric. across: a key of ``AXES``.

    Lines are means over scenes and seeds; whiskers the standard deviation over seeds of the mean over scenes.
    """
    from matplotlib.figure import Figure

    figures = Figures(results)
    metrics = [
        (metric, title)
        for metric, title in METRICS
        if any(cell[metric] is not None for cells in figures.cells.values() for cell in cells.values())
    ]
    figure = Figure(figsize=(4 * len(metrics) + 1.8, 3 * len(figures.pools) + 0.6), layout="constrained")
    axes = figure.subplots(len(figures.pools), len(metrics), squeeze=False)
    for row, pool in zip(axes, figures.pools, strict=True):
        for axis, (metric, title) in zip(row, metrics, strict=True):
            for policy in figures.policies:
                points = []
                for budget in figures.budgets:
                    means = figures.means(pool, budget, policy, metric)
                    places = [budget] if across == "views" else figures.means(pool, budget, policy, across)
                    if means and places:
                        x = statistics.fmean(places)
                        points.append((x, statistics.fmean(means), statistics.stdev(means) if len(means) > 1 else 0.0))
                if points:
                    x, y, error = zip(*points, strict=True)
                    axis.errorbar(
                        x, y, yerr=error, label=policy, capsize=2, markersize=4, linewidth=1.2, **LOOKS[policy]
                    )
            axis.set_title(f"{pool}: {title}", fontsize=9)
            axis.set_xlabel(AXES[across])
            axis.grid(color="0.9")
            axis.set_axisbelow(True)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=9)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


if __name__ == "__main__":
    plot(read_results(Path(sys.argv[1])), Path(sys.argv[2]), "views")

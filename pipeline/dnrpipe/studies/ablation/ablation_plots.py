"""A plot of all rows, and one test view per scene by every row side by side."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dnrtrain.atomic import atomic_path

from .ablation_tables import Figures

PANELS = (("psnr", "PSNR, dB (higher is better)"), ("lpips_vgg", "LPIPS VGG (lower is better)"))
SIDE, GAP, HEAD, COLUMNS = 256, 6, 22, 5


def plot(results: Mapping[str, Any], path: Path) -> None:
    """Write a PNG: per row the mean over scenes with the standard deviation over seeds, and every scene as a dot."""
    from matplotlib.figure import Figure

    figures = Figures(results)
    rows = figures.rows[::-1]
    figure = Figure(figsize=(11, 1.2 + 0.34 * len(rows)), layout="constrained")
    axes = figure.subplots(1, len(PANELS), sharey=True)
    for axis, (metric, title) in zip(axes, PANELS, strict=True):
        for place, row in enumerate(rows):
            dots = [statistics.fmean(v) for scene in figures.scenes if (v := figures.scene(row, metric, scene))]
            axis.plot(dots, [place] * len(dots), "o", color="0.6", markersize=3.5, zorder=1)
            means = figures.mean(row, metric, figures.scenes)
            if means:
                error = statistics.stdev(means) if len(means) > 1 else 0.0
                axis.errorbar(statistics.fmean(means), place, xerr=error, fmt="D", color="C0", capsize=3, zorder=2)
        axis.set_yticks(range(len(rows)), rows)
        axis.set_ylim(-0.6, len(rows) - 0.4)
        axis.set_xlabel(title)
        axis.grid(axis="x", color="0.9")
        axis.set_axisbelow(True)
    count = f"{len(figures.scenes)} scene(s), {len(figures.seeds)} seed(s), {results['budget']} views"
    figure.suptitle(f"dnrpipe ablate: {count}; diamonds are means, dots are scenes", fontsize=10)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def contact_sheet(pictures: Sequence[tuple[str, Path]], path: Path) -> None:
    """Write labelled pictures side by side, ``COLUMNS`` in a line; all are shown at one size, nearest neighbour."""
    from PIL import Image, ImageDraw, ImageFont

    lines = -(-len(pictures) // COLUMNS)
    across = min(COLUMNS, len(pictures))
    sheet = Image.new("RGB", (across * (SIDE + GAP) - GAP, lines * (SIDE + HEAD + GAP)), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=13)
    for index, (label, file) in enumerate(pictures):
        left, top = index % COLUMNS * (SIDE + GAP), index // COLUMNS * (SIDE + HEAD + GAP)
        draw.text((left + 2, top + 3), label, fill="black", font=font)
        with Image.open(file) as picture:
            sheet.paste(picture.convert("RGB").resize((SIDE, SIDE), Image.Resampling.NEAREST), (left, top + HEAD))
    with atomic_path(path) as temporary:
        sheet.save(temporary, optimize=True)

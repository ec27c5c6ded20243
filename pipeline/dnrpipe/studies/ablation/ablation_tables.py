"""Markdown tables of an ablation: ``python -m dnrpipe.studies.ablation.ablation_tables results.json``."""

from __future__ import annotations

import functools
import math
import operator
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..cells.intervals import LEVEL, Difference, difference, summarise
from ..cells.results import NONE, made_line, read_made, spread, table
from ..cells.scenes import HARD_LIGHT
from .rows import GROUPS, ROWS

SCHEMA = 1
read_results = functools.partial(read_made, command="ablate", schema=SCHEMA, part="cells")
DIFFERENCES = (("psnr", 2), ("ssim", 4), ("lpips_vgg", 4))
COMPARED = (("psnr", "PSNR", 2), ("ssim", "SSIM", 4), ("lpips_vgg", "LPIPS VGG", 4), ("lpips_alex", "LPIPS Alex", 4))
# Wu, Li, Wei: DNRSelect, table I (25 views, NeRF-Synthetic, 800²): PSNR, SSIM, LPIPS; of which network it does not say.
PUBLISHED = {
    "full": (28.12, 0.8506, 0.0479),
    "paper-no-augmentation": (26.64, 0.8179, 0.0542),
    "paper-one-loss": (27.19, 0.8296, 0.0497),
    "paper-random": (27.14, 0.8314, 0.0498),
    "paper-uv": (27.84, 0.8470, 0.0503),
}
COLUMNS: tuple[tuple[str, str, int], ...] = (
    ("psnr", "PSNR", 2),
    ("lpips_vgg", "LPIPS VGG", 4),
    ("ssim", "SSIM", 4),
    ("train_psnr", "PSNR of training views", 2),
    ("psnr_mask", "PSNR in mask", 2),
    ("lpips_alex", "LPIPS Alex", 4),
    ("flip", "FLIP", 4),
    ("steps", "steps of step 2", 0),
    ("train_seconds", "training, s wall", 0),
    ("train_cpu_seconds", "s CPU", 0),
    ("frame_ms", "network, ms/frame", 1),
    ("base_ms", "base, ms/frame", 1),
)
PER_SCENE = (("psnr", "PSNR, dB", 2), ("psnr_mask", "PSNR inside the mask, dB", 2), ("ssim", "SSIM", 4),
             ("lpips_vgg", "LPIPS (VGG)", 4))  # fmt: skip
BASELINES = ("vanilla", "paper")


class Figures:
    """Cells by (scene, row, seed), and their means."""

    def __init__(self, results: Mapping[str, Any]) -> None:
        # Published results may name rows that are no longer offered, and say of others what they were then.
        what: Mapping[str, str] = results.get("rows") or {name: row.what for name, row in ROWS.items()}
        present = dict.fromkeys(cell["row"] for cell in results["cells"])
        self.what = {**what, **{name: what[name] + _elsewhere(results, name) for name in present}}
        self.rows = [name for name in ROWS if name in present] + [name for name in present if name not in ROWS]
        self.cells = {(cell["scene"], cell["row"], cell["seed"]): cell for cell in results["cells"]}
        self.scenes = [name for name in results["scenes"] if any(key[0] == name for key in self.cells)]
        self.seeds = sorted({key[2] for key in self.cells})

    def scene(self, row: str, metric: str, scene: str) -> list[float]:
        """Values of a row on one scene, one per seed that is there."""
        values = [self._value(scene, row, seed, metric) for seed in self.seeds]
        return [value for value in values if value is not None]

    def mean(self, row: str, metric: str, scenes: Sequence[str]) -> list[float]:
        """Means of a row over ``scenes``, one per seed; seeds that lack a scene are left out."""
        means = []
        for seed in self.seeds:
            found = [self._value(scene, row, seed, metric) for scene in scenes]
            if found and None not in found:
                means.append(statistics.fmean(found))
        return means

    def same(self, row: str, other: str) -> bool:
        """Whether the rows come to the same settings: their cells are the same."""
        keys = [{place[::2]: c["key"] for place, c in self.cells.items() if place[1] == name} for name in (row, other)]
        return keys[0] == keys[1]

    def paired(
        self,
        row: str,
        other: str,
        metric: str,
        scenes: Sequence[str],
        compare: Callable[[float, float], float] = operator.sub,
    ) -> list[float]:
        """Means over ``scenes`` of row - other, one per seed that both have. compare: instead of the difference."""
        found = []
        for seed in self.seeds:
            pairs = [[self._value(scene, name, seed, metric) for name in (row, other)] for scene in scenes]
            if pairs and all(None not in pair for pair in pairs):
                found.append(statistics.fmean(compare(*pair) for pair in pairs))
        return found

    def difference(self, row: str, other: str, metric: str, scene: str | None = None) -> Difference | None:
        """row - other over all (scene, seed) that both have, or one scene's; its interval speaks of these scenes."""
        both = {(where, seed) for where, name, seed in self.cells if name == row and scene in (None, where)}
        pairs = {pair: [self._value(pair[0], name, pair[1], metric) for name in (row, other)] for pair in sorted(both)}
        return summarise({pair: a - b for pair, (a, b) in pairs.items() if None not in (a, b)}, pairs=True)

    def _value(self, scene: str, row: str, seed: int, metric: str) -> Any:
        """None where there is no such cell, or it was not measured."""
        return self.cells.get((scene, row, seed), {}).get(metric)


def _elsewhere(results: Mapping[str, Any], row: str) -> str:
    """What a row's name is followed by: where cells were trained on other devices than the results' own, on which."""
    own = results.get("device")
    devices = {cell.get("device", own) for cell in results["cells"] if cell["row"] == row}
    others = sorted(devices - {own})
    return f" ({'in part ' if own in devices else ''}trained on {', '.join(others)})" if others else ""


def ratio(a: float, b: float) -> float:
    """a / b; NaN where b is 0."""
    return a / b if b else math.nan


def markdown(results: Mapping[str, Any]) -> str:
    """All tables that the results can fill."""
    figures = Figures(results)
    title = f"Mean over {len(figures.scenes)} scenes" if len(figures.scenes) > 1 else figures.scenes[0]
    parts = [_provenance(results, figures), _means(figures, figures.scenes, title)]
    easy = [scene for scene in figures.scenes if scene not in HARD_LIGHT]
    if 1 < len(easy) < len(figures.scenes):
        parts.append(_means(figures, easy, f"Mean over the {len(easy)} scenes without hard light"))
    parts += [_per_scene(figures, *column) for column in PER_SCENE]
    parts += [_gains(figures), _paper(figures), _figure7(figures), _ingredients(figures)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _provenance(results: Mapping[str, Any], figures: Figures) -> str:
    time = f"about {results['seconds']:g} s of training for every row" if results["seconds"] else "the preset's epochs"
    return (
        f"{made_line(results)}, {results['budget']}"
        f" training views, {len(figures.seeds)} seed(s), {time}. PSNR and SSIM over white; ± is the standard deviation"
        " over seeds; training time includes step 1 where a row has it. Δ with brackets: the mean of differences paired"
        f" by scene and seed, and the {LEVEL:.0%} interval of Student's t over the pairs, bold where it leaves out 0."
        " It speaks of these scenes."
    )


def _means(figures: Figures, scenes: Sequence[str], title: str) -> str:
    columns = [column for column in COLUMNS if any(figures.mean(row, column[0], scenes) for row in figures.rows)]
    rows = []
    for row in figures.rows:
        cells = [spread(figures.mean(row, metric, scenes), digits) for metric, _, digits in columns]
        rows.append([f"`{row}`", figures.what[row], *cells])
    body = table(["row", "what", *[title for _, title, _ in columns]], rows)
    ceiling = [
        max(found)
        for scene in scenes
        if (found := [v for r in figures.rows for v in figures.scene(r, "ceiling", scene)])
    ]
    note = f"\n\nMean ceiling by the noise of the references: {statistics.fmean(ceiling):.1f} dB." if ceiling else ""
    return f"### {title}\n\n{body}{note}"


def _per_scene(figures: Figures, metric: str, title: str, digits: int) -> str:
    head = ["scene", *[f"`{row}`" for row in figures.rows]]
    psnr = metric == "psnr"
    rows = []
    for scene in figures.scenes:
        line = [scene, *[spread(figures.scene(row, metric, scene), digits) for row in figures.rows]]
        rows.append([*line, spread(figures.scene(figures.rows[0], "ceiling", scene)[:1], 1)] if psnr else line)
    return f"### {title}, per scene\n\n{table([*head, 'ceiling'] if psnr else head, rows)}"


def _gains(figures: Figures) -> str:
    baselines = [row for row in BASELINES if row in figures.rows]
    if "dnr" not in figures.rows or not baselines:
        return ""
    head = ["scene", *[f"{what} `{baseline}`" for baseline in baselines for what in ("ΔPSNR over", "LPIPS VGG over")]]
    rows = []
    for name, scenes in [*[(scene, [scene]) for scene in figures.scenes], ("**mean**", figures.scenes)]:
        line = [name]
        for baseline in baselines:
            line.append(spread(figures.paired("dnr", baseline, "psnr", scenes), 2, signed=True))
            line.append(spread(figures.paired("dnr", baseline, "lpips_vgg", scenes, ratio), 2))
        rows.append(line)
    return f"### `dnr` against its rivals\n\n{table(head, rows)}"


def _paper(figures: Figures) -> str:
    """The paper's table: each mechanism taken away, against row `paper`, and DNR, which has none of them; against DNR
    DNRSelect without its selector, and DNR trained longer."""
    of_paper = [row for row in figures.rows if row in ROWS and ROWS[row].family != "dnr" and row != "paper"]
    pairs = [(row, "paper") for row in of_paper]
    pairs += [(row, "vanilla") for row in of_paper if row in ("paper-random", "vanilla-long") and "vanilla" in of_paper]
    rows = [line for row, other in pairs for line in _claims(figures, row, other)]
    if not rows:
        return ""
    head = ["row", "instead of", "pairs", "metric", "Δ", "the paper's", "the paper's order", *figures.scenes]
    return f"### The paper's table: what each mechanism is worth\n\n{table(head, rows)}"


def _claims(figures: Figures, row: str, other: str) -> list[list[str]]:
    """A line for each metric: row - other, what the paper has, each scene's."""
    known = PUBLISHED.get(row) if other == "paper" else None
    lines: list[list[str]] = []
    for metric, title, digits in COMPARED:
        found = figures.difference(row, other, metric)
        if found is None:
            continue
        place = ("psnr", "ssim", "lpips").index(metric.partition("_")[0])
        theirs = known[place] - PUBLISHED["full"][place] if known else None
        lines.append([
            *([figures.what[row], f"`{other}`", str(found.pairs)] if not lines else ["", "", ""]),
            *(title, difference(found, digits), NONE if theirs is None else f"{theirs:+.{digits}f}"),
            NONE if theirs is None else _verdict(theirs, found),
            *(difference(figures.difference(row, other, metric, scene), digits) for scene in figures.scenes),
        ])  # fmt: skip
    return lines


def _differences(figures: Figures, row: str, other: str) -> list[str]:
    return [spread(figures.paired(row, other, metric, figures.scenes), digits, signed=True)
            for metric, digits in DIFFERENCES]  # fmt: skip


def _verdict(theirs: float, ours: Difference | None) -> str:
    """Whether the sign of the paper's difference is ours, as far as the interval carries it."""
    if ours is None or ours.half is None:
        return NONE
    if not ours.clear:
        return "inside the noise"
    return "reproduced" if (ours.mean < 0) == (theirs < 0) else "the other way"


def _figure7(figures: Figures) -> str:
    parts = []
    for title, group in (
        ("Fig. 7a: how the maps are aggregated", "fig7a"),
        ("Fig. 7b: which maps are aggregated", "fig7b"),
        ("Fig. 7c: what the selector is rewarded for", "fig7c"),
    ):
        names = GROUPS[group]
        if not all(name in figures.rows for name in names):
            continue
        rows = [
            [figures.what[name], *[spread(figures.mean(name, m, figures.scenes), d) for m, _, d in COLUMNS[:4]],
             *[difference(figures.difference(name, "paper", m), d) for m, d in DIFFERENCES],
             # The figures' heights are not given; the text says that the paper's own is the best.
             NONE if name == "paper" else _verdict(-1.0, figures.difference(name, "paper", "psnr"))]
            for name in names
        ]  # fmt: skip
        head = ["", *[head for _, head, _ in COLUMNS[:4]], "ΔPSNR to `paper`", "ΔSSIM", "ΔLPIPS VGG"]
        head.append("the paper's order, PSNR")
        parts.append(f"### {title}\n\n{table(head, rows)}")
    return "\n\n".join(parts)


def _ingredients(figures: Figures) -> str:
    """Our ingredients, one changed at a time: differences from ``dnr``."""
    names = [row for row in figures.rows if row in ROWS and ROWS[row].family == "dnr" and row != "dnr"]
    if "dnr" not in figures.rows or not names:
        return ""
    rows = []
    for name in names:
        line = [f"`{name}`", figures.what[name]]
        if figures.same(name, "dnr"):
            rows.append([*line, "is `dnr`", *[""] * 4])
            continue
        milliseconds = [spread(figures.mean(name, part, figures.scenes), 1) for part in ("frame_ms", "base_ms")]
        rows.append([*line, *_differences(figures, name, "dnr"), *milliseconds])
    head = ["row", "what differs from `dnr`", "ΔPSNR", "ΔSSIM", "ΔLPIPS VGG", "network, ms", "base, ms"]
    return f"### Ingredients of `dnr`, one changed at a time\n\n{table(head, rows)}"


if __name__ == "__main__":
    print(markdown(read_results(Path(sys.argv[1]))), end="")

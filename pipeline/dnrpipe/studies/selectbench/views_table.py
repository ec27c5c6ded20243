"""Quality against the number of traced views, the paper's central figure.

Of benchmarks with three budgets or more, or two of which one is all candidates.
"""

from __future__ import annotations

import statistics

from ..cells.intervals import LEVEL, difference
from ..cells.results import NONE, spread, table
from .figures import Figures
from .policies import CONTENDERS

LEAST_BUDGETS = 3
METRICS = (("psnr", "PSNR, dB", 2), ("lpips_vgg", "LPIPS VGG", 4), ("train_psnr", "PSNR of training views, dB", 2))
DIFFERENCES = (("psnr", "ΔPSNR", 2), ("lpips_vgg", "ΔLPIPS", 4))


def by_views(figures: Figures, pool: str) -> str:
    """Tables over all budgets of a pool; "" where there are too few."""
    if len(figures.budgets) < LEAST_BUDGETS - figures.reaches_all:
        return ""
    parts = [f"### `{pool}`, against the number of traced views"]
    for metric, title, digits in METRICS:
        rows = [
            [str(budget), *[spread(figures.means(pool, budget, policy, metric), digits) for policy in figures.policies]]
            for budget in figures.budgets
        ]
        if any(cell != NONE for row in rows for cell in row[1:]):
            parts.append(f"{title}:\n\n{table(['views', *[f'`{policy}`' for policy in figures.policies]], rows)}")
    if figures.reaches_all:
        parts.append(_against_all(figures, pool))
    learned = [name for name in figures.policies if name in CONTENDERS and CONTENDERS[name].kind == "step1"]
    parts += [_learned(figures, pool, policy) for policy in learned]
    return "\n\n".join(parts)


def _against_all(figures: Figures, pool: str) -> str:
    """What fewer views than all lose."""
    *fewer, every = figures.budgets
    rows = [
        [
            str(budget),
            f"`{policy}`",
            *[
                difference(figures.paired(pool, (policy, budget), (policy, every), metric), digits)
                for metric, _, digits in DIFFERENCES
            ],
        ]
        for budget in fewer
        for policy in figures.policies
        if {(pool, budget, policy), (pool, every, policy)} <= figures.cells.keys()
    ]
    return (
        f"Fewer views minus all {every}, paired by scene and seed, with the {LEVEL:.0%} interval of Student's t over"
        f" the pairs:\n\n{table(['views', 'policy', *[title for _, title, _ in DIFFERENCES]], rows)}"
    )


def _learned(figures: Figures, pool: str, policy: str) -> str:
    """What a policy that step 1 trains gains over the others, and what it costs."""
    others = [other for other in figures.policies if other != policy]
    rows = []
    for budget in figures.budgets:
        line = [str(budget)]
        for other in others:
            pair = (policy, budget), (other, budget)
            line += [difference(figures.paired(pool, *pair, metric), digits) for metric, _, digits in DIFFERENCES]
        rows.append([*line, in_traced_views(figures, pool, budget, policy)])
    head = [f"{title} to `{other}`" for other in others for _, title, _ in DIFFERENCES]
    return (
        f"`{policy}` minus the others, paired by scene and seed, with the {LEVEL:.0%} interval of Student's t over the"
        " pairs, which speaks of these scenes. Its choice takes as long as tracing so many more views; a renderer that"
        " starts from step 1's weights trains a step 1 whatever the policy, which is not taken off:\n\n"
        + table(["views", *head, "choosing, in traced views"], rows)
    )


def in_traced_views(figures: Figures, pool: str, budget: int, policy: str) -> str:
    """How many views could be traced in the seconds that choosing takes, mean over cells."""
    choosing = figures.values(pool, budget, policy, "select_seconds")
    tracing = figures.values(pool, budget, policy, "view_seconds")
    shares = [choosing[place] / (tracing[place] / budget) for place in choosing if tracing.get(place)]
    return f"{statistics.fmean(shares):.1f}" if shares else NONE

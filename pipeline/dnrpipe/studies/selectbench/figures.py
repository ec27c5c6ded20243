"""Numbers from ``results.json``: means over scenes, spreads over seeds, paired differences and their confidence.

Two policies are compared where all else is equal: scene, pool, budget, seed. The seeds of a scene share its difficulty
and its candidates, so they are no independent trials: the unit is the *scene*, its value the mean over seeds, and the
interval is Student's over scenes. With a single scene the units are its seeds, and the interval speaks of that scene.
"""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .policies import SIMPLE
from .pools import POOLS

SPHERICAL = ("dome", "sphere")
LEVEL = 0.95


class Figures:
    """Cells by pool, budget, policy; then by (scene, seed)."""

    def __init__(self, results: Mapping[str, Any]) -> None:
        self.cells: dict[tuple[str, int, str], dict[tuple[str, int], dict[str, Any]]] = {}
        for cell in results["cells"]:
            place = (cell["pool"], cell["budget"], cell["policy"])
            self.cells.setdefault(place, {})[cell["scene"], cell["seed"]] = cell
        present = {(cell["scene"]) for cell in results["cells"]}
        self.scenes = [name for name in results["scenes"] if name in present]
        self.pools = [name for name in POOLS if any(place[0] == name for place in self.cells)]
        self.budgets = sorted({place[1] for place in self.cells})
        # In the order of the run: published results name policies that are no longer offered, too.
        self.policies = list(dict.fromkeys(cell["policy"] for cell in results["cells"]))
        self.seeds = sorted({cell["seed"] for cell in results["cells"]})

    def values(self, pool: str, budget: int, policy: str, metric: str) -> dict[tuple[str, int], float]:
        """A metric by (scene, seed), where it was measured."""
        found = self.cells.get((pool, budget, policy), {})
        return {place: cell[metric] for place, cell in found.items() if cell[metric] is not None}

    def means(self, pool: str, budget: int, policy: str, metric: str) -> list[float]:
        """Means over all scenes, one per seed; seeds that lack a scene are left out."""
        values = self.values(pool, budget, policy, metric)
        whole = [seed for seed in self.seeds if all((scene, seed) in values for scene in self.scenes)]
        return [statistics.fmean(values[scene, seed] for scene in self.scenes) for seed in whole]

    def best_simple(self, pool: str, budget: int) -> str | None:
        """The simple rule of highest mean PSNR over the (scene, seed) that all simple rules here have."""
        found = {name: self.values(pool, budget, name, "psnr") for name in SIMPLE}
        found = {name: values for name, values in found.items() if values}
        shared = set.intersection(*(set(values) for values in found.values())) if found else set()
        if not shared:
            return None
        return max(found, key=lambda name: statistics.fmean(found[name][place] for place in shared))

    def against(self, policy: str, kind: str, pools: Sequence[str], budget: int, metric: str) -> Difference | None:
        """policy - baseline, each pool with its own: ``random``, or its best simple rule for kind ``simple``.

        Over several pools it is the mean of each (scene, seed) over them. None where they share nothing, or where the
        policy is the baseline everywhere; where it is the baseline in some pools, these count as 0.
        """
        baselines = {pool: self.best_simple(pool, budget) if kind == "simple" else kind for pool in pools}
        baselines = {pool: baseline for pool, baseline in baselines.items() if baseline is not None}
        if all(baseline == policy for baseline in baselines.values()):
            return None
        found: dict[tuple[str, int], list[float]] = {}
        for pool, baseline in baselines.items():
            ours, theirs = (self.values(pool, budget, name, metric) for name in (policy, baseline))
            for place in ours.keys() & theirs.keys():
                found.setdefault(place, []).append(ours[place] - theirs[place])
        whole = {place: statistics.fmean(pairs) for place, pairs in found.items() if len(pairs) == len(baselines)}
        return summarise({place: whole[place] for place in sorted(whole)})


@dataclass(frozen=True)
class Difference:
    """Mean of paired differences, half the width of its interval (None where one unit is all there is), and the mean
    of each scene."""

    mean: float
    half: float | None
    scenes: dict[str, float]

    @property
    def clear(self) -> bool:
        """Whether the interval leaves out 0."""
        return self.half is not None and abs(self.mean) > self.half


def summarise(differences: Mapping[tuple[str, int], float], level: float = LEVEL) -> Difference | None:
    """Mean and interval of paired differences by (scene, seed); None where there are none."""
    if not differences:
        return None
    by_scene: dict[str, list[float]] = {}
    for (scene, _), value in differences.items():
        by_scene.setdefault(scene, []).append(value)
    means = {scene: statistics.fmean(values) for scene, values in by_scene.items()}
    units = next(iter(by_scene.values())) if len(means) == 1 else list(means.values())
    return Difference(statistics.fmean(units), half_width(units, level), means)


def half_width(values: Sequence[float], level: float = LEVEL) -> float | None:
    """Half of Student's confidence interval of the mean; None for fewer than two values."""
    count = len(values)
    if count < 2:
        return None
    return t_quantile(0.5 + level / 2, count - 1) * statistics.stdev(values) / math.sqrt(count)


@functools.cache
def t_quantile(probability: float, freedom: int) -> float:
    """Quantile of Student's t, 0.5 <= probability < 1, freedom >= 1, to 1e-9; by bisection."""
    low, high = 0.0, 1.0
    while t_distribution(high, freedom) < probability:
        high *= 2
    while high - low > 1e-9 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if t_distribution(middle, freedom) < probability else (low, middle)
    return high


def t_distribution(t: float, freedom: int) -> float:
    """P(T <= t) for integer degrees of freedom, t >= 0 (Abramowitz and Stegun 26.7.3 and 26.7.4)."""
    angle = math.atan(t / math.sqrt(freedom))
    cos2 = math.cos(angle) ** 2
    odd = freedom % 2
    term = math.cos(angle) if odd else 1.0
    total = 0.0
    for k in range(freedom // 2):  # a finite series: 1 + 1/2 cos² + ..., or cos + 2/3 cos³ + ...
        total += term
        term *= cos2 * ((2 * k + 2) / (2 * k + 3) if odd else (2 * k + 1) / (2 * k + 2))
    within = 2 / math.pi * (angle + math.sin(angle) * total) if odd else math.sin(angle) * total
    return 0.5 + within / 2

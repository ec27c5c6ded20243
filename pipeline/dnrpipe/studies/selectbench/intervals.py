"""Paired differences and their confidence intervals.

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

LEVEL = 0.95


@dataclass(frozen=True)
class Difference:
    """Mean of paired differences, half the width of its interval (None where one unit is all there is), units,
    their kind, and the mean of each scene."""

    mean: float
    half: float | None
    units: int
    over: str
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
    single = len(means) == 1
    units = next(iter(by_scene.values())) if single else list(means.values())
    half = half_width(units, level)
    return Difference(statistics.fmean(units), half, len(units), "seeds" if single else "scenes", means)


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

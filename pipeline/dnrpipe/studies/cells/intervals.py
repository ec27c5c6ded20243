"""Paired differences by (scene, seed), and Student's confidence interval of their mean."""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from .results import NONE

LEVEL = 0.95


@dataclass(frozen=True)
class Difference:
    """Mean of paired differences.

    half: half the width of its interval, None where one unit is all there is. scenes: the mean of each.
    """

    mean: float
    half: float | None
    scenes: dict[str, float]
    pairs: int

    @property
    def clear(self) -> bool:
        """Whether the interval leaves out 0."""
        return self.half is not None and abs(self.mean) > self.half


def summarise(
    differences: Mapping[tuple[str, int], float], level: float = LEVEL, *, pairs: bool = False
) -> Difference | None:
    """Mean and interval of paired differences by (scene, seed); None where there are none.

    pairs: the units are the pairs, and the interval speaks of these very scenes. Else they are the scenes, each with
    its mean over seeds, and it speaks of scenes like them; with a single scene they are its seeds.
    """
    if not differences:
        return None
    by_scene: dict[str, list[float]] = {}
    for (scene, _), value in differences.items():
        by_scene.setdefault(scene, []).append(value)
    means = {scene: statistics.fmean(values) for scene, values in by_scene.items()}
    units = list(differences.values()) if pairs or len(means) == 1 else list(means.values())
    return Difference(statistics.fmean(units), half_width(units, level), means, len(differences))


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


def difference(found: Difference | None, digits: int = 2) -> str:
    """``+0.42 [+0.10, +0.74]``, bold where the interval leaves out 0."""
    if found is None:
        return NONE
    if found.half is None:
        return f"{found.mean:+.{digits}f}"
    low, high = found.mean - found.half, found.mean + found.half
    text = f"{found.mean:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"
    return f"**{text}**" if found.clear else text

"""The best picture by milliseconds among several renderers, and where they draw level with another.

Notation
    point     (ms, dB) of one way of rendering
    frontier  points that no other point beats in both; ms and dB both rise along it

Between two points of the frontier dB is taken to be linear in log(ms): noise falls with a power of the samples.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

Point = tuple[float, float]


def frontier(points: Mapping[str, Point]) -> list[str]:
    """Names of the frontier's points, cheapest first."""
    best = -math.inf
    names = []
    for name, (_, quality) in sorted(points.items(), key=lambda item: (item[1][0], -item[1][1])):
        if quality > best:
            names.append(name)
            best = quality
    return names


def quality_at(line: Sequence[Point], ms: float) -> float | None:
    """dB of the frontier at ``ms``; None where nothing is that cheap, the last point's beyond the end."""
    if not line or ms < line[0][0]:
        return None
    for (left, low), (right, high) in pairwise(line):
        if ms < right:
            return low + (high - low) * math.log(ms / left) / math.log(right / left)
    return line[-1][1]


def crossover(line: Sequence[Point], quality: float) -> float | None:
    """Milliseconds from which on the frontier is at least ``quality``; None where it never is."""
    if line and line[0][1] >= quality:
        return line[0][0]
    for (left, low), (right, high) in pairwise(line):
        if high >= quality:
            return left * (right / left) ** ((quality - low) / (high - low))
    return None

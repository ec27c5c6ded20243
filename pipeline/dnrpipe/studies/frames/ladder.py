"""The rival's best picture by milliseconds, where we stand at equal time, and where the rival draws level.

Notation
    point     (ms, dB) of one way of rendering
    frontier  points that no other point beats in both; ms and dB both rise along it

Between two points of the frontier dB is taken to be linear in log(ms): noise falls with a power of the samples.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

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


def standing(points: Mapping[str, Point], ours: Point) -> dict[str, Any]:
    """Ours against the ladder.

    {"frontier": names, "rival_db": the rival at our time, "lead_db": ours minus that, "cheapest": whether that is the
    rival's cheapest point, which takes longer than we do, "crossover_ms": None where the ladder ends below us,
    "ladder_end_ms"}
    """
    names = frontier(points)
    line = [points[name] for name in names]
    found = quality_at(line, ours[0])
    rival = line[0][1] if found is None else found
    return {
        "frontier": names,
        "rival_db": rival,
        "lead_db": ours[1] - rival,
        "cheapest": found is None,
        "crossover_ms": crossover(line, ours[1]),
        "ladder_end_ms": line[-1][0],
    }


def classes(points: Mapping[str, Point], ours: Point, limits: Sequence[float]) -> list[dict[str, Any]]:
    """Per class of at most so many ms: the rival's best point and ours; None where one has nothing so fast."""
    rows = []
    for limit in limits:
        within = {name: point for name, point in points.items() if point[0] <= limit}
        best = max(within, key=lambda name: within[name][1]) if within else None
        rows.append(
            {
                "limit_ms": limit,
                "rival": best,
                "rival_db": within[best][1] if best else None,
                "ours_db": ours[1] if ours[0] <= limit else None,
            }
        )
    return rows

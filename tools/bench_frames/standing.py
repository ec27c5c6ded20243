"""One renderer's point (ms, dB) against the points of path tracing with a denoiser."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dnrpipe.studies.frames.pareto_front import Point, crossover, frontier, quality_at

CLASSES = (0.03, 0.07, 0.3)
"""Seconds per 128² pixels that the classes are named by; their limits grow with the pixel count."""


def class_limits(size: Sequence[int]) -> list[float]:
    """Milliseconds of CLASSES for pictures of that width and height."""
    return [1000 * seconds * size[0] * size[1] / 128**2 for seconds in CLASSES]


def standing(points: Mapping[str, Point], ours: Point) -> dict[str, Any]:
    """Ours against the baselines.

    Returns:
        frontier: names of the baselines that nothing beats.
        rival_db: their dB at our time. lead_db: ours minus that.
        cheapest: whether that is their cheapest point, which takes longer than we do.
        crossover_ms: when they draw level, None where they end below us. ladder_end_ms: of their last point.
    """
    names = frontier(points)
    line = [points[name] for name in names]
    found = quality_at(line, ours[0])
    baseline = line[0][1] if found is None else found
    return {
        "frontier": names,
        "rival_db": baseline,
        "lead_db": ours[1] - baseline,
        "cheapest": found is None,
        "crossover_ms": crossover(line, ours[1]),
        "ladder_end_ms": line[-1][0],
    }


def classes(points: Mapping[str, Point], ours: Point, limits: Sequence[float]) -> list[dict[str, Any]]:
    """Per class of at most so many ms: the best baseline and ours; None where one has nothing so fast."""
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

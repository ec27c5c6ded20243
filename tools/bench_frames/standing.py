"""One renderer's point (ms, dB) against the points of path tracing with a denoiser."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dnrpipe.studies.frames.pareto_front import Point, crossover, frontier, quality_at


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

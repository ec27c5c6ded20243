"""What a selection leaves uncovered, and what each of its views brought, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .visibility import SurfaceVisibility

NOT_SEEN = -2.0
"""In place of a cosine."""


@dataclass(frozen=True)
class Coverage:
    """After each view of an ordered selection, over all pixels of all candidates.

    uncovered: share whose piece of surface no chosen view sees. angles: mean angle, in degrees, between the
    directions from which candidate and nearest chosen view see a covered piece.
    """

    uncovered: list[float]
    angles: list[float]


def coverage_of(visibility: SurfaceVisibility, views: Sequence[int]) -> Coverage:
    """Follow a selection view by view. Everything counts as covered where no candidate sees anything."""
    weights = visibility.pixels.astype(np.float64)
    total = weights.sum()
    uncovered, angles = [], []
    for nearest in nearest_cosines(visibility, views):
        covered = nearest > NOT_SEEN
        share = weights[covered]
        angle = np.degrees(np.arccos(np.clip(nearest[covered], -1.0, 1.0)))
        uncovered.append(float(1.0 - share.sum() / total) if total else 0.0)
        angles.append(float(angle @ share / share.sum()) if share.sum() else 0.0)
    return Coverage([max(0.0, value) for value in uncovered], angles)


def nearest_cosines(visibility: SurfaceVisibility, views: Sequence[int]) -> Iterator[np.ndarray]:
    """After each view: per entry the cosine to the nearest chosen view direction of its cell, float32 [E].

    NOT_SEEN where no chosen view sees the cell. The array is the same one each time, changed.
    """
    cells, view_directions = visibility.cells, visibility.view_directions
    nearest = np.full(len(cells), NOT_SEEN, np.float32)
    for view in views:
        part = visibility.of(view)
        known = np.zeros(visibility.grid**2, bool)
        direction = np.zeros((visibility.grid**2, 3), np.float32)
        known[cells[part]] = True
        direction[cells[part]] = view_directions[part]
        cosine = np.einsum("ek,ek->e", direction[cells], view_directions)
        np.maximum(nearest, np.where(known[cells], cosine, NOT_SEEN), out=nearest)
        yield nearest


def sentences(coverage: Coverage) -> list[str]:
    """One per view, e.g. "first to see 12.0 % of what the candidates see; mean angle to it now 31°"."""
    found = []
    before, angle_before = 1.0, None
    for uncovered, angle in zip(coverage.uncovered, coverage.angles, strict=True):
        new = max(0.0, before - uncovered)
        text = f"first to see {new:.1%} of what the candidates see" if new >= 0.0005 else "sees nothing new"
        if angle_before is None:
            text += f"; mean angle to the nearest sighting {angle:.0f}°"
        else:
            text += f"; mean angle to the nearest sighting {angle_before:.1f}° → {angle:.1f}°"
        found.append(text)
        before, angle_before = uncovered, angle
    return found


def explained(visibility: SurfaceVisibility | None, views: Sequence[int], why: Sequence[str]) -> tuple[list[str], dict]:
    """``why`` with what each view added, and what stays uncovered, for the details. Without visibility: ``why``, {}."""
    if visibility is None:
        return list(why), {}
    coverage = coverage_of(visibility, views)
    texts = [f"{reason}; {text}" if reason else text for reason, text in zip(why, sentences(coverage), strict=True)]
    facts = {
        "uncovered": coverage.uncovered[-1],
        "uncovered_after_each": coverage.uncovered,
        "mean_angle_degrees": coverage.angles[-1],
    }
    return texts, facts

"""Distances between cameras, and bins of the sphere of directions."""

from __future__ import annotations

import numpy as np

from .protocol import Candidates

BINS = 32
"""Bins of the sphere of directions, about 40 degrees wide."""


def camera_features(candidates: Candidates) -> np.ndarray:
    """Positions, centred and scaled to unit mean radius, beside unit directions: float64 [N, 6].

    Two cameras at one place that look different ways are far apart too.
    """
    positions = candidates.positions - candidates.positions.mean(axis=0)
    spread = np.linalg.norm(positions, axis=1).mean()
    return np.concatenate([positions / max(spread, 1e-12), candidates.directions], axis=1)


def farthest_first(features: np.ndarray, first: int, count: int) -> tuple[list[int], list[float]]:
    """Farthest-point sampling (Gonzalez 1985) of ``count`` of the points [N, K], 1 <= count <= N.

    -> their indices, beginning with ``first``, and the distance of each to the nearest before it (0 for the first).
    The lowest index wins ties.
    """
    chosen, away = [first], [0.0]
    nearest = np.full(len(features), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.linalg.norm(features - features[chosen[-1]], axis=1))
        nearest[chosen] = -1.0  # never again, even where points coincide
        chosen.append(int(nearest.argmax()))
        away.append(float(nearest[chosen[-1]]))
    return chosen, away


def distances(features: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Euclidean distances from the points at ``some`` [B] to all of ``features`` [N, K]: float32 [B, N].

    By differences, not by the scalar product: equal points are at distance 0 exactly.
    """
    total = np.zeros((len(some), len(features)), np.float32)
    for column in features.astype(np.float32).T:
        total += np.square(column[some, None] - column[None, :])
    return np.sqrt(total, out=total)


def direction_bins() -> np.ndarray:
    """Centres of the bins of the sphere: BINS unit vectors on a Fibonacci spiral, float32 [BINS, 3]."""
    k = np.arange(BINS) + 0.5
    z = 1.0 - 2.0 * k / BINS
    angle = np.pi * (1.0 + 5.0**0.5) * k
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1).astype(np.float32)

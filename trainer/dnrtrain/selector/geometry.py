"""Cameras as points: the space in which geometric policies measure distance."""

from __future__ import annotations

import numpy as np

from .protocol import Candidates

BLOCK = 1_000_000


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


def even_shares(features: np.ndarray, scale: float) -> np.ndarray:
    """What each candidate should count where places count alike, however many candidates stand there: float32 [N].

    1 over the kernel density of the candidates there (Gaussian of standard deviation ``scale``), summing to 1: of k
    candidates within much less than ``scale`` each counts 1 / k.
    """
    count = len(features)
    block = max(1, BLOCK // max(1, count))
    density = np.empty(count)
    for first in range(0, count, block):
        some = np.arange(first, min(first + block, count))
        away = distances(features, some) / np.float32(max(scale, 1e-6))
        density[some] = np.exp(-0.5 * np.square(away)).sum(axis=1, dtype=np.float64)
    shares = 1.0 / density  # at least 1: each candidate is at its own place
    return (shares / shares.sum()).astype(np.float32)

"""Cameras as points: the space in which geometric policies measure distance."""

from __future__ import annotations

import numpy as np

from .protocol import Candidates


def camera_features(candidates: Candidates) -> np.ndarray:
    """Positions, centred and scaled to unit mean radius, beside unit directions: float64 [N, 6].

    Two cameras at one place that look different ways are far apart too.
    """
    positions = candidates.positions - candidates.positions.mean(axis=0)
    spread = np.linalg.norm(positions, axis=1).mean()
    return np.concatenate([positions / max(spread, 1e-12), candidates.directions], axis=1)


def distances(features: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Euclidean distances from the points at ``some`` [B] to all of ``features`` [N, K]: float32 [B, N].

    By differences, not by the scalar product: equal points are at distance 0 exactly.
    """
    total = np.zeros((len(some), len(features)), np.float32)
    for column in features.astype(np.float32).T:
        total += np.square(column[some, None] - column[None, :])
    return np.sqrt(total, out=total)

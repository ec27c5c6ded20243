"""Policies that look at cameras only: random, and farthest-point sampling."""

from __future__ import annotations

import numpy as np

from .protocol import Cameras, Policy, check_budget


class RandomPolicy:
    """Uniform without replacement."""

    def choose(self, views: Cameras, budget: int, seed: int) -> list[int]:
        check_budget(budget, len(views))
        order = np.random.default_rng([seed, 0x52]).permutation(len(views))
        return [int(i) for i in order[:budget]]


class FarthestPolicy:
    """Farthest-point sampling on camera position and viewing direction (Gonzalez 1985).

    Features are positions, centred and scaled to unit mean radius, beside unit directions: two cameras
    at one place that look different ways are far apart too. The first view is random by seed; each next
    one maximises the distance to its nearest chosen view (the lowest index wins ties).
    """

    def choose(self, views: Cameras, budget: int, seed: int) -> list[int]:
        count = len(views)
        check_budget(budget, count)
        positions = views.positions - views.positions.mean(axis=0)
        spread = np.linalg.norm(positions, axis=1).mean()
        features = np.concatenate([positions / max(spread, 1e-12), views.directions], axis=1)
        chosen = [int(np.random.default_rng([seed, 0x46]).integers(count))]
        nearest = np.full(count, np.inf)
        while len(chosen) < budget:
            nearest = np.minimum(nearest, np.linalg.norm(features - features[chosen[-1]], axis=1))
            nearest[chosen] = -1.0  # never again, even where cameras coincide
            chosen.append(int(np.argmax(nearest)))
        return chosen


BASELINES: dict[str, Policy] = {"random": RandomPolicy(), "farthest": FarthestPolicy()}

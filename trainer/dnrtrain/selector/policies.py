"""The policies that need no training, by name; and those that look at cameras only and start at random."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from ..contract import ContractError
from .coverage import CoveragePolicy
from .geometry import camera_features, farthest_first
from .medoids import KMedoidsPolicy
from .names import NAMES
from .protocol import Candidates, Choice, Policy, Tick, check_budget


class RandomPolicy:
    """Uniform without replacement."""

    needs_visibility: ClassVar[bool] = False
    effort: ClassVar[int] = 0

    def choose(self, candidates: Candidates, budget: int, seed: int, tick: Tick | None = None) -> Choice:
        check_budget(budget, len(candidates))
        order = np.random.default_rng([seed, 0x52]).permutation(len(candidates))
        return Choice([int(i) for i in order[:budget]], [0.0] * budget, ["drawn at random"] * budget)


class FarthestPolicy:
    """Farthest-point sampling on camera position and viewing direction (Gonzalez 1985).

    The first view is random by seed; each next one maximises the distance to its nearest chosen view in the
    space of `geometry.camera_features` (the lowest index wins ties).
    """

    needs_visibility: ClassVar[bool] = False
    effort: ClassVar[int] = 0

    def choose(self, candidates: Candidates, budget: int, seed: int, tick: Tick | None = None) -> Choice:
        count = len(candidates)
        check_budget(budget, count)
        first = int(np.random.default_rng([seed, 0x46]).integers(count))
        chosen, gains = farthest_first(camera_features(candidates), first, budget)
        why = [f"farthest from all views before it: {gain:.2f}" for gain in gains]
        why[0] = "drawn at random, as the first"
        measure = "distance to the nearest view chosen before, position (in mean radii) and direction together"
        return Choice(chosen, gains, why, {"measure": measure})


UNTRAINED: dict[str, Policy] = {
    # No learned selection was better than the rules, and coverage is the best of them on average: by hundredths of a
    # dB, by more where the renderer paints from nothing (docs/bench-select.md).
    "auto": CoveragePolicy(),
    "coverage": CoveragePolicy(),
    "kmedoids": KMedoidsPolicy(),
    "farthest": FarthestPolicy(),
    "random": RandomPolicy(),
}


def untrained(name: str) -> Policy | None:
    """The policy of that name; None for one that step 1 must train. Raises ContractError for an unknown one."""
    if name not in NAMES:
        raise ContractError(f"unknown policy '{name}'; choose one of {', '.join(NAMES)}")
    return UNTRAINED.get(name)

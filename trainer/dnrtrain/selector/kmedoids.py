"""k-medoids on camera poses: every candidate is near a chosen one."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from .explain import explained
from .geometry import camera_features, distances
from .medoids import Facilities, build, swap
from .pool import choose_useful
from .protocol import Candidates, Choice, Tick


class KMedoidsPolicy:
    """Minimises the mean distance from a candidate to its nearest chosen view (PAM, with FasterPAM's swaps).

    Distances are those of `geometry.camera_features`. The seed changes nothing.
    """

    needs_visibility: ClassVar[bool] = True
    effort: ClassVar[int] = 8

    def choose(self, candidates: Candidates, budget: int, seed: int, tick: Tick | None = None) -> Choice:
        return choose_useful(candidates, budget, lambda some, count: _choose(some, count, tick))


def camera_problem(candidates: Candidates) -> Facilities:
    """Facility location of cameras among themselves, each candidate of weight 1 / N."""
    count, features = len(candidates), camera_features(candidates)
    farthest = 2.0 * float(np.linalg.norm(features - features.mean(axis=0), axis=1).max()) + 1e-6
    return Facilities(
        count,
        lambda some: distances(features, some),
        np.full(count, 1.0 / count, np.float32),
        np.full(count, farthest, np.float32),
    )


def medoids(problem: Facilities, budget: int, tick: Tick | None = None) -> list[int]:
    """BUILD, then swaps."""
    return swap(problem, build(problem, budget, tick=tick)[0], tick)


def _choose(candidates: Candidates, budget: int, tick: Tick | None) -> Choice:
    problem = camera_problem(candidates)
    views, gains = build(problem, budget, medoids(problem, budget, tick))
    owner = problem.rows(np.array(views)).argmin(axis=0)
    near = np.bincount(owner, minlength=len(views))
    why = [f"stands for {n} candidates around it" if n > 1 else "stands for itself" for n in near]
    why, facts = explained(candidates.visibility, views, why)
    measure = "decrease of the mean distance of a candidate to its nearest chosen view (position and direction)"
    return Choice(views, gains, why, {"measure": measure, "mean_distance": problem.cost(views), **facts})

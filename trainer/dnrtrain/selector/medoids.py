"""k-medoids on camera poses, by facility location: M of N views such that every point of demand is near one of them.

cost(S) = Σ_o weight_o · min_{s ∈ S} distance(s, o). With all candidates as demand this is k-medoids.
Distances come as rows on request, in blocks: neither N × N nor N × demand is ever in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .explain import explained
from .geometry import camera_features, distances
from .greedy import lazy_greedy
from .pool import choose_useful
from .protocol import Candidates, Choice, Tick

BLOCK_ELEMENTS = 4_000_000
SWEEPS = 20
"""Passes of the swap search over all candidates, at most; it mostly ends after three to five."""
WORTH = 1e-5
"""A swap must lower the cost by this share of it: rounding must not keep the search going."""


@dataclass(frozen=True)
class Facilities:
    """The problem.

    count: N. rows: indices [B] -> distances float32 [B, D]. weights: float32 [D].
    nothing: float32 [D], the distance of demand that no view serves; at least as large as all distances.
    """

    count: int
    rows: Callable[[np.ndarray], np.ndarray]
    weights: np.ndarray
    nothing: np.ndarray

    def cost(self, chosen: Sequence[int]) -> float:
        """Of a selection; of the empty one, too."""
        near = self.nothing.copy()
        for view in chosen:
            np.minimum(near, self.rows(np.array([view]))[0], out=near)
        return float(near @ self.weights)


def build(
    problem: Facilities, budget: int, among: Sequence[int] | None = None, tick: Tick | None = None
) -> tuple[list[int], list[float]]:
    """Greedy selection in order, and by how much each view lowered the cost (BUILD of PAM, Kaufman & Rousseeuw 1990).

    Args:
        problem: what is covered by what, at which distance.
        among: the views to choose from; None: all.
    """
    views = np.arange(problem.count) if among is None else np.asarray(among)
    near = problem.nothing.copy()

    def row(element: int) -> np.ndarray:
        return problem.rows(views[element : element + 1])[0]

    order, gains = lazy_greedy(
        len(views),
        budget,
        lambda element: float(np.maximum(near - row(element), 0.0) @ problem.weights),
        lambda element: np.minimum(near, row(element), out=near),
        tick,
    )
    return [int(views[element]) for element in order], gains


def swap(problem: Facilities, chosen: Sequence[int], tick: Tick | None = None) -> list[int]:
    """Exchange chosen views for others while that lowers the cost (FasterPAM, Schubert & Rousseeuw 2021).

    Eager: a block's best exchange is made at once. Of N candidates and M views one sweep takes N rows, not N · M.
    """
    if len(chosen) >= problem.count:
        return list(chosen)
    block = max(1, BLOCK_ELEMENTS // max(1, len(problem.weights)))
    state = _State(problem, list(chosen))
    for _ in range(SWEEPS):
        before = state.cost
        for first in range(0, problem.count, block):
            views = np.arange(first, min(first + block, problem.count))
            state.improve(views, problem.rows(views))
            if tick is not None:
                tick(len(views))
        if state.cost >= before:
            break
    return state.chosen


class _State:
    """A selection with each demand's nearest and second nearest view."""

    def __init__(self, problem: Facilities, chosen: list[int]) -> None:
        self.problem, self.chosen = problem, chosen
        self.table = problem.rows(np.array(chosen))
        self._update()

    def _update(self) -> None:
        self.owner = self.table.argmin(axis=0)
        everyone = np.arange(self.table.shape[1])
        self.near = self.table[self.owner, everyone]
        if len(self.chosen) == 1:
            self.second = self.problem.nothing
        else:
            self.second = np.partition(self.table, 1, axis=0)[1]
        self.cost = float(self.near @ self.problem.weights)
        members = np.zeros((self.table.shape[1], len(self.chosen)), np.float32)
        members[everyone, self.owner] = self.problem.weights
        self.members = members

    def improve(self, views: np.ndarray, rows: np.ndarray) -> None:
        """Make this block's best exchange, again and again, while one pays."""
        for _ in range(len(views)):
            # What the newcomer brings, if nobody leaves; and what leaving costs, if the newcomer is there.
            brings = np.minimum(rows - self.near, 0.0) @ self.problem.weights
            leaving = (np.clip(rows, self.near, self.second) - self.near) @ self.members
            change = brings[:, None] + leaving
            change[np.isin(views, self.chosen)] = np.inf
            best, out = np.unravel_index(int(change.argmin()), change.shape)
            if not change[best, out] < -WORTH * self.cost:
                return
            before = self.cost
            kept, self.chosen[out] = self.chosen[out], int(views[best])
            row = self.table[out].copy()
            self.table[out] = rows[best]
            self._update()
            if self.cost >= before:  # the gain was rounding
                self.chosen[out], self.table[out] = kept, row
                self._update()
                return


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


def _choose(candidates: Candidates, budget: int, tick: Tick | None) -> Choice:
    problem = camera_problem(candidates)
    medoids = swap(problem, build(problem, budget, tick=tick)[0], tick)
    views, gains = build(problem, budget, medoids)
    owner = problem.rows(np.array(views)).argmin(axis=0)
    near = np.bincount(owner, minlength=len(views))
    why = [f"stands for {n} candidates around it" if n > 1 else "stands for itself" for n in near]
    why, facts = explained(candidates.visibility, views, why)
    measure = "decrease of the mean distance of a candidate to its nearest chosen view (position and direction)"
    return Choice(views, gains, why, {"measure": measure, "mean_distance": problem.cost(views), **facts})

"""Where the learned selector lives: a pool and a budget, views taken one by one, rewards from the surrogate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..contract import ContractError
from .demand import demand_of, demand_problem
from .geometry import camera_features, distances, even_shares
from .kmedoids import camera_problem, medoids
from .protocol import Candidates, check_budget
from .surrogate import Surrogate

FEATURES = (
    "new error",  # the surrogate's error on the view's own pixels over its mean
    "unseen",  # share of its pixels on cells that no chosen view sees
    "service",  # decrease of the surface's cost over the cost left
    "cameras",  # decrease of the cameras' cost over the cost left
    "distance",  # to the nearest chosen view over the mean of that
    "crowd",  # how much it counts: its share of places times N
    "seen",  # share of its pixels that hit surface over the mean
    "detail",  # raster gradients over the mean
    "specular",  # how much the colours of what it sees change with direction, over the mean
    "taken",  # share of the budget taken
)
NEIGHBOURS, SWEEPS = 10, 3
"""Each chosen view is tried against so many views nearest to it, the whole selection so many times over."""


class Environment:
    """One pool and budget: an episode adds views one by one."""

    def __init__(self, candidates: Candidates, budget: int) -> None:
        sightings = candidates.sightings
        if sightings is None:
            raise ContractError("policy 'dqn' needs the candidates' sightings (selector.sightings.read_sightings)")
        check_budget(budget, len(candidates))
        self.candidates, self.sightings, self.budget = candidates, sightings, budget
        cameras = camera_problem(candidates)
        scale = cameras.cost(medoids(cameras, budget))
        points = camera_features(candidates)
        self.shares = even_shares(points, scale)
        self.away = distances(points, np.arange(len(points)))
        self.farthest = cameras.nothing
        self.surrogate = Surrogate(sightings, self.shares)
        demand = demand_of(sightings, self.shares)
        self.wanted = demand.weights
        self.served = 1.0 - demand_problem(sightings, demand).rows(np.arange(len(candidates)))  # [N, D]
        self.fixed = np.stack(
            [
                self.shares * len(candidates),
                _over_mean(sightings.seen),
                _over_mean(sightings.detail),
                _over_mean(self._specular()),
            ],
            axis=1,
        )
        self.reset()

    def _specular(self) -> np.ndarray:
        """Per view, the mean over its pixels of the variance of their cell's colour among all candidates, [N]."""
        s = self.surrogate
        total = np.bincount(s.place, s.pixels, s.cells)
        variance = np.zeros(s.cells)
        for channel in s.colours.T:
            mean = np.bincount(s.place, s.pixels * channel, s.cells) / total
            variance += np.bincount(s.place, s.pixels * np.square(channel - mean[s.place]), s.cells) / total
        return np.bincount(s.view, s.part * variance[s.place], len(self.sightings))

    def reset(self) -> None:
        self.surrogate.reset()
        self.start = max(self.surrogate.error, 1e-12)
        self.near = self.farthest.copy()
        self.service = np.zeros(self.served.shape[1], np.float32)
        self.known = np.zeros(self.surrogate.cells, bool)
        self.selected = np.zeros(len(self.candidates), bool)

    @property
    def potential(self) -> float:
        """Φ: 1 less the cameras' and surface's cost, half and half, as shares of what they are with no view."""
        cameras = float(self.near @ self.shares) / float(self.farthest @ self.shares)
        return 1.0 - 0.5 * cameras - 0.5 * (1.0 - float(self.service @ self.wanted))

    def step(self, view: int) -> float:
        """Take a view; -> its reward, without shaping."""
        decrease = self.surrogate.add(view)
        np.minimum(self.near, self.away[view], out=self.near)
        np.maximum(self.service, self.served[view], out=self.service)
        self.known[self.surrogate.place[self.sightings.of(view)]] = True
        self.selected[view] = True
        return decrease / self.start

    def features(self) -> np.ndarray:
        """What each view would add now, float32 [N, len(FEATURES)]."""
        s, count = self.surrogate, len(self.candidates)
        left = max(float(self.near @ self.shares), 1e-9)
        cameras = np.maximum(self.near - self.away, 0.0) @ self.shares / left
        unserved = max(1.0 - float(self.service @ self.wanted), 1e-9)
        service = np.maximum(self.served - self.service, 0.0) @ self.wanted / unserved
        unseen = np.bincount(s.view, s.part * ~self.known[s.place], count)
        moving = [_over_mean(s.errors), unseen, service, cameras, _over_mean(self.near)]
        taken = np.full(count, self.selected.sum() / self.budget)
        return np.concatenate([np.stack(moving, axis=1), self.fixed, taken[:, None]], axis=1).astype(np.float32)


def _over_mean(values: np.ndarray) -> np.ndarray:
    return np.minimum(values / max(float(values.mean()), 1e-12), 5.0)


def exchange(environment: Environment, views: Sequence[int]) -> list[int]:
    """Exchange chosen views for near ones while the surrogate's error falls."""
    surrogate, views = environment.surrogate, list(views)
    surrogate.run(views)
    for _ in range(SWEEPS):
        before = surrogate.error
        for place, out in enumerate(list(views)):
            near = [int(v) for v in np.argsort(environment.away[out], kind="stable") if int(v) not in views]
            surrogate.remove(out)
            gains = [surrogate.gain(v) for v in [out, *near[:NEIGHBOURS]]]
            best = int(np.argmax(gains))
            views[place] = out if best == 0 or gains[best] <= gains[0] + 1e-9 * environment.start else near[best - 1]
            surrogate.add(views[place])
        if surrogate.error >= before * (1.0 - 1e-6):
            break
    return views


def in_order(environment: Environment, views: Sequence[int]) -> list[int]:
    """The same set, the view of largest gain first, and so on."""
    left = sorted(views)
    while left:
        gains = [environment.surrogate.gain(view) for view in left]
        environment.surrogate.add(left.pop(int(np.argmax(gains))))
    return list(environment.surrogate.chosen)

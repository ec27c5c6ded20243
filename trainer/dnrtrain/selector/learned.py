"""The learned selector as a policy: roll-out, exchanges, and the surrogate's word on who is best."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..contract import ContractError
from .coverage import CoveragePolicy
from .environment import Environment, exchange, in_order
from .exchange import ExchangePolicy
from .explain import explained
from .geometry import camera_features, farthest_first
from .kmedoids import KMedoidsPolicy
from .names import SHIPPED_WEIGHTS
from .pool import choose_useful
from .protocol import Candidates, Choice, Tick

POOL = 300
"""Of larger pools this many candidates, far from each other, are looked at, and what the rules chose."""


class DqnPolicy:
    """Roll-out of a trained network, exchanges, and the guard; see :mod:`.dqn`.

    weights: a file of :func:`.dqn.save_network`, read when first asked. The seed changes nothing.
    """

    looks: ClassVar[bool] = True
    effort: ClassVar[int] = 28

    def __init__(self, weights: Path = SHIPPED_WEIGHTS) -> None:
        self.weights = weights

    def choose(self, candidates: Candidates, budget: int, seed: int, tick: Tick | None = None) -> Choice:
        return choose_useful(candidates, budget, lambda some, count: self._choose(some, count, tick))

    def _choose(self, candidates: Candidates, budget: int, tick: Tick | None) -> Choice:
        from .dqn import load_network, rollout  # torch: not for the rules

        network, info = load_network(self.weights)
        if candidates.sightings is None:
            raise ContractError("policy 'dqn' needs the candidates' sightings (selector.sightings.read_sightings)")
        rules = {"exchange": ExchangePolicy(), "kmedoids": KMedoidsPolicy(), "coverage": CoveragePolicy()}
        chosen = {name: rule.choose(candidates, budget, 0, tick).views for name, rule in rules.items()}
        looked_at = np.arange(len(candidates))
        if len(candidates) > POOL:
            spread = farthest_first(camera_features(candidates), 0, max(POOL, budget))[0]
            looked_at = np.unique([*spread, *(view for views in chosen.values() for view in views)])
        place = {int(view): index for index, view in enumerate(looked_at)}
        environment = Environment(candidates.take(looked_at), budget)
        if tick is not None:
            tick(len(candidates))
        options = {name: [place[view] for view in views] for name, views in chosen.items()}
        options["exchange, improved"] = exchange(environment, options["exchange"])
        options["learned"] = exchange(environment, rollout(environment, network))
        errors = {name: environment.surrogate.run(views) / environment.start for name, views in options.items()}
        best = min(errors, key=lambda name: (errors[name], name))
        surrogate, gains = environment.surrogate, []
        surrogate.reset()
        views = in_order(environment, options[best])
        surrogate.reset()
        remaining = []
        for view in views:
            gains.append(max(0.0, surrogate.add(view) / environment.start))
            remaining.append(surrogate.error / environment.start)
        views = [int(looked_at[view]) for view in views]
        why = [f"error of the surrogate on all candidates → {left:.1%}" for left in remaining]
        why, facts = explained(candidates.sightings, views, why)
        details: dict[str, Any] = {
            "measure": "decrease of the surrogate's squared error on all rasterised candidates, 1 = with no view",
            "guard": {"chosen": best, "errors": errors},
            "trained_on": info.get("scenes", []),
            "remaining_error": remaining,
            **facts,
        }
        return Choice(views, gains, why, details)

"""k-medoids on poses, then exchanges that also count what is seen of the surface; places count, not candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..contract import ContractError
from .demand import demand_of, demand_problem
from .explain import explained
from .geometry import camera_features, even_shares
from .kmedoids import camera_problem, medoids
from .medoids import Facilities, beside, build, swap
from .pool import choose_useful, complete_useful
from .protocol import Candidates, Choice, Tick

if TYPE_CHECKING:
    from .remaining import CellErrors

MEASURE = "decrease of cameras' and surface's cost together, 1 = the cost of the k-medoids start"
GEOMETRY = 0.5
"""Weight of the cameras' part of the cost; the surface's has the rest. Both are in units of their cost at the start."""


class ExchangePolicy:
    """k-medoids on poses as the start, then swaps on a cost of two parts, equally weighted.

    cameras   mean distance of a candidate to its nearest chosen view, in poses (what k-medoids minimises)
    surface   mean, over the pixels of all candidates, of 1 − how well the best chosen view serves them
              (:mod:`.demand`): the same surface seen from near that direction at that resolution

    Both means are over places, not over candidates: where a camera stood still, its many candidates count about as one
    (:func:`.geometry.even_shares` at the scale of k-medoids' mean distance, that is, of the selection itself).
    Where no sightings are given, or no candidate sees anything, it is k-medoids, and ``details`` says so.
    """

    looks: ClassVar[bool] = True
    effort: ClassVar[int] = 13

    def choose(self, candidates: Candidates, budget: int, seed: int, tick: Tick | None = None) -> Choice:
        return choose_useful(candidates, budget, lambda some, count: _choose(some, count, tick))


def second_look(
    candidates: Candidates, kept: Sequence[int], budget: int, errors: CellErrors, tick: Tick | None = None
) -> Choice:
    """The views that complete ``kept`` to ``budget``, now that it is known where those leave errors.

    The cost is :class:`ExchangePolicy`'s, what is wanted of the surface weighted by the error expected there
    (:mod:`.remaining`, measured on ``kept``). ``kept`` stays; the answer holds the new views only.
    ``details["remaining_error"]``: the expected errors of the surface, each times 1 − the service of its best view: of
    the views kept, then after each new one.

    Raises ContractError: no sightings, or not len(kept) < budget <= N.
    """
    if candidates.sightings is None or not 0 < len(kept) < budget:
        raise ContractError(f"a second look needs sightings, some views ({len(kept)}) and a larger budget ({budget})")
    return complete_useful(candidates, kept, budget, lambda some, old, count: _complete(some, old, count, errors, tick))


def _choose(candidates: Candidates, budget: int, tick: Tick | None) -> Choice:
    cameras, start = _cameras(candidates, budget, tick)
    sightings = candidates.sightings
    if sightings is None or not len(sightings.cells):
        views, gains = build(cameras, budget, start)
        measure = "decrease of the mean distance of a place to its nearest chosen view (position and direction)"
        note = "k-medoids on poses, places alike: nothing is known of what the candidates see"
        return Choice(views, gains, [note] * len(views), {"measure": measure, "note": note})
    surface = demand_problem(sightings, demand_of(sightings, cameras.weights))
    costs = {"cameras": cameras.cost(start), "surface": surface.cost(start)}
    both = combined(cameras, surface, costs)
    views, gains = build(both, budget, swap(both, start, tick))
    why, facts = explained(sightings, views, [""] * len(views))
    details = {
        "measure": MEASURE,
        "k_medoids_cost": costs,
        "cost": {"cameras": cameras.cost(views), "surface": surface.cost(views)},
        "exchanged": len(set(start) - set(views)),
        **facts,
    }
    return Choice(views, gains, why, details)


def _complete(candidates: Candidates, kept: list[int], count: int, errors: CellErrors, tick: Tick | None) -> Choice:
    sightings = candidates.sightings
    assert sightings is not None and len(sightings.cells)  # checked; useful candidates see something
    cameras, start = _cameras(candidates, len(kept) + count, tick)
    demand = demand_of(sightings, cameras.weights)
    expected = errors.mean * float(errors.relative(demand.cells) @ demand.weights)
    surface = demand_problem(sightings, errors.reweighted(demand))
    both = combined(cameras, surface, {"cameras": cameras.cost(start), "surface": surface.cost(start)})
    rest = beside(both, kept)
    others = sorted(set(range(len(candidates))) - set(kept))
    views = swap(rest, build(rest, count, others, tick)[0], tick)
    views, gains = build(rest, count, views)
    why, facts = explained(sightings, [*kept, *views], [""] * (len(kept) + count))
    remaining = [expected * surface.cost([*kept, *views[:more]]) for more in range(count + 1)]
    details = {"measure": MEASURE, "remaining_error": remaining, **facts}
    texts = [
        f"{text}; expected error of what is not served {before:.2e} → {after:.2e}"
        for text, before, after in zip(why[len(kept) :], remaining, remaining[1:], strict=False)
    ]
    return Choice(views, gains, texts, details)


def _cameras(candidates: Candidates, budget: int, tick: Tick | None) -> tuple[Facilities, list[int]]:
    """The cameras' part, places alike, and what k-medoids chooses by it."""
    cameras = camera_problem(candidates)
    start = medoids(cameras, budget, tick)
    cameras = replace(cameras, weights=even_shares(camera_features(candidates), cameras.cost(start)))
    return cameras, swap(cameras, start, tick)


def combined(cameras: Facilities, surface: Facilities, costs: dict[str, float]) -> Facilities:
    """One problem of both; a part whose cost is 0 already (all chosen) has no say."""

    def share(weight: float, cost: float) -> np.float32:
        return np.float32(weight / cost if cost > 1e-9 else 0.0)

    parts = ((cameras, share(GEOMETRY, costs["cameras"])), (surface, share(1.0 - GEOMETRY, costs["surface"])))
    return Facilities(
        cameras.count,
        lambda some: np.concatenate([cameras.rows(some), surface.rows(some)], axis=1),
        np.concatenate([problem.weights * scale for problem, scale in parts]),
        np.concatenate([problem.nothing for problem, _ in parts]),
    )

"""Coverage of surface × direction, with diminishing returns for what was seen before."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from ..contract import ContractError
from .explain import explained
from .geometry import BINS, direction_bins
from .greedy import lazy_greedy
from .pool import choose_useful
from .protocol import Candidates, Choice, Tick
from .sightings import Sightings

SHARPNESS = 8.0
"""A sighting counts for its three nearest bins of directions by exp(SHARPNESS · cosine): 40° off counts 0.15."""
NEIGHBOURS = 3


class CoveragePolicy:
    """Greedy maximisation of Σ_k sqrt(all_k · chosen_k) / Σ_k all_k.

    k runs over cell × bin of directions; all_k and chosen_k are the pixels that all candidates and the chosen views
    have there, so resolution counts, and a second sighting from the same side adds 0.41 of the first. 1 is reached with
    all candidates. A concave function of a sum is submodular (Lin & Bilmes 2011).
    """

    looks: ClassVar[bool] = True
    effort: ClassVar[int] = 6

    def choose(self, candidates: Candidates, budget: int, seed: int, tick: Tick | None = None) -> Choice:
        return choose_useful(candidates, budget, lambda some, count: _choose(some, count, tick))


def _choose(candidates: Candidates, budget: int, tick: Tick | None) -> Choice:
    sightings = candidates.sightings
    if sightings is None:
        raise ContractError("policy 'coverage' needs the candidates' sightings (selector.sightings.read_sightings)")
    keys, amounts = _spread_over_bins(sightings)
    size = sightings.grid**2 * BINS
    wanted = np.bincount(keys.ravel(), amounts.ravel(), size)
    chosen = np.zeros(size)
    scale = 1.0 / wanted.sum()

    def gain(view: int) -> float:
        part = sightings.of(view)
        key, amount = keys[part], amounts[part]
        have = chosen[key]
        return float((np.sqrt(wanted[key]) * (np.sqrt(have + amount) - np.sqrt(have))).sum()) * scale

    def take(view: int) -> None:
        part = sightings.of(view)
        np.add.at(chosen, keys[part].ravel(), amounts[part].ravel())

    views, gains = lazy_greedy(len(candidates), budget, gain, take, tick)
    why, facts = explained(sightings, views, [f"adds {gain:.2%} coverage" for gain in gains])
    measure = "share of coverage: surface × direction of view × pixels, square root of repeated sightings"
    return Choice(views, gains, why, {"measure": measure, "coverage": float(sum(gains)), **facts})


def _spread_over_bins(sightings: Sightings) -> tuple[np.ndarray, np.ndarray]:
    """Sightings -> (cell · BINS + bin int32 [E, 3], pixels float32 [E, 3]), over the nearest bins."""
    axes = direction_bins().T
    keys = np.empty((len(sightings.cells), NEIGHBOURS), np.int32)
    amounts = np.empty((len(sightings.cells), NEIGHBOURS), np.float32)
    for view in range(len(sightings)):
        part = sightings.of(view)
        cosine = sightings.toward[part] @ axes
        nearest = np.argpartition(-cosine, NEIGHBOURS, axis=1)[:, :NEIGHBOURS]
        share = np.exp(SHARPNESS * np.take_along_axis(cosine, nearest, axis=1))
        share /= share.sum(axis=1, keepdims=True)
        keys[part] = sightings.cells[part, None] * BINS + nearest
        amounts[part] = share * sightings.pixels[part, None]
    return keys, amounts

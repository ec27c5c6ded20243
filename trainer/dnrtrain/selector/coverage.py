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
from .visibility import SurfaceVisibility

SHARPNESS = 8.0
"""A cell seen from a direction counts for its three nearest bins by exp(SHARPNESS · cosine): 40° off counts 0.15."""
NEIGHBOURS = 3


class CoveragePolicy:
    """Greedy maximisation of Σ_k sqrt(all_k · chosen_k) / Σ_k all_k.

    k runs over cell × bin of directions; all_k and chosen_k are the pixels that all candidates and the chosen views
    have there, so resolution counts, and a second view of the same side adds 0.41 of the first. 1 is reached with
    all candidates. A concave function of a sum is submodular (Lin & Bilmes 2011).
    """

    needs_visibility: ClassVar[bool] = True
    effort: ClassVar[int] = 6

    def choose(self, candidates: Candidates, budget: int, seed: int, tick: Tick | None = None) -> Choice:
        return choose_useful(candidates, budget, lambda some, count: _choose(some, count, tick))


def _choose(candidates: Candidates, budget: int, tick: Tick | None) -> Choice:
    visibility = candidates.visibility
    if visibility is None:
        raise ContractError(
            "policy 'coverage' needs the surface visibility of the candidates (see selector.visibility)"
        )
    bins, weights = _spread_over_bins(visibility)
    size = visibility.grid**2 * BINS
    targets = np.bincount(bins.ravel(), weights.ravel(), size)
    chosen = np.zeros(size)
    scale = 1.0 / targets.sum()

    def gain(view: int) -> float:
        part = visibility.of(view)
        places, weight = bins[part], weights[part]
        have = chosen[places]
        return float((np.sqrt(targets[places]) * (np.sqrt(have + weight) - np.sqrt(have))).sum()) * scale

    def take(view: int) -> None:
        part = visibility.of(view)
        np.add.at(chosen, bins[part].ravel(), weights[part].ravel())

    views, gains = lazy_greedy(len(candidates), budget, gain, take, tick)
    why, facts = explained(visibility, views, [f"adds {gain:.2%} coverage" for gain in gains])
    measure = "share of coverage: surface × direction of view × pixels, square root of repeated sightings"
    return Choice(views, gains, why, {"measure": measure, "coverage": float(sum(gains)), **facts})


def _spread_over_bins(visibility: SurfaceVisibility) -> tuple[np.ndarray, np.ndarray]:
    """-> (cell · BINS + bin, int32 [E, 3]; coverage weights in pixels, float32 [E, 3]) of the nearest bins."""
    axes = direction_bins().T
    bins = np.empty((len(visibility.cells), NEIGHBOURS), np.int32)
    weights = np.empty((len(visibility.cells), NEIGHBOURS), np.float32)
    for view in range(len(visibility)):
        part = visibility.of(view)
        cosine = visibility.view_directions[part] @ axes
        nearest = np.argpartition(-cosine, NEIGHBOURS, axis=1)[:, :NEIGHBOURS]
        share = np.exp(SHARPNESS * np.take_along_axis(cosine, nearest, axis=1))
        share /= share.sum(axis=1, keepdims=True)
        bins[part] = visibility.cells[part, None] * BINS + nearest
        weights[part] = share * visibility.pixels[part, None]
    return bins, weights

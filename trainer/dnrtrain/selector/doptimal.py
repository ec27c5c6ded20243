"""D-optimal design for a neural texture: views that pin down its texels best."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from ..contract import ContractError
from .explain import explained
from .greedy import lazy_greedy
from .pool import choose_useful
from .protocol import Candidates, Choice, Tick

PRIOR = 0.05
"""Ridge λ, in median sightings: below it, a cell counts as unknown."""
HARMONICS = 9


class DOptimalPolicy:
    """Greedy maximisation of log det(I + J_Sᵀ J_S / λ), J the Jacobian of what a DNR is linear in.

    A texel of a deferred neural texture meets the 9 real spherical harmonics of the view direction, bands 0 to 2
    (Thies et al. 2019), so the Jacobian of a pixel is its cell times h(direction), and JᵀJ is block-diagonal: one
    9 × 9 block per cell, Σ_v pixels_v h_v h_vᵀ. The determinant lemma gives the gain of a sighting,
    log(1 + p hᵀA⁻¹h), and Sherman-Morrison the inverse after it: exact, nothing sketched. Each cell's log det counts
    by the pixels that all candidates have there. Sequential D-optimal design: Fedorov 1972.
    """

    looks: ClassVar[bool] = True
    effort: ClassVar[int] = 6

    def choose(self, candidates: Candidates, budget: int, seed: int, tick: Tick | None = None) -> Choice:
        return choose_useful(candidates, budget, lambda some, count: _choose(some, count, tick))


def harmonics(toward: np.ndarray) -> np.ndarray:
    """Real spherical harmonics of bands 0-2 at unit vectors [E, 3], scaled to mean square 1 each: float32 [E, 9]."""
    x, y, z = toward.T
    one = np.ones_like(x)
    bands = [
        one,
        *(3**0.5 * value for value in (x, y, z)),
        *(15**0.5 * value for value in (x * y, y * z, x * z)),
        15**0.5 / 2 * (x * x - y * y),
        5**0.5 / 2 * (3 * z * z - 1),
    ]
    return np.stack(bands, axis=1).astype(np.float32)


def _choose(candidates: Candidates, budget: int, tick: Tick | None) -> Choice:
    sightings = candidates.sightings
    if sightings is None:
        raise ContractError("policy 'd-optimal' needs the candidates' sightings (selector.sightings.read_sightings)")
    information = sightings.pixels / (PRIOR * np.median(sightings.pixels))
    weights = np.bincount(sightings.cells, sightings.pixels, sightings.grid**2)
    weights /= weights.sum()
    known = np.unique(sightings.cells)
    place = np.searchsorted(known, sightings.cells)
    inverse = np.broadcast_to(np.eye(HARMONICS, dtype=np.float32), (len(known), HARMONICS, HARMONICS)).copy()

    def towards(view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(place [e], A⁻¹h [e, 9], p hᵀA⁻¹h [e]) of the view's sightings."""
        part = sightings.of(view)
        basis = harmonics(sightings.toward[part])
        solved = np.matmul(inverse[place[part]], basis[:, :, None])[:, :, 0]
        return place[part], solved, information[part] * np.einsum("ek,ek->e", basis, solved)

    def gain(view: int) -> float:
        where, _, amount = towards(view)
        return float(np.log1p(np.maximum(amount, 0.0)) @ weights[known[where]])

    def take(view: int) -> None:
        where, solved, amount = towards(view)
        scale = information[sightings.of(view)] / (1.0 + np.maximum(amount, 0.0))
        inverse[where] -= scale[:, None, None] * solved[:, :, None] * solved[:, None, :]

    views, gains = lazy_greedy(len(candidates), budget, gain, take, tick)
    why, facts = explained(sightings, views, [f"adds {gain:.3f} nats per cell" for gain in gains])
    measure = "nats of information on a texel's 9 harmonics, mean over cells by the candidates' pixels"
    return Choice(views, gains, why, {"measure": measure, **facts})

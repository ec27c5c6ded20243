"""Fisher information of the trained coarse renderer: views that its weights still know least about.

FisherRF (Jiang et al. 2024) scores a view by the diagonal of its Fisher information over what is known. Taken in
batches that picks alike views again and again, so the gain here is that of the diagonal's log determinant: what a view
adds falls with what the views before it told (redundancy control), and greedy choice is near the best one.

Notation
    J_v   Jacobian of a view's rendered pixels (display RGB) by the weights
    H_v   diag(J_vᵀ J_v) = E[(J_vᵀ ε)²] for random signs ε (Hutchinson): one backward pass per draw
"""

from __future__ import annotations

import numpy as np
import torch

from ..dataset import ViewSet
from ..model import DNR
from .explain import explained
from .greedy import lazy_greedy
from .pool import choose_useful
from .protocol import Candidates, Choice

PROBES = 4
"""Draws of ε per view."""
GROUPS = 2**17
"""Weights next to each other are summed up into at most so many numbers per view."""
PRIOR = 0.01
"""λ: information that is there before any view, over the candidates' mean."""


def information(dnr: DNR, views: ViewSet, seed: int) -> np.ndarray:
    """H of every view, weights in groups: float32 [N, G]. The model is left as it was, without gradients."""
    weights = [weight for weight in dnr.parameters() if weight.requires_grad]
    size = sum(weight.numel() for weight in weights)
    length = -(-size // GROUPS)
    found = np.zeros((len(views), -(-size // length)), np.float32)
    generator = torch.Generator().manual_seed(seed)
    for view in range(len(views)):
        pixels = dnr(views.batch([view])).rgb
        total = torch.zeros(found.shape[1] * length)
        for draw in range(PROBES):
            signs = torch.randint(0, 2, pixels.shape, generator=generator).to(pixels) * 2.0 - 1.0
            gradients = torch.autograd.grad((pixels * signs).sum(), weights, retain_graph=draw < PROBES - 1)
            total[:size] += torch.cat([gradient.reshape(-1).float().cpu().square() for gradient in gradients])
        found[view] = (total / PROBES).reshape(-1, length).sum(dim=1).numpy()
    return found


def choose_by_fisher(dnr: DNR, views: ViewSet, candidates: Candidates, budget: int, seed: int) -> Choice:
    """Greedy maximisation of the mean over groups g of log(1 + Σ_v∈S H_vg / λ)."""
    known = Candidates(candidates.positions, candidates.directions, candidates.sightings, information(dnr, views, seed))
    return choose_useful(known, budget, _choose)


def _choose(candidates: Candidates, budget: int) -> Choice:
    rows = candidates.facts
    assert rows is not None  # given above
    known = np.full(rows.shape[1], PRIOR * max(float(rows.mean()), 1e-20))

    def gain(view: int) -> float:
        return float(np.log1p(rows[view] / known).mean())

    def take(view: int) -> None:
        np.add(known, rows[view], out=known)

    views, gains = lazy_greedy(len(candidates), budget, gain, take)
    why, details = explained(
        candidates.sightings, views, [f"adds {value:.3f} nats per group of weights" for value in gains]
    )
    return Choice(views, gains, why, {"measure": "nats of Fisher information, mean over groups of weights", **details})

"""Disagreement of several small renderers, and surface that none of them has seen.

After density-aware NeRF ensembles (Sünderhauf, Abou-Chakra and Miller 2023, "Density-aware NeRF Ensembles: Quantifying
Predictive Uncertainty in Neural Radiance Fields"): the uncertainty of a ray is the members' variance of its colour plus
(1 − q)², where q is how sure they are that the ray ends at all. Here geometry is known, and what a renderer may lack is
a texture: q is 1 where a view that it was trained on sees the piece of surface, else 0.

    u(pixel) = mean over channels of Var over members of display RGB  +  (1 − q)²

They take the view of largest u. The first view of a batch is that one; for further ones, u of a piece of surface from
a direction that the batch has is divided by 1 + its views of it, so that a batch is not one view many times.
"""

from __future__ import annotations

import numpy as np
import torch

from dnrtrain.aggregator import Inside

from .pieces import Doubt, Observed, Pieces


class Spread(Observed):
    """Σ over the view's pieces of what is unsure there / (1 + the batch's views of it)."""

    def gain(self, pieces: Pieces) -> float:
        return float((pieces.unsure / (1.0 + self.observed[pieces.keys])).sum())


class Disagreement(Doubt):
    MEASURE = (
        "mean over the picture of the members' variance (display RGB) + 1 on unseen surface, less what its batch has"
    )
    WORD = "adds {:.2e} of disagreement and unseen surface"
    BATCH = Spread

    @torch.no_grad()
    def unsure(self, view: int) -> np.ndarray:
        batch = self.views.batch([view])
        pictures = torch.cat([member(batch).rgb.clamp(0.0, 1.0) for member in self.models])
        spread = pictures.var(dim=0, correction=0, keepdim=True).mean(dim=1, keepdim=True)
        varies = Inside(batch.mask).gather(spread)[:, 0].cpu().numpy().astype(np.float64)
        self.variance += float(varies.sum())
        return varies + self.unseen_pixels(view)

    def facts(self) -> dict[str, float]:
        count = max(1, self.pixels)
        return {"disagreement": float(np.sqrt(self.variance / count)), "unseen": self.unseen / count}

"""A learned variance beside the colour, and the views that would lower it most.

After ActiveNeRF (Pan, Lai, Song and Huang 2022, "ActiveNeRF: Learning where to See with Uncertainty Estimation"): the
network gives each colour a variance β², trained by the Gaussian's negative log-likelihood; a new view's observations
are combined with it by Bayes' rule, and those views are taken that lower the variance most.

    NLL(pixel) = ½ (log β² + |ĉ − c|² / β²),  |·|² the mean over display RGB

Here the variance is a small head on the finished coarse renderer: per pixel, from its neural texture, the harmonics of
the view direction and its colour. The renderer's own weights do not follow the NLL: a mean that does learns least where
it errs most (Seitzer et al. 2022).

A piece of surface from a direction starts at the mean β² of the candidates' pixels that show it. Observations are as
unsure as the prediction, so precisions add up to β² / (1 + s) after s usual views of it; and the expected reduction is
counted on the pixels of *all* candidates. Where no view of the training sees the surface the head knows nothing:
β² is UNKNOWN there.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from dnrtrain.aggregator import Inside
from dnrtrain.dataset import Batch, ViewSet
from dnrtrain.model import DNR, initialise
from dnrtrain.renderer import SLOPE
from dnrtrain.schedule import adam, guarded_step, learning_rate, require_target
from dnrtrain.textures import spherical_harmonics

from .pieces import COUNT, Doubt, Observed, Pieces

HIDDEN = 32
STEPS = 400
BATCH = 4096
"""Pixels per step."""
SAMPLE = 2**18
"""Pixels of the training views that the head is trained on, at most; evenly many of each view."""
RATE, RATE_END = 1e-2, 1e-3
LOWEST, HIGHEST = -14.0, 0.0
"""Of the log-variance: a standard deviation of 0.001 to 1 in display units."""
UNKNOWN = 1.0 / 12.0
"""Variance of a colour of which nothing is known: uniform on [0, 1]."""


class VarianceHead(nn.Module):
    """Log-variance of the colour of each pixel by itself, in [LOWEST, HIGHEST].

    mean, deviation: of its features, [C + 12]; it sees them standardised, for texels are small numbers at first.
    """

    def __init__(self, mean: Tensor, deviation: Tensor, seed: int) -> None:
        super().__init__()
        self.mean, self.deviation = mean, deviation
        with torch.random.fork_rng(devices=[]):  # as in DNR: the global generator is neither read nor changed
            self.layers = nn.Sequential(nn.Linear(len(mean), HIDDEN), nn.LeakyReLU(SLOPE), nn.Linear(HIDDEN, 1))
        initialise(self, torch.Generator().manual_seed(seed))

    def forward(self, features: Tensor) -> Tensor:
        """[P, C + 12] -> [P]."""
        raw = self.layers((features - self.mean) / self.deviation)[:, 0]
        return LOWEST + (HIGHEST - LOWEST) * torch.sigmoid(raw)


@torch.no_grad()
def features_of(dnr: DNR, batch: Batch) -> tuple[Tensor, Tensor]:
    """What the head sees of the pixels inside one view's mask, [P, C + 12], and their colour, display RGB [P, 3]."""
    output, inside = dnr(batch), Inside(batch.mask)
    rgb = inside.gather(output.rgb.clamp(0.0, 1.0))
    harmonics = spherical_harmonics(inside.gather(batch.view_dir))
    return torch.cat([inside.gather(output.texture), harmonics, rgb], dim=1), rgb


def train_head(dnr: DNR, views: ViewSet, seed: int) -> VarianceHead:
    """The head for a finished renderer, by the NLL on the targets of ``views``; pixels inside the masks only."""
    random = np.random.default_rng([seed, 0x56])
    features, errors = _sample(dnr, views, random)
    count, device = len(errors), str(errors.device)
    if not count:  # the views see nothing, and of what they do not see the head is not asked
        features = features.new_zeros(1, features.shape[1])
    head = VarianceHead(features.mean(dim=0), features.std(dim=0, correction=0).clamp_min(1e-4), seed).to(device)
    optimiser = adam([head], RATE, device)
    for step in range(STEPS if count else 0):
        some = torch.from_numpy(random.integers(count, size=min(BATCH, count))).to(device)
        log_variance = head(features[some])
        likelihood = 0.5 * (log_variance + errors[some] * torch.exp(-log_variance))
        guarded_step(optimiser, likelihood.mean(), learning_rate(step, STEPS, RATE, RATE_END))
    return head


def _sample(dnr: DNR, views: ViewSet, random: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Features of pixels of the views, [P, C + 12], and their mean squared errors [P]; P <= SAMPLE."""
    require_target(views, "the variance head")
    features, errors = [], []
    for view in range(len(views)):
        batch = views.batch([view])
        assert batch.target is not None  # required above
        seen, rgb = features_of(dnr, batch)
        error = (rgb - Inside(batch.mask).gather(batch.target)).square().mean(dim=1)
        some = torch.from_numpy(random.permutation(len(error))[: max(1, SAMPLE // len(views))]).to(error.device)
        features.append(seen[some])
        errors.append(error[some])
    return torch.cat(features), torch.cat(errors)


class Reduction(Observed):
    """Σ over pieces of the variance that all candidates have there · (1/(1 + s) − 1/(1 + s + the view's own))."""

    def __init__(self, table: list[Pieces]) -> None:
        super().__init__(table)
        self.variance = np.zeros(COUNT)
        for one in table:
            self.variance[one.keys] += one.unsure
        self.variance /= max(1e-12, sum(float(one.pixels.sum()) for one in table))

    def gain(self, pieces: Pieces) -> float:
        before = 1.0 + self.observed[pieces.keys]
        after = before + self.observations(pieces)
        return float((self.variance[pieces.keys] * (1.0 / before - 1.0 / after)).sum())


class PredictedVariance(Doubt):
    """Of one renderer and its head."""

    MEASURE = "expected decrease of the predicted variance of display RGB, mean over all surface pixels"
    WORD = "lowers the predicted variance by {:.2e}"
    BATCH, MODELS = Reduction, 1

    def __init__(self, models: list[DNR], views: ViewSet, kept: list[int], seed: int) -> None:
        super().__init__(models, views, kept, seed)
        self.head = train_head(models[0], views.subset(kept), seed)

    @torch.no_grad()
    def unsure(self, view: int) -> np.ndarray:
        features, _ = features_of(self.models[0], self.views.batch([view]))
        variance = self.head(features).exp().cpu().numpy().astype(np.float64)
        unseen = self.unseen_pixels(view)
        self.variance += float(variance[~unseen].sum())
        return np.where(unseen, UNKNOWN, variance)

    def facts(self) -> dict[str, float]:
        deviation = float(np.sqrt(self.variance / max(1, self.pixels - self.unseen)))
        return {"standard_deviation": deviation, "unseen": self.unseen / max(1, self.pixels)}

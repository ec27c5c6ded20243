"""PSNR by views, samples and training steps: what the network adds to its base image.

    gain(V, I) = G * max(0, 1 - a (25 / V)^alpha - b (500 / I)^beta)
    learned    = noise(S) * sqrt(min(1, kappa (25 / V)^delta (I / 500)^gamma))
    mse        = 10^(-(base + gain) / 10) + learned^2 + reference^2
    PSNR       = -10 log10(mse)

Notation
    V, S, I     views, samples per pixel, optimiser steps
    base        PSNR of the base image alone against the truth, dB; the pilot measures it
    G           dB that the network adds with many views and steps; the scene's own
    b           part of G that 500 steps still lack; the scene's own: some are learned in a hundred steps, some go on
    noise(S)    RMSE of a training picture in display space (`seconds.noise_at`)
    learned     RMSE of what the network takes of that noise for the truth: more, the longer it sees the fewer pictures
    reference   RMSE of the test views' references, likewise: what the report will measure counts it
    a, alpha, beta, kappa, gamma, delta   shared by all scenes: the prior, ``prior.json``, by
                ``python -m tools.plan_prior fit``

What is known of a scene's G and b is a density on a grid: normal in G and in log b as the prior's scenes are, times how
well each point explains the gains that the pilot measured after fewer and after more steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources

import numpy as np

from .records import Interval, Record

NINE_IN_TEN = 1.645
REACH, POINTS = 3.0, 41
"""The grid reaches so many standard deviations to both sides, by so many points."""
LEAST_MSE = 1e-6
"""60 dB: what is left of a picture's error where its noise explains all of it."""


class Prior(Record):
    """Shared parameters.

    b is the median over scenes, b_spread the standard deviation of its logarithm. gain_mean, gain_sd: of G. sd: of a
    prediction, by leaving scenes out, dB. scenes, source: where they come from.
    """

    a: float
    alpha: float
    b: float
    b_spread: float
    beta: float
    kappa: float
    gamma: float
    delta: float
    gain_mean: float
    gain_sd: float
    pilot_sd: float
    """dB: how far a gain of the pilot is off the scene's, by its standard deviation"""
    sd: float
    scenes: list[str]
    source: str


@dataclass(frozen=True)
class Measured:
    """A network of the pilot: so many dB over its base image after so many views and steps."""

    views: int
    steps: int
    gain: float


@dataclass(frozen=True)
class Gain:
    """Points of (G, b), [K] each, and their weights, which sum to 1."""

    total: np.ndarray
    missing: np.ndarray
    weight: np.ndarray

    def at(self, prior: Prior, views: float, steps: float) -> tuple[float, float]:
        """(expected gain, its standard deviation), dB."""
        gains = self.total * share(prior, self.missing, views, steps)
        mean = float(self.weight @ gains)
        return mean, math.sqrt(max(0.0, float(self.weight @ (gains - mean) ** 2)))

    @property
    def most(self) -> float:
        """Expected G, dB."""
        return float(self.weight @ self.total)


def load_prior() -> Prior:
    text = (resources.files("dnrpipe.studies.planning") / "prior.json").read_text(encoding="utf-8")
    return Prior.model_validate_json(text)


def share(prior: Prior, missing: np.ndarray | float, views: float, steps: float) -> np.ndarray:
    """Part of G that so many views and steps reach, for each b of ``missing``."""
    reached = 1 - prior.a * (25 / views) ** prior.alpha - np.asarray(missing) * (500 / steps) ** prior.beta
    return np.maximum(0.0, reached)


def scene_gain(prior: Prior, measured: Sequence[Measured]) -> Gain:
    """What is known of a scene's G and b after the pilot's networks; without any, the prior."""
    line = np.linspace(-REACH, REACH, POINTS)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    total, missing = prior.gain_mean + prior.gain_sd * u, prior.b * np.exp(prior.b_spread * v)
    logs = -(u**2 + v**2) / 2
    for one in measured:
        logs -= ((total * share(prior, missing, one.views, one.steps) - one.gain) / prior.pilot_sd) ** 2 / 2
    logs[total <= 0] = -np.inf  # a network that is trained to its end does no harm
    weight = np.exp(logs - logs.max())
    return Gain(total, missing, weight / weight.sum())


def learned_noise(prior: Prior, noise: float, views: float, steps: float) -> float:
    """RMSE that the noise of training pictures, ``noise``, leaves in what the network renders."""
    return noise * math.sqrt(min(1.0, prior.kappa * (25 / views) ** prior.delta * (steps / 500) ** prior.gamma))


def measured_gains(
    prior: Prior, base: float, views: int, noise: float, networks: Iterable[tuple[int, float]]
) -> list[Measured]:
    """What networks, (steps, PSNR), of pictures whose noise is ``noise`` would add to the base image without it."""
    return [
        Measured(views, steps, without_noise(psnr, learned_noise(prior, noise, views, steps)) - base)
        for steps, psnr in networks
    ]


def views_error(deviation: float, judged: int, tests: int) -> float:
    """dB: standard error of the mean PSNR over ``tests`` views when ``judged`` of them were looked at."""
    return deviation * math.sqrt(max(0.0, 1 / judged - 1 / max(tests, judged)))


def with_noise(psnr: float, noise: float) -> float:
    """PSNR, dB, of a picture once independent noise of RMSE ``noise`` is added to it, or to its reference."""
    return -10 * math.log10(10 ** (-psnr / 10) + noise**2)


def without_noise(psnr: float, noise: float) -> float:
    """The reverse; at most 60 dB, where the noise explains all of the error."""
    return -10 * math.log10(max(10 ** (-psnr / 10) - noise**2, LEAST_MSE))


@dataclass(frozen=True)
class Quality:
    """PSNR of any choice on a scene, dB.

    base: PSNR of the base image alone. judged: of `views_error`. reference: RMSE of the references.
    """

    prior: Prior
    base: float
    gain: Gain
    judged: float = 0.0
    reference: float = 0.0

    def predict(self, views: int, steps: int, noise: float) -> Interval:
        """What is expected of training on pictures whose RMSE is ``noise``."""
        added, unsure = self.gain.at(self.prior, views, steps)
        learned = learned_noise(self.prior, noise, views, steps)
        expected = with_noise(self.base + added, math.hypot(learned, self.reference))
        spread = NINE_IN_TEN * math.hypot(self.prior.sd, unsure, self.judged)
        return Interval(expected=expected, low=expected - spread, high=expected + spread)

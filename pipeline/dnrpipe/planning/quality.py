"""PSNR by views, samples and training steps: what the network adds to its base image.

    gain(V, I) = G * (1 - a (25 / V)^alpha - b (500 / I)^beta)
    mse        = 10^(-(base + gain) / 10) + kappa * noise(S)^2
    PSNR       = -10 log10(mse)

Notation
    V, S, I   views, samples per pixel, optimiser steps
    base      PSNR of the base image alone, dB; the pilot measures it
    G         dB that the network adds with many views and steps; the scene's own, from the pilot and the prior
    noise(S)  RMSE of a training picture in display space (:func:`.seconds.noise_at`)
    a, alpha, b, beta, kappa   shared by all scenes: the prior, ``prior.json``, by ``python -m tools.plan_prior fit``

A scene's G is the mean of two guesses, each weighted by the inverse of its variance: the pilot's own gain over what
the formula expects at the pilot's views and steps, and the mean of the prior's scenes.
"""

from __future__ import annotations

import json
import math
from importlib import resources

from .records import Interval, Record

NINE_IN_TEN = 1.645
LEAST_SHARE = 0.05


class Prior(Record):
    """Shared parameters; ``sd`` of a prediction by leaving scenes out, dB; where they come from."""

    a: float
    alpha: float
    b: float
    beta: float
    kappa: float
    gain_mean: float
    gain_sd: float
    pilot_sd: float
    """dB: how far the pilot's G is off the scene's, by its standard deviation"""
    sd: float
    scenes: list[str]
    source: str


def load_prior() -> Prior:
    """The prior that comes with the package."""
    text = (resources.files("dnrpipe.planning") / "prior.json").read_text(encoding="utf-8")
    return Prior.model_validate(json.loads(text))


def share(prior: Prior, views: float, steps: float) -> float:
    """Part of G that so many views and steps reach; may be negative: a network that has hardly begun does harm."""
    return 1 - prior.a * (25 / views) ** prior.alpha - prior.b * (500 / steps) ** prior.beta


def scene_gain(prior: Prior, measured: float, views: int, steps: int) -> tuple[float, float]:
    """(G, its standard deviation) of a scene whose pilot gained ``measured`` dB with so many views and steps."""
    part = max(share(prior, views, steps), LEAST_SHARE)
    own, own_variance = measured / part, (prior.pilot_sd / part) ** 2
    weight = prior.gain_sd**2 / (prior.gain_sd**2 + own_variance)
    gain = weight * own + (1 - weight) * prior.gain_mean
    return gain, math.sqrt(weight * own_variance)


def views_error(deviation: float, judged: int, tests: int) -> float:
    """dB: standard error of the mean PSNR over ``tests`` views when ``judged`` of them were looked at."""
    return deviation * math.sqrt(max(0.0, 1 / judged - 1 / max(tests, judged)))


def predict(
    prior: Prior, base: float, gain: tuple[float, float], views: int, steps: int, noise: float, judged: float = 0.0
) -> Interval:
    """PSNR, dB. gain: of :func:`scene_gain`. noise: RMSE of the training pictures. judged: of :func:`views_error`."""
    part = share(prior, views, steps)
    clean = 10 ** (-(base + gain[0] * part) / 10)
    expected = -10 * math.log10(clean + prior.kappa * noise**2)
    spread = NINE_IN_TEN * math.hypot(prior.sd, gain[1] * part, judged)
    return Interval(expected=expected, low=expected - spread, high=expected + spread)

"""How much light a shorter path misses, and what an effect changes, from noisy paired renders. numpy only.

Notation
    D        what the shorter path misses, image by image: deep - shallow with the same random numbers. Mitsuba's
             path tracer draws the same numbers up to the cut, so D >= 0 and has no noise but its own.
    blocks   BLOCK x BLOCK pixels averaged: a "pixel" of the tolerance; spatial averaging is worth BLOCK^2 samples
    halves   two independent sets of seeds: the worst blocks are chosen by one and measured by the other, so that
             noise does not choose itself (the maximum of noisy values is biased, their mean is not)
"""

from __future__ import annotations

import math

import numpy as np

from dnrtrain import srgb
from dnrtrain.settings import Strict

BLOCK = 4
WORST = 0.02
"""Share of the blocks around the 99th percentile: the worst 2% are those from the 98th on, their mean lies at about
the 99th."""
# Two-sided 95% quantiles of Student's t by degrees of freedom.
T95 = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23, 2.20, 2.18, 2.16, 2.14, 2.13)
REFERENCE_DEPTH = 64
"""Path vertices that count as all of the light."""


class Measured(Strict):
    """A mean over views and half the width of its 95% confidence interval."""

    mean: float
    half_width: float


class DepthStep(Strict):
    """What paths cut at ``depth`` leave out, as shares of the mean radiance (see `statistics`)."""

    depth: int
    mean: float
    mean_error: float
    pixel: float


def remaining(depth: int, missing: np.ndarray, whole: np.ndarray, cover: np.ndarray) -> DepthStep:
    """What paths cut at ``depth`` leave out.

    Args:
        missing: D, [V, 2, H, W, 3]: views, halves.
        whole: the deep renders, same shape, linear radiance, premultiplied.
        cover: alpha [V, 2, H, W].

    Returns the step: ``mean``: sum D / sum of the radiance; ``mean_error``: its standard error, from the
    difference of the halves; ``pixel``: mean of D over the worst blocks, relative to the block's own radiance or
    the mean radiance, whichever is larger.
    """
    level = float(whole.sum() / max(3 * cover.sum(), 1e-12))
    if level <= 0:
        return DepthStep(depth=depth, mean=0.0, mean_error=0.0, pixel=0.0)
    area = float(3 * cover.sum(axis=(2, 3)).mean())
    parts = missing.sum(axis=(2, 3, 4)) / (area * level)
    noise = float(np.sqrt(((parts[:, 0] - parts[:, 1]) ** 2).sum()) / (2 * len(parts)))
    light = np.maximum(_blocks(whole.mean(axis=1, keepdims=True)), level)
    ratio = (_blocks(missing) / light).mean(axis=-1)
    lit = _blocks(cover[..., None]).mean(axis=1)[..., 0].ravel() > 0
    first, second = (ratio[:, half].ravel()[lit] for half in range(2))
    pixel = 0.5 * (_worst(first, second) + _worst(second, first))
    return DepthStep(depth=depth, mean=float(parts.mean()), mean_error=noise, pixel=pixel)


def enough(step: DepthStep, tolerance: float, pixel_tolerance: float) -> bool:
    """Whether a step is within the tolerances, its noise included."""
    return step.mean + step.mean_error <= tolerance and step.pixel <= pixel_tolerance


def difference(with_effect: np.ndarray, without: np.ndarray) -> Measured:
    """RMSE between two renders in display space, free of the noise's own contribution.

    Args: display-space images over white, [V, 2, H, W, 3]: views, independent halves.
    The product of two independent estimates of a difference has the square of the difference as its mean.
    """
    delta = with_effect - without
    squares = (delta[:, 0] * delta[:, 1]).mean(axis=(1, 2, 3))
    roots = np.sqrt(np.maximum(squares, 0.0))
    return Measured(mean=float(np.sqrt(max(float(squares.mean()), 0.0))), half_width=_half_width(roots))


def significance(with_effect: np.ndarray, without: np.ndarray) -> float:
    """How surely two renders differ: sum of d1 d2 over its standard error where only noise differs.

    Same arguments as `difference`; d1, d2: differences of the two halves at a pixel, mean of the channels.
    With independent noise of variance s² the product has variance s⁴; d1 - d2 is free of the signal and has a fourth
    moment of 12 s⁴ (Gaussian; more with heavy tails, which errs on the safe side). Standard normal without effect.
    """
    delta = (with_effect - without).mean(axis=-1)
    first, second = delta[:, 0], delta[:, 1]
    error = math.sqrt(float(((first - second) ** 4).sum()) / 12)
    return float((first * second).sum()) / error if error > 0 else 0.0


def cost(seconds_with: np.ndarray, seconds_without: np.ndarray) -> Measured:
    """Share by which the effect lengthens a frame, from CPU seconds [V] of the same views in turn."""
    ratios = seconds_with / np.maximum(seconds_without, 1e-9) - 1
    return Measured(mean=float(np.median(ratios)), half_width=_half_width(ratios))


def display(rgba: np.ndarray) -> np.ndarray:
    """Premultiplied linear RGBA [..., 4] -> sRGB over white [..., 3] in [0, 1]."""
    alpha = np.clip(rgba[..., 3:], 0.0, 1.0)
    straight = np.where(alpha > 0, rgba[..., :3] / np.maximum(alpha, 1e-6), 0.0)
    return srgb.encode(np.clip(straight, 0.0, 1.0)) * alpha + 1.0 - alpha


def _half_width(values: np.ndarray) -> float:
    count = len(values)
    if count < 2:
        return 0.0
    quantile = T95[count - 2] if count - 2 < len(T95) else 1.96
    return float(quantile * values.std(ddof=1) / math.sqrt(count))


def _blocks(images: np.ndarray) -> np.ndarray:
    """[V, 2, H, W, C] -> means of BLOCK x BLOCK pixels [V, 2, H', W', C]; an incomplete rim is left out."""
    height, width = (size // BLOCK * BLOCK for size in images.shape[2:4])
    cut = images[:, :, :height, :width]
    shape = (*cut.shape[:2], height // BLOCK, BLOCK, width // BLOCK, BLOCK, cut.shape[-1])
    return cut.reshape(shape).mean(axis=(3, 5))


def _worst(chooser: np.ndarray, measured: np.ndarray) -> float:
    count = max(1, round(WORST * len(chooser)))
    return float(measured[np.argsort(chooser)[-count:]].mean()) if len(chooser) else 0.0

"""How noisy a path-traced picture is, from the picture's own samples, and how sure that is. numpy only.

Notation
    f        linear RGBA -> sRGB over white (`statistics.display`): where noise is measured
    X_k      means of G disjoint groups of samples, equally many in each, independent of each other; M their mean
    M_-k     the mean of all groups but the k-th
    v        jackknife estimate of Var f(M) at a pixel: (G-1)/G sum_k (f(M_-k) - mean_j f(M_-j))²
    b        jackknife estimate of E f(M) - f(E M), what the bent display curve makes of noise:
             (G-1) (mean_k f(M_-k) - f(M))
    noise    sqrt(mean of v + b² over the pixels) / rms of f(M): relative RMSE in display space

v is unbiased where f is linear over the noise (Efron and Stein, "The jackknife estimate of variance", Annals of
Statistics 9, 1981: never too small on average otherwise, for a mean of as many samples less one group). With two
groups it is ((f(A) - f(B)) / 2)², which is far too small where single samples decide a dark pixel: f is steep there,
so that a bright sample is worth less twice as bright.
Eight groups with b² see nearly all of it (tests/test_noise.py).

Its own uncertainty: v from the first half of the groups and v from the second are independent estimates of the same
thing, and pixels are independent (box filter, independent samples), so that sum_p (v1 - v2)²/4 is the variance of
sum_p (v1 + v2)/2. That holds for any distribution of the samples; light that no sample has found yet is in no estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dnrpipe.raytrace.statistics import display
from dnrtrain import srgb

GROUPS = 8


@dataclass(frozen=True)
class Noise:
    """relative: RMSE over the rms of the picture; error: standard error of ``relative``; rmse: in [0, 1] display."""

    relative: float
    error: float
    rmse: float


def group_noise(groups: np.ndarray) -> Noise:
    """Noise of the mean of independent groups of samples.

    groups: [G, H, W, 4] linear Rec.709, premultiplied; G even, at least 4, equally many samples each.
    Raises ValueError for other shapes.
    """
    if groups.ndim != 4 or groups.shape[0] < 4 or groups.shape[0] % 2 or groups.shape[-1] != 4:
        raise ValueError(f"groups: has shape {groups.shape}, expected [4 or more, even; H; W; 4]")
    half = len(groups) // 2
    squares = _squares(groups)
    # Half as many samples: twice the variance, twice the bias of the curve.
    first, second = (_squares(part, halved=2.0).mean(axis=-1) for part in (groups[:half], groups[half:]))
    spread = math.sqrt(float(((first - second) ** 2).sum()) / 4) / first.size
    return _noise(float(squares.mean()), spread, display(groups.mean(axis=0)))


def half_noise(half_a: np.ndarray, half_b: np.ndarray) -> Noise:
    """Noise of the mean of two independent, equally noisy halves [H, W, 4]; see `group_noise`, which is better.

    E[((A-B)/2)²] = Var[(A+B)/2], first order through the display curve. The standard error is an upper bound: from
    the second moment of the pixels' estimates, as nothing tells it from their variance.
    """
    a, b = display(half_a), display(half_b)
    squares = (((a - b) / 2) ** 2).mean(axis=-1)
    spread = math.sqrt(float((squares**2).sum())) / squares.size
    return _noise(float(squares.mean()), spread, (a + b) / 2)


def denoised_error(denoised: np.ndarray, others: np.ndarray) -> tuple[float, float]:
    """(mean square error of a denoised picture in display space, its standard error), without a reference.

    The denoiser's bias is in it. denoised: D, [H, W, 4], made from samples that are not in ``others`` [K, H, W, 4]:
    K >= 2 means X_i of independent samples as they were traced. For i != j, E (D - X_i)(D - X_j) = E (D - E X)²: noise
    of different groups cancels in the product. Weighted by the slope of the display curve at D (first order), 0 where
    it clips. The mean may come out below 0. The alpha of D, which no denoiser touches, counts as exact.
    """
    alpha = denoised[..., 3:]
    straight = np.where(alpha > 0, denoised[..., :3] / np.maximum(alpha, 1e-6), 2.0)
    curved = 1.055 / 2.4 * np.maximum(straight, 1e-6) ** (1 / 2.4 - 1)
    slope = np.where(straight <= srgb.LINEAR_END, 12.92, np.where(straight < 1, curved, 0.0))
    delta = (denoised - others)[..., :3] * slope
    count = len(others)
    products = (delta.sum(axis=0) ** 2 - (delta**2).sum(axis=0)) / (count * (count - 1))
    pixels = products.mean(axis=-1)
    return float(pixels.mean()), float(pixels.std(ddof=1) / math.sqrt(pixels.size))


def _squares(groups: np.ndarray, halved: float = 1.0) -> np.ndarray:
    """v + b², [H, W, 3], of the mean of ``halved`` times as many samples."""
    count = len(groups)
    total = groups.sum(axis=0)
    without = np.stack([display((total - group) / (count - 1)) for group in groups])
    centre = without.mean(axis=0)
    variance = (count - 1) / count * ((without - centre) ** 2).sum(axis=0)
    bias = (count - 1) * (centre - display(total / count))
    return variance / halved + (bias / halved) ** 2


def _noise(square: float, spread: float, shown: np.ndarray) -> Noise:
    """From the mean square, its standard error and the picture in display space; d sqrt(x) = dx / (2 sqrt(x))."""
    rmse, level = math.sqrt(square), float(np.sqrt(np.mean(shown**2)))
    scale = 1 / level if level > 0 else 0.0
    return Noise(rmse * scale, spread / (2 * rmse) * scale if rmse > 0 else 0.0, rmse)

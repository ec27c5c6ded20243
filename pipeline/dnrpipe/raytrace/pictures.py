"""What becomes of traced samples: non-finite pixels repaired, noise estimated, denoised where wanted."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from dnrtrain.contract import View

from .denoise import denoise
from .engine import Engine
from .noise import Noise, denoised_error, half_noise
from .tasks import NoiseFigures

REPAIR_ROUNDS = 3
AUXILIARY_SPP = 64


def repair(images: Sequence[np.ndarray], again: Callable[[int, int], np.ndarray]) -> tuple[int, int]:
    """Non-finite pixels are traced again with other seeds, in place; what stays is set to 0. (repaired, zeroed).

    images: each [H, W, C]. again(attempt, index of the image): the same picture with another seed.
    """
    repaired = masked = 0
    for index, image in enumerate(images):
        bad = ~np.isfinite(image).all(axis=-1)
        for attempt in range(REPAIR_ROUNDS):
            if not bad.any():
                break
            other = again(attempt, index)
            good = bad & np.isfinite(other).all(axis=-1)
            image[good] = other[good]
            repaired += int(good.sum())
            bad &= ~good
        image[bad] = 0.0
        masked += int(bad.sum())
    return repaired, masked


def finished(
    engine: Engine,
    bundle: Path,
    view: View,
    image: np.ndarray,
    halves: tuple[np.ndarray, np.ndarray] | None,
    raw: Noise | None,
    smooth: bool,
    groups: np.ndarray | None = None,
) -> tuple[dict[str, np.ndarray], NoiseFigures]:
    """(channels of the view's file, linear Rec.709, [H, W] each; its figures of noise).

    Args:
        engine, bundle: render the guides of the denoiser.
        view: in scene units.
        image: [H, W, 4], premultiplied.
        halves: two independent ones whose mean it is; None for a single sample.
        raw: the noise of ``image``; None for a single sample.
        smooth: R G B are denoised, and what was traced is in raw.R, raw.G, raw.B.
        groups: [G, H, W, 4], of which the even and the odd make the halves.

    ``noise``, ``noise_error``, ``noise_rmse`` (see `noise.Noise`) are of R G B, ``raw_noise``, ``raw_noise_error`` of
    what was traced; None where nothing is known. ``guides_masked``: pixels whose albedo and normal the denoiser had to
    do without. With groups also ``denoised_error``: relative RMSE of a denoised half against the truth, the denoiser's
    bias included, and ``denoiser_bias``: the part of it that is not noise; None where noise hides them (below two
    standard errors).
    """
    channels = {channel: image[..., i] for i, channel in enumerate("RGBA")}
    if not smooth:
        return channels, _figures(raw, raw)
    albedo, normal, guides_masked = engine.auxiliary(bundle, view, AUXILIARY_SPP)

    def clean(noisy: np.ndarray) -> np.ndarray:
        return denoise(noisy, albedo, normal, threads=1).astype(np.float64)  # one thread, so that bits repeat

    denoised = clean(image)
    channels |= {f"raw.{channel}": image[..., i] for i, channel in enumerate("RGB")}
    channels |= {channel: denoised[..., i] for i, channel in enumerate("RGB")}
    clean_halves = [clean(half) for half in halves] if halves is not None else []
    left = half_noise(*clean_halves) if clean_halves else None
    figures = _figures(left, raw)
    figures["guides_masked"] = guides_masked
    if left is not None and groups is not None:
        figures["denoised_error"], figures["denoiser_bias"] = _bias(clean_halves, groups, left)
    return channels, figures


def _figures(left: Noise | None, raw: Noise | None) -> NoiseFigures:
    return {
        "noise": left.relative if left else None,
        "noise_error": left.error if left else None,
        "noise_rmse": left.rmse if left else None,
        "raw_noise": raw.relative if raw else None,
        "raw_noise_error": raw.error if raw else None,
    }


def _bias(halves: Sequence[np.ndarray], groups: np.ndarray, left: Noise) -> tuple[float | None, float | None]:
    """(``denoised_error``, ``denoiser_bias``) of `finished`.

    halves: denoised, of the even and of the odd groups; left: their noise, as that of their mean.
    """
    found = [denoised_error(half, groups[1 - index :: 2]) for index, half in enumerate(halves)]
    square = float(np.mean([mean for mean, _ in found]))
    error = float(np.mean([error for _, error in found]))  # not divided by sqrt 2: the two share their samples
    scale = left.relative / left.rmse if left.rmse > 0 else 0.0
    bias = square - 2 * left.rmse**2  # half_noise: of the mean of two, hence 2 for one
    return (
        scale * math.sqrt(square) if square > 2 * error else None,
        scale * math.sqrt(bias) if bias > 2 * error else None,
    )

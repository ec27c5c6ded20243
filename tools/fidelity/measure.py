"""Two renderers' pictures -> numbers. Display-space metrics come from dnrtrain and NVIDIA's FLIP.

Notation
    A, B      the mean of two seeds of Cycles and of ours, linear premultiplied RGBA
    d(A)      display RGB over white (sRGB curve)
    noise     mean over pixels of (d(A1) - d(A2))^2 / 4 + the same for B: the expected squared difference of the means
              of two renderers that agree exactly (first order through the display curve)
All but FLIP count only pixels that either picture covers: an empty background agrees by nature.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from dnrpipe.core.images import flip_error
from dnrtrain.display import srgb_oetf
from dnrtrain.metrics import PSNR_CEILING, psnr_masked, ssim

EXACT_DB = 38.0
"""PSNR that a feature claimed exact must reach, unless noise alone keeps it below."""
BAKED_DB = 32.0
"""The same for a feature that is turned into an image: texels are finite."""
ENERGY = {"exact": 0.02, "baked": 0.03}
NOISE_SHARE = 1.5
"""Squared error up to this many times the expected noise counts as nothing but noise."""
ALPHA_FLOOR = 1e-6

Claim = Literal["exact", "baked", "approximated"]


@dataclass(frozen=True)
class Measured:
    """rmse: relative (linear radiance, noise taken off); psnr, floor: dB; energy: ours / Cycles."""

    rmse: float
    psnr: float
    floor: float
    flip: float
    ssim: float
    energy: float
    energy_error: float

    @property
    def only_noise(self) -> bool:
        """Whether noise alone explains the difference."""
        return self.psnr >= self.floor - 10 * math.log10(NOISE_SHARE)


def display(rgba: np.ndarray) -> np.ndarray:
    """Linear premultiplied RGBA [H, W, 4] -> sRGB over white [H, W, 3], as dnrtrain composes it."""
    alpha = np.clip(rgba[..., 3:], 0.0, 1.0)
    straight = rgba[..., :3] / np.maximum(alpha, ALPHA_FLOOR)
    return srgb_oetf(torch.from_numpy(np.ascontiguousarray(straight, np.float32))).numpy() * alpha + 1.0 - alpha


def compare(cycles: Sequence[np.ndarray], ours: Sequence[np.ndarray]) -> Measured:
    """Numbers of two pictures by each renderer, linear premultiplied RGBA [H, W, 4]."""
    a, b = mean(cycles), mean(ours)
    covered = np.maximum(a[..., 3], b[..., 3]) > 0
    if not covered.any():
        raise ValueError("both pictures are empty")
    shown_a, shown_b = display(a), display(b)
    spread = (_half_difference(cycles, display) ** 2 + _half_difference(ours, display) ** 2)[covered].mean()
    linear_noise = (_half_difference(cycles, _rgb) ** 2 + _half_difference(ours, _rgb) ** 2)[covered].mean()
    squared = ((a - b)[..., :3][covered] ** 2).mean()
    level = math.sqrt(float((a[..., :3][covered] ** 2).mean()))
    total_a, total_b = float(a[..., :3].sum()), float(b[..., :3].sum())
    deviations = [abs(float(p[0][..., :3].sum() - p[1][..., :3].sum())) / 2 for p in (cycles, ours)]
    return Measured(
        rmse=math.sqrt(max(0.0, float(squared - linear_noise))) / max(level, 1e-12),
        psnr=float(psnr_masked(_tensor(shown_b), _tensor(shown_a), torch.from_numpy(covered)[None, None].float())),
        floor=_decibel(float(spread)),
        flip=flip_error(shown_a.clip(0, 1), shown_b.clip(0, 1))[0],
        ssim=float(ssim(_tensor(shown_b), _tensor(shown_a))),
        energy=total_b / max(total_a, 1e-12),
        energy_error=math.hypot(*deviations) / max(total_a, 1e-12),
    )


def mean(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Mean of a renderer's seeds."""
    return np.mean(np.stack(pictures), axis=0)


def claim_of(findings: Sequence[dict[str, Any]]) -> Claim:
    """What the conversion itself claims: the weakest of its findings."""
    kinds = {finding["kind"] for finding in findings}
    if kinds & {"approximated", "ignored", "missing"}:
        return "approximated"
    return "baked" if "baked" in kinds else "exact"


def holds(claim: Claim, measured: Measured) -> bool | None:
    """Whether the pictures bear the claim out; None for an approximation, which claims nothing.

    The energy's own uncertainty (two seeds, twice their deviation) is allowed for.
    """
    if claim == "approximated":
        return None
    wanted = EXACT_DB if claim == "exact" else BAKED_DB
    energy = abs(measured.energy - 1) <= ENERGY[claim] + 2 * measured.energy_error
    return energy and (measured.psnr >= wanted or measured.only_noise)


def _half_difference(pictures: Sequence[np.ndarray], view: Any) -> np.ndarray:
    return (view(pictures[0]) - view(pictures[1])) / 2


def _rgb(rgba: np.ndarray) -> np.ndarray:
    return rgba[..., :3]


def _tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1), np.float32))[None]


def _decibel(mse: float) -> float:
    return min(PSNR_CEILING, -10 * math.log10(max(mse, 1e-12)))

"""Pictures of frames beside references that are path-traced for them.

Notation
    A_i     pictures that are path-traced and denoised, each with random numbers of its own; k of them, two or more
    truth   their mean
    noise   mean square error of the truth by how far the A_i differ: their variance / k. What the A_i have in common,
            the denoiser's bias, does not show in it
    error   mean square difference between a picture and the truth, less the noise, which adds to it

Two pictures of 32 samples tell PSNR within 0.05 dB and LPIPS within 0.003 of what one of 256 does (`interior`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.images import over_white, read_rgba
from ...core.scene_files import read_frame
from ..stage import Run

if TYPE_CHECKING:
    from dnrtrain.display import DisplayTransform

SEED = 1 << 16
"""Above the seeds of frames."""
SPP, FEWEST = 32, 2
"""Samples of an A_i, and k, where nothing asks for more."""
LEAST_ERROR = 1e-8


@dataclass(frozen=True)
class Truth:
    """picture: the mean of the A_i, display RGB over white, torch [1, 3, H, W]. noise: its mean square error."""

    picture: Any
    noise: float

    @classmethod
    def of(cls, pictures: Sequence[Any]) -> Truth:
        """By two or more A_i."""
        mean: Any = sum(pictures) / len(pictures)
        spread = float(np.mean([float((picture - mean).square().mean()) for picture in pictures]))
        return cls(mean, spread / (len(pictures) - 1))

    def error(self, picture: Any) -> float:
        """Of a picture, its noise taken off."""
        return max(float((picture - self.picture).square().mean()) - self.noise, LEAST_ERROR)


def decibels(error: float) -> float:
    """PSNR of a mean square error."""
    return -10 * math.log10(error)


def compared(picture: Any, truth: Any, lpips: Any) -> dict[str, float]:
    """psnr (dB), ssim and, where the pictures are large enough for it, lpips of display pictures [1, 3, H, W]."""
    import torch

    from dnrtrain.metrics import image_metrics

    everywhere = torch.ones_like(truth[:, :1])
    found = image_metrics(picture, truth, everywhere, None if lpips is None else {"alex": lpips})
    named = {"psnr": found["psnr"], "ssim": found["ssim"], "lpips": found["lpips_alex"]}
    return {name: value for name, value in named.items() if value is not None}


def display_of(run: Run) -> DisplayTransform:
    """The scene's display transform. Raises DamagedFile."""
    from dnrtrain.display import DisplayTransform

    return DisplayTransform(read_frame(run.workspace), run.workspace.scene)


def shown(display: DisplayTransform, path: Path) -> Any:
    """A frame's file as display RGB over white, torch [1, 3, H, W]. Raises DamagedFile."""
    return over_white(display, read_rgba(path)).clamp(0, 1)

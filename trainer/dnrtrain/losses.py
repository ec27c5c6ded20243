"""The six losses of step 2 (paper, training section and implementation details).

    L = λ_DNRf·photometric + λ_SSIM·(1 − SSIM) + λ_p·L_p + λ_FR·L_FR + λ_TV·L_TV + λ_reg·L_reg

All act on display RGB over white, float32. Each is finite, with finite gradients, on flat and tiny images.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .graphs import Graph
from .metrics import ssim
from .model import Output
from .perceptual import PerceptualLoss
from .precision import at_least_float32
from .settings import Step2Settings

OF_PICTURES = ("photometric", "ssim", "perceptual", "frequency", "total_variation")
"""The terms that see pictures alone."""


def photometric(prediction: Tensor, target: Tensor, kind: str) -> Tensor:
    """Mean absolute ("l1") or mean squared ("mse") difference."""
    return F.l1_loss(prediction, target) if kind == "l1" else F.mse_loss(prediction, target)


def structural(prediction: Tensor, target: Tensor) -> Tensor:
    """1 − SSIM, mean over the batch."""
    return 1.0 - ssim(prediction, target).mean()


def frequency(prediction: Tensor, target: Tensor, norm: str) -> Tensor:
    """L_FR: mean |Re ΔF| + |Im ΔF| over the half spectrum of the real FFT.

    The FFT is linear, so F(Î) − F(I) = F(Î − I). The L1 norm is taken of real and imaginary parts, not of
    the complex modulus: the modulus has no gradient at 0, where a good prediction lives. Always float32:
    half-precision transforms give NaN and want powers of two.

    norm: of the transform: "backward", plain sums over the H·W pixels, or "ortho", those over √(H·W).
    """
    spectrum = torch.fft.rfft2(at_least_float32(prediction - target), norm=norm)
    return torch.view_as_real(spectrum).abs().sum(dim=-1).mean()


def total_variation(prediction: Tensor) -> Tensor:
    """L_TV: mean absolute difference of neighbours, horizontally plus vertically (anisotropic)."""
    total = prediction.sum() * 0.0
    for axis in (-2, -1):
        if prediction.shape[axis] > 1:
            total = total + prediction.diff(dim=axis).abs().mean()
    return total


def texture_regularisation(texture: Tensor) -> Tensor:
    """L_reg(T) = mean T²: keeps the spatial neural texture small."""
    # Channels last, as it lies in memory: the mean's gradient takes its input's order of dimensions.
    return texture.permute(0, 2, 3, 1).square().mean()


def random_crop(prediction: Tensor, target: Tensor, side: int, random: np.random.Generator) -> tuple[Tensor, Tensor]:
    """The same random ``side``×``side`` window of both images; 0, or larger than the image: all of it.

    VGG is the dearest part of a step and its features are local: a window per step is an estimate of L_p
    at a fraction of the cost. Its centre lies anywhere in the image with equal chance, and beyond the border the
    images go on mirrored: so every pixel is as often in it as any other. Windows that stay inside would show the
    middle of the image more often than its border.
    """
    if side == 0:
        return prediction, target
    for axis in (-2, -1):
        length = prediction.shape[axis]
        if side < length:
            start = int(np.floor(random.uniform(0.0, length) - 0.5 * side + 0.5))
            places = np.arange(start, start + side)
            places = np.where(places < 0, -1 - places, np.where(places >= length, 2 * length - 1 - places, places))
            index = torch.from_numpy(places).to(prediction.device)
            prediction, target = prediction.index_select(axis, index), target.index_select(axis, index)
    return prediction, target


class Step2Loss:
    """Weighted sum of the six terms; a term of weight 0 is not computed.

    Args:
        perceptual: None drops L_p (weights missing).
    """

    def __init__(self, settings: Step2Settings, perceptual: PerceptualLoss | None) -> None:
        self.settings = settings
        self.perceptual = perceptual
        self.graph: Graph | None = None

    def record(self) -> None:
        """Use CUDA graphs where they pay (see `dnrtrain.graphs`), until `forget`: each loss is back-propagated before
        the next one."""
        self.graph = Graph(self.perceptual or nn.Module(), self._of_pictures)

    def forget(self) -> None:
        """Let the graphs' memory go."""
        self.graph = None

    def __call__(
        self, output: Output, target: Tensor, random: np.random.Generator, *, bfloat16: bool
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """-> (total, unweighted terms by name).

        ``random`` places the crop of L_p; ``bfloat16`` concerns VGG's convolutions only.
        """
        weights, rgb = self.settings.loss, output.rgb
        missing = "perceptual" if self.perceptual is None else None
        names = tuple(name for name in OF_PICTURES if getattr(weights, name) and name != missing)
        pictures = [rgb, target]
        if "perceptual" in names:
            pictures += random_crop(rgb, target, self.settings.perceptual_crop, random)
        of_pictures = self.graph if self.graph is not None and names else self._of_pictures
        terms = dict(zip(names, of_pictures(*pictures, names=names, bfloat16=bfloat16).unbind(), strict=True))
        if weights.regularisation and output.texture is not None:
            terms["regularisation"] = texture_regularisation(output.texture)
        total = rgb.sum() * 0.0
        for name, value in terms.items():
            total = total + getattr(weights, name) * value
        return total, terms

    def _of_pictures(
        self, rgb: Tensor, target: Tensor, *window: Tensor, names: tuple[str, ...], bfloat16: bool
    ) -> Tensor:
        """The named terms [len(names)]. window: of both pictures, for L_p."""
        terms = [self._term(name, rgb, target, *window, bfloat16=bfloat16) for name in names]
        return torch.stack(terms) if terms else rgb.new_zeros(0)

    def _term(self, name: str, rgb: Tensor, target: Tensor, *window: Tensor, bfloat16: bool) -> Tensor:
        if name == "photometric":
            return photometric(rgb, target, self.settings.photometric)
        if name == "ssim":
            return structural(rgb, target)
        if name == "frequency":
            return frequency(rgb, target, self.settings.frequency_norm)
        if name == "total_variation":
            return total_variation(rgb)
        assert self.perceptual is not None
        return self.perceptual(*window, bfloat16=bfloat16)

"""VGG16 and AlexNet feature extractors: the perceptual loss L_p and LPIPS v0.1.

Both networks are the convolutions of torchvision's ImageNet classifiers (Simonyan and Zisserman 2015;
Krizhevsky 2014), defined here: torchvision is no dependency. Weights come from `dnrtrain.weights`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .precision import at_least_float32

Network = Literal["vgg", "alex"]

LAYOUT: dict[str, list[tuple[int, int, int, int]]] = {
    "vgg": [(channels, 3, 1, 1) for channels in (64, 64, 128, 128, *[256] * 3, *[512] * 6)],
    "alex": [(64, 11, 4, 2), (192, 5, 1, 2), (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)],
}
"""Channels, kernel, stride and padding of each convolution."""
POOLED = {"vgg": (2, 4, 7, 10), "alex": (1, 2)}
"""Convolutions that max-pooling comes before."""
TAPS = {"vgg": (1, 3, 6, 9, 12), "alex": (0, 1, 2, 3, 4)}
"""Convolutions whose ReLU output LPIPS compares (VGG: relu1_2, 2_2, 3_3, 4_3, 5_3)."""
POOL = {"vgg": 2, "alex": 3}  # window; the stride is 2 in both
STRIDES = {"vgg": (1, 2, 4, 8, 16), "alex": (4, 8, 16, 16, 16)}
"""Input pixels from one pixel of a tap to the next."""
REACH = 128
"""No tap sees further than this from its place (98 pixels at most); a multiple of all strides."""
AT_ONCE = 1 << 20
"""Pixels whose features are held at one time where no gradient is wanted."""
MINIMUM_SIDE = {"vgg": 16, "alex": 31}
"""Smallest image side for which the last tap still has a pixel."""

# LPIPS' scaling layer for inputs in [-1, 1]: ImageNet's mean and deviation, rounded as published.
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)


class Features(nn.Module):
    """Frozen convolutions of one network; ReLU outputs at the first ``taps`` tap points."""

    shift: Tensor
    scale: Tensor

    def __init__(self, network: Network, weights: Mapping[str, Tensor], taps: int = 5) -> None:
        super().__init__()
        self.network = network
        self.taps = TAPS[network][:taps]
        self.register_buffer("shift", torch.tensor(SHIFT).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(SCALE).view(1, 3, 1, 1))
        self.convolutions = nn.ModuleList()
        inputs = 3
        for index, (channels, kernel, stride, padding) in enumerate(LAYOUT[network][: self.taps[-1] + 1]):
            layer = nn.Conv2d(inputs, channels, kernel, stride, padding)
            layer.load_state_dict({"weight": weights[f"conv.{index}.weight"], "bias": weights[f"conv.{index}.bias"]})
            self.convolutions.append(layer)
            inputs = channels
        self.narrow: list[tuple[Tensor, Tensor]] = []
        self.requires_grad_(False)
        self.eval()
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, image: Tensor, *, bfloat16: bool = False) -> list[Tensor]:
        """Display RGB in [0, 1], [N, 3, H, W] -> ReLU features per tap (float32 or bfloat16)."""
        x = ((2.0 * at_least_float32(image) - 1.0) - self.shift) / self.scale
        x = x.contiguous(memory_format=torch.channels_last)
        x = x.bfloat16() if bfloat16 else x
        found: list[Tensor] = []
        for index, (weight, bias) in enumerate(self._weights(x.device, bfloat16=bfloat16)):
            if index in POOLED[self.network]:
                x = F.max_pool2d(x, POOL[self.network], 2)
            _, _, stride, padding = LAYOUT[self.network][index]
            x = F.relu(F.conv2d(x, weight, bias, stride=stride, padding=padding))
            if index in self.taps:
                found.append(x)
        return found

    def _weights(self, device: torch.device, *, bfloat16: bool) -> list[tuple[Tensor, Tensor]]:
        """Weight and bias of each convolution.

        The bfloat16 ones are rounded once: autocast would round frozen weights anew in every call, a seventh of
        its time on 64x64 windows.
        """
        layers = [(layer.weight, layer.bias) for layer in self.convolutions]
        if not bfloat16:
            return layers  # pyright: ignore[reportReturnType]
        if not self.narrow or self.narrow[0][0].device != device:
            self.narrow = [(weight.bfloat16(), bias.bfloat16()) for weight, bias in layers]
        return self.narrow


class Lpips(nn.Module):
    """LPIPS v0.1 (Zhang et al. 2018): weighted distance of unit-normalised features.

    Without gradients, pictures larger than ``AT_ONCE`` are looked at in bands that overlap by what a tap can see: the
    same value in bounded memory.

    Inputs in [0, 1] (converted to [-1, 1] here). The epsilon of the norm stands inside the square root:
    outside, its gradient at an all-zero feature is NaN.
    """

    def __init__(self, network: Network, weights: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.minimum_side = MINIMUM_SIDE[network]
        self.strides = STRIDES[network]
        self.features = Features(network, weights)
        for index in range(len(TAPS[network])):
            self.register_buffer(f"head{index}", weights[f"head.{index}"].clone())

    def forward(self, prediction: Tensor, target: Tensor) -> Tensor:
        """[N, 3, H, W] twice -> distance [N]. Raises ValueError for images below ``minimum_side``."""
        if min(prediction.shape[-2:]) < self.minimum_side:
            raise ValueError(f"LPIPS needs images of at least {self.minimum_side} pixels a side")
        height, width = prediction.shape[-2:]
        rows = max(REACH, AT_ONCE // width // REACH * REACH)
        if height <= rows + REACH or (torch.is_grad_enabled() and (prediction.requires_grad or target.requires_grad)):
            return sum((part.mean(dim=(1, 2)) for part in self._maps(prediction, target)), prediction.new_zeros(1))
        sums, counts = [prediction.new_zeros(prediction.shape[0]) for _ in self.strides], [0] * len(self.strides)
        for start in range(0, height, rows):
            first, end = max(0, start - REACH), start + rows
            band = slice(first, end + REACH)
            parts = self._maps(prediction[..., band, :], target[..., band, :])
            for index, (part, stride) in enumerate(zip(parts, self.strides, strict=True)):
                own = part[:, (start - first) // stride : None if end >= height else (end - first) // stride]
                sums[index] = sums[index] + own.sum(dim=(1, 2))
                counts[index] += own.shape[1] * own.shape[2]
        return sum((total / count for total, count in zip(sums, counts, strict=True)), prediction.new_zeros(1))

    def _maps(self, prediction: Tensor, target: Tensor) -> Iterator[Tensor]:
        """[N, 3, H, W] twice -> per tap the weighted distance at each of its pixels, [N, h, w]."""
        pairs = zip(self.features(prediction), self.features(target), strict=True)
        for index, (a, b) in enumerate(pairs):
            difference = (_unit(a) - _unit(b)).square()
            yield (difference * getattr(self, f"head{index}")).sum(dim=1)


class PerceptualLoss(nn.Module):
    """L_p(Î, I) = Σ_j w_j · mean |φ_j(Î) − φ_j(I)| with VGG16 features (paper, training section).

    The norm is the mean absolute difference.

    Args:
        weights: of VGG16.
        taps: w_j, from relu1_2 on.
    """

    def __init__(self, weights: Mapping[str, Tensor], taps: Sequence[float]) -> None:
        super().__init__()
        self.features = Features("vgg", weights, taps=len(taps))
        self.taps = tuple(taps)

    def forward(self, prediction: Tensor, target: Tensor, *, bfloat16: bool = False) -> Tensor:
        """[N, 3, H, W] twice -> scalar. Gradients flow to ``prediction`` only."""
        least, side = 1 << (len(self.taps) - 1), min(prediction.shape[-2:])
        if side < least:  # a pooling lies between two taps
            factor = -(-least // side)
            prediction = F.interpolate(prediction, scale_factor=factor, mode="nearest")
            target = F.interpolate(target, scale_factor=factor, mode="nearest")
        with torch.no_grad():
            wanted = self.features(target, bfloat16=bfloat16)
        found = self.features(prediction, bfloat16=bfloat16)
        # The mean's gradient is laid out in the order of its input's dimensions. With channels last as they lie in
        # memory, the whole backward pass stays in one layout.
        parts = [
            weight * at_least_float32((a - b).abs()).permute(0, 2, 3, 1).mean()
            for weight, a, b in zip(self.taps, found, wanted, strict=True)
        ]
        return torch.stack(parts).sum()


def _unit(feature: Tensor) -> Tensor:
    return feature / torch.sqrt(feature.square().sum(dim=1, keepdim=True) + 1e-20)


def weight_shapes(network: str) -> dict[str, tuple[int, ...]]:
    """Of all tensors of a network in `dnrtrain.weights`, by name."""
    shapes: dict[str, tuple[int, ...]] = {}
    inputs = 3
    for index, (channels, kernel, _, _) in enumerate(LAYOUT[network]):
        shapes |= {f"conv.{index}.weight": (channels, inputs, kernel, kernel), f"conv.{index}.bias": (channels,)}
        inputs = channels
    return shapes | {f"head.{j}": (1, LAYOUT[network][tap][0], 1, 1) for j, tap in enumerate(TAPS[network])}


def random_weights(network: str) -> dict[str, Tensor]:
    """Of the right shapes and sizes, always the same: for timings and tests, which need no trained network."""
    generator = torch.Generator().manual_seed(0)
    weights: dict[str, Tensor] = {}
    for name, shape in weight_shapes(network).items():
        if name.endswith("weight"):
            weights[name] = (2.0 / math.prod(shape[1:])) ** 0.5 * torch.randn(shape, generator=generator)
        else:
            weights[name] = torch.zeros(shape) if name.endswith("bias") else torch.rand(shape, generator=generator)
    return weights


def build_lpips(weights: Mapping[str, Mapping[str, Tensor]]) -> dict[str, Lpips]:
    """LPIPS with both networks from what `dnrtrain.weights.load_weights` returns."""
    return {"alex": Lpips("alex", weights["alex"]), "vgg": Lpips("vgg", weights["vgg"])}

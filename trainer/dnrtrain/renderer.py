"""The U-Net-like renderer R: neural texture on screen -> RGB.

After DNR (section 4.2), without what public re-implementations add and what hurts: no normalisation
layer (it erases absolute colour), no tanh. The output is linear in display space and unbounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .correction import output_channels
from .precision import at_least_float32
from .settings import ModelSettings

SLOPE = 0.2
MAX_CHANNELS = 512
DETAIL = 16
"""Full-resolution features per pixel beside the half-resolution U-Net."""


class Block(nn.Module):
    """Two 3×3 convolutions with LeakyReLU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = F.leaky_relu(self.first(x), SLOPE)
        return F.leaky_relu(self.second(x), SLOPE)


class UNet(nn.Module):
    """``depth`` halvings, skip connections.

    Level i has width · 2^i channels (at most MAX_CHANNELS). Going up, channels are reduced *before* the
    nearest-neighbour enlargement: four times fewer operations than after it.
    """

    def __init__(self, inputs: int, width: int, depth: int, outputs: int = 3) -> None:
        super().__init__()
        channels = [min(width << level, MAX_CHANNELS) for level in range(depth + 1)]
        self.depth = depth
        self.stem = Block(inputs, channels[0])
        self.down = nn.ModuleList(nn.Conv2d(channels[i], channels[i + 1], 3, stride=2, padding=1) for i in range(depth))
        self.inner = nn.ModuleList(nn.Conv2d(channels[i + 1], channels[i + 1], 3, padding=1) for i in range(depth))
        self.reduce = nn.ModuleList(nn.Conv2d(channels[i + 1], channels[i], 1) for i in range(depth))
        self.merge = nn.ModuleList(Block(2 * channels[i], channels[i]) for i in range(depth))
        self.head = nn.Conv2d(channels[0], outputs, 1)
        self.alignment = 1 << depth

    def reach(self, radius: int = 0) -> int:
        """How far the inputs lie, in pixels, that decide the outputs up to ``radius`` pixels beyond a tile whose sides
        are multiples of ``alignment``."""
        wanted = [radius + 2]  # of each level's concatenated maps, by the two convolutions that merge them
        for level in range(1, self.depth + 1):
            wanted.append(-(-wanted[-1] // 2) + (2 if level < self.depth else 0))
        far = wanted.pop()
        for near in reversed(wanted):
            far = max(near, 2 * (far + 1) + 1)  # one convolution within the level, one with stride 2 to it
        return far + 2

    def forward(self, groups: Sequence[Tensor], *, bfloat16: bool) -> Tensor:
        """[N, inputs, H, W] per group -> [N, outputs, H, W] float32; any H and W (padded, cropped back)."""
        x = torch.cat(list(groups), dim=1)
        height, width = x.shape[-2:]
        x = pad_to_multiple(x, self.alignment).contiguous(memory_format=torch.channels_last)
        with torch.autocast(x.device.type, dtype=torch.bfloat16, enabled=bfloat16):
            x = self.features(x)
        # bfloat16 would quantise the result to 1/256: the last layer is float32.
        return self.head(at_least_float32(x))[..., :height, :width]

    def features(self, x: Tensor) -> Tensor:
        """[N, inputs, H, W] -> [N, width, H, W]; H and W are multiples of 2^depth."""
        x = self.stem(x)
        skips: list[Tensor] = []
        for down, inner in zip(self.down, self.inner, strict=True):
            skips.append(x)
            x = F.leaky_relu(down(x), SLOPE)
            x = F.leaky_relu(inner(x), SLOPE)
        for level in reversed(range(self.depth)):
            x = F.interpolate(self.reduce[level](x), scale_factor=2.0, mode="nearest")
            x = self.merge[level](torch.cat([x, skips[level]], dim=1))
        return x


class HalfUNet(nn.Module):
    """A U-Net at half resolution between per-pixel layers at full resolution.

    Each pixel's inputs become DETAIL features; the U-Net sees four pixels' features as one (a strided convolution)
    and answers with DETAIL features for each of the four (pixel-shuffle); the last layers see both, and those of the
    pixel's neighbours. So the four times cheaper U-Net carries context, and what changes from pixel to pixel (texture,
    edges, grain) passes by its side.

    The inputs come in groups: one wide map of them all would have to be put together and turned around in memory,
    which costs as much as the layer that reads it.
    """

    def __init__(self, groups: Sequence[int], width: int, depth: int, outputs: int) -> None:
        super().__init__()
        self.depth = depth
        self.point = nn.ModuleList(nn.Conv2d(inputs, DETAIL, 1, bias=i == 0) for i, inputs in enumerate(groups))
        self.gather = nn.Conv2d(DETAIL, width, 2, stride=2)
        self.unet = UNet(width, width, depth, outputs=4 * DETAIL)
        self.mix = nn.Conv2d(2 * DETAIL, DETAIL, 3, padding=1)
        self.head = nn.Conv2d(DETAIL, outputs, 1)
        self.alignment = 2 << depth

    def reach(self, radius: int = 0) -> int:
        """As of `UNet`."""
        return 2 * self.unet.reach(-(-(radius + 1) // 2))

    def forward(self, groups: Sequence[Tensor], *, bfloat16: bool) -> Tensor:
        """[N, inputs, H, W] per group -> [N, outputs, H, W] float32; any H and W (padded, cropped back)."""
        first = groups[0]
        height, width = first.shape[-2:]
        with torch.autocast(first.device.type, dtype=torch.bfloat16, enabled=bfloat16):
            detail = self.point[0](first)
            for layer, maps in zip(self.point[1:], groups[1:], strict=True):
                assert isinstance(layer, nn.Conv2d)
                detail = add_pointwise(detail, layer, maps)
            detail = pad_to_multiple(F.leaky_relu(detail, SLOPE), self.alignment)
            context = self.unet.head(self.unet.features(F.leaky_relu(self.gather(detail), SLOPE)))
            x = torch.cat([detail, F.pixel_shuffle(context, 2)], dim=1)
            x = F.leaky_relu(self.mix(x), SLOPE)
        return planes(self.head, at_least_float32(x))[..., :height, :width]


class PixelMLP(nn.Module):
    """Every pixel by itself: three hidden layers of 4 width channels. The U-Net's rival at equal cost."""

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        hidden = 4 * width
        self.layers = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in pairwise([inputs, hidden, hidden, hidden]))
        self.head = nn.Conv2d(hidden, outputs, 1)
        self.alignment = 1

    def reach(self, radius: int = 0) -> int:
        """As of `UNet`."""
        return radius

    def forward(self, groups: Sequence[Tensor], *, bfloat16: bool) -> Tensor:
        """[N, inputs, H, W] per group -> [N, outputs, H, W] float32."""
        x = torch.cat(list(groups), dim=1).contiguous(memory_format=torch.channels_last)
        with torch.autocast(x.device.type, dtype=torch.bfloat16, enabled=bfloat16):
            for layer in self.layers:
                x = F.leaky_relu(layer(x), SLOPE)
        return self.head(at_least_float32(x))


def add_pointwise(total: Tensor, layer: nn.Conv2d, maps: Tensor) -> Tensor:
    """``total + layer(maps)`` for a 1×1 convolution without bias; ``total`` and the result in channels-last memory.

    As a product of matrices it reads the maps as they lie, plane by plane: a convolution turns them around first,
    which takes three times as long as its arithmetic.
    """
    if torch.jit.is_tracing():  # other runtimes have no channels-last memory
        return total + layer(maps)
    count, channels, height, width = total.shape
    weights = layer.weight.flatten(1).t().expand(count, -1, -1)
    rows = total.permute(0, 2, 3, 1).reshape(count, height * width, channels)
    rows = torch.baddbmm(rows, maps.flatten(2).transpose(1, 2), weights)
    return rows.view(count, height, width, channels).permute(0, 3, 1, 2)


def planes(layer: nn.Conv2d, x: Tensor) -> Tensor:
    """``layer(x)`` for a 1×1 convolution of channels-last ``x``, channel by channel in memory: they part ways now."""
    if torch.jit.is_tracing():
        return layer(x)
    assert layer.bias is not None
    count, channels, height, width = x.shape
    rows = x.permute(0, 2, 3, 1).reshape(count, height * width, channels)
    weights = layer.weight.flatten(1).expand(count, -1, -1)
    return torch.baddbmm(layer.bias[:, None], weights, rows.transpose(1, 2)).view(count, -1, height, width)


def pad_to_multiple(x: Tensor, multiple: int) -> Tensor:
    """Replicate the right and bottom border until both sides are multiples."""
    right, bottom = -x.shape[-1] % multiple, -x.shape[-2] % multiple
    # An exported graph takes pictures of any size: how much is missing is part of it.
    missing = torch.jit.is_tracing() or right or bottom
    return F.pad(x, (0, right, 0, bottom), mode="replicate") if missing else x


def build_renderer(groups: Sequence[int], settings: ModelSettings) -> UNet | HalfUNet | PixelMLP:
    """The network that ``settings.network`` and ``settings.stride`` name, for inputs in groups of so many channels."""
    outputs = output_channels(settings)
    if settings.network == "mlp":
        return PixelMLP(sum(groups), settings.width, outputs)
    if settings.stride == 2:
        return HalfUNet(groups, settings.width, settings.depth, outputs)
    return UNet(sum(groups), settings.width, settings.depth, outputs)

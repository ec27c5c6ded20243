"""The U-Net-like renderer R: neural texture on screen -> RGB.

After DNR (section 4.2), without what public re-implementations add and what hurts: no normalisation
layer (it erases absolute colour), no tanh. The output is linear in display space and unbounded.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SLOPE = 0.2
MAX_CHANNELS = 512


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
    """``depth`` halvings, skip connections, 3 outputs.

    Level i has width · 2^i channels (at most MAX_CHANNELS). Going up, channels are reduced *before* the
    nearest-neighbour enlargement: four times fewer operations than after it.
    """

    def __init__(self, inputs: int, width: int, depth: int) -> None:
        super().__init__()
        channels = [min(width << level, MAX_CHANNELS) for level in range(depth + 1)]
        self.depth = depth
        self.stem = Block(inputs, channels[0])
        self.down = nn.ModuleList(nn.Conv2d(channels[i], channels[i + 1], 3, stride=2, padding=1) for i in range(depth))
        self.inner = nn.ModuleList(nn.Conv2d(channels[i + 1], channels[i + 1], 3, padding=1) for i in range(depth))
        self.reduce = nn.ModuleList(nn.Conv2d(channels[i + 1], channels[i], 1) for i in range(depth))
        self.merge = nn.ModuleList(Block(2 * channels[i], channels[i]) for i in range(depth))
        self.head = nn.Conv2d(channels[0], 3, 1)

    def forward(self, x: Tensor, *, bfloat16: bool) -> Tensor:
        """[N, inputs, H, W] -> [N, 3, H, W] float32; any H and W (padded by replication, cropped back)."""
        height, width = x.shape[-2:]
        multiple = 1 << self.depth
        right, bottom = -width % multiple, -height % multiple
        if right or bottom:
            x = F.pad(x, (0, right, 0, bottom), mode="replicate")
        x = x.contiguous(memory_format=torch.channels_last)
        with torch.autocast(x.device.type, dtype=torch.bfloat16, enabled=bfloat16):
            x = self.stem(x)
            skips: list[Tensor] = []
            for down, inner in zip(self.down, self.inner, strict=True):
                skips.append(x)
                x = F.leaky_relu(down(x), SLOPE)
                x = F.leaky_relu(inner(x), SLOPE)
            for level in reversed(range(self.depth)):
                x = F.interpolate(self.reduce[level](x), scale_factor=2.0, mode="nearest")
                x = self.merge[level](torch.cat([x, skips[level]], dim=1))
        # bfloat16 would quantise the result to 1/256: the last layer is float32.
        return self.head(x.float())[..., :height, :width]

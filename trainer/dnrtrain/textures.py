"""Neural texture pyramids and hierarchical sampling π; spherical harmonics of the view direction.

DNR (Thies et al. 2019, section 4.1): a neural texture is a pyramid of learnable texels; a sample is the
*sum* of one bilinear look-up per level. DNRSelect uses π on UV, normal and depth maps alike.
All of this runs in float32 and only at the pixels inside the mask: P points instead of N·H·W pixels.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

INITIAL_SCALE = 0.1
SH_FIRST_CHANNEL = 3
"""Zero-based. DNR multiplies the harmonics on channels 4 to 12 (one-based)."""
SH_COUNT = 9


class TexturePyramid(nn.Module):
    """``levels`` textures of ``size``, ``size / 2``, … texels per side, sampled bilinearly and summed.

    Texel centres lie at half integers (align_corners=False); beyond the outermost centres the border
    texel continues. Texels start as seeded uniform noise in ±INITIAL_SCALE / levels.

    Args:
        size: texels per side of the finest level.
        dimensions: 2 (UV, octahedral normals) or 1 (depth).
    """

    def __init__(self, size: int, levels: int, channels: int, *, dimensions: int, generator: torch.Generator) -> None:
        super().__init__()
        bound = INITIAL_SCALE / levels
        self.levels = nn.ParameterList()
        for level in range(levels):
            side = max(1, size >> level)
            texels = torch.empty(1, channels, side if dimensions == 2 else 1, side)
            self.levels.append(nn.Parameter(texels.uniform_(-bound, bound, generator=generator)))

    def forward(self, points: Tensor) -> Tensor:
        """Coordinates [P, 2] in [-1, 1] (1-D textures read x only, y = 0) -> features [P, C]."""
        grid = points[None, None]
        total: Tensor | None = None
        for texels in self.levels:
            sample = F.grid_sample(texels, grid, mode="bilinear", padding_mode="border", align_corners=False)
            total = sample if total is None else total + sample
        assert total is not None
        return total[0, :, 0].t()


def octahedral(normal: Tensor) -> Tensor:
    """Unit vectors [P, 3] -> [-1, 1]² [P, 2] (octahedral map; Cigolle et al. 2014, section 3.2).

    z >= 0 fills the inner diamond, z < 0 is folded into the corners. Zero vectors map to (0, 0).
    """
    p = normal[:, :2] / normal.abs().sum(dim=1, keepdim=True).clamp_min(1e-12)
    sign = torch.where(p >= 0, 1.0, -1.0)
    return torch.where(normal[:, 2:3] < 0, (1.0 - p.abs().flip(1)) * sign, p)


def depth_coordinate(depth: Tensor) -> Tensor:
    """Normalised depth [P, 1] in [0, 1] -> coordinates [P, 2] of a 1-D texture."""
    x = 2.0 * depth - 1.0
    return torch.cat([x, torch.zeros_like(x)], dim=1)


def spherical_harmonics(direction: Tensor) -> Tensor:
    """Real orthonormal spherical harmonics, bands 0 to 2, of unit vectors [N, 3, H, W] -> [N, 9, H, W].

    Order (l, m): 00, 1−1, 10, 11, 2−2, 2−1, 20, 21, 22 (Ramamoorthi and Hanrahan 2001, equation 3).
    """
    x, y, z = direction.unbind(1)
    c0 = 0.5 / math.sqrt(math.pi)
    c1 = math.sqrt(3.0) * c0
    c2 = math.sqrt(15.0) * c0
    return torch.stack(
        [
            torch.full_like(x, c0),
            c1 * y,
            c1 * z,
            c1 * x,
            c2 * x * y,
            c2 * y * z,
            0.5 * math.sqrt(5.0) * c0 * (3.0 * z * z - 1.0),
            c2 * x * z,
            0.5 * c2 * (x * x - y * y),
        ],
        dim=1,
    )


def apply_harmonics(texture: Tensor, direction: Tensor) -> Tensor:
    """Multiply channels 4 to 12 (one-based) of ``texture`` [N, C, H, W] by the nine harmonics."""
    # One product in the texture's own memory layout: backward, a concatenation of channel ranges takes eight times
    # as long.
    factors = torch.ones_like(texture)
    factors[:, SH_FIRST_CHANNEL : SH_FIRST_CHANNEL + SH_COUNT] = spherical_harmonics(direction)
    return texture * factors

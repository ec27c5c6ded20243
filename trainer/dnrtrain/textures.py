"""Neural texture pyramids and hierarchical sampling π; spherical harmonics of the view direction.

DNR (Thies et al. 2019, section 4.1): a neural texture is a pyramid of learnable texels; a sample is the
*sum* of one bilinear look-up per level. DNRSelect uses π on UV, normal and depth maps alike.
All of this runs in float32 and only at the pixels inside the mask: P points instead of N·H·W pixels.
"""

from __future__ import annotations

import functools
import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

INITIAL_SCALE = 0.1
MERGED_SIZE = 512
"""Most texels per side of a pyramid that is merged for inference: four times its memory, 67 MB at 16 channels."""
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
        self.mergeable = size <= MERGED_SIZE and size % (1 << (levels - 1)) == 0
        self._merged: tuple[object, Tensor] | None = None

    def forward(self, points: Tensor) -> Tensor:
        """Coordinates [P, 2] in [-1, 1] (1-D textures read x only, y = 0) -> features [P, C].

        In evaluation mode and without gradients the levels are merged into one texture (see `merged`): the same
        sum, up to rounding.
        """
        if self.training or torch.is_grad_enabled() or not self.mergeable:
            return self._summed(points)
        table, width, height = self.merged()
        x, right = _split(points[:, 0], width)
        y, lower = _split(points[:, 1], height)
        first = y * width + x
        corner = right * lower
        taps = torch.stack([first, first + 1, first + width, first + width + 1]).t().contiguous()
        shares = torch.stack([1.0 - right - lower + corner, right - corner, lower - corner, corner]).t().contiguous()
        return F.embedding_bag(taps, table, per_sample_weights=shares, mode="sum")

    def train(self, mode: bool = True) -> TexturePyramid:
        self._merged = None
        return super().train(mode)

    def _summed(self, points: Tensor) -> Tensor:
        return self.look_up(points[None, None])[0, :, 0].t()

    def look_up(self, grid: Tensor) -> Tensor:
        """Coordinates [1, H, W, 2] in [-1, 1] -> the sum of all levels, [1, C, H, W]."""
        return functools.reduce(
            torch.add,
            (F.grid_sample(t, grid, mode="bilinear", padding_mode="border", align_corners=False) for t in self.levels),
        )

    def merged(self) -> tuple[Tensor, int, int]:
        """All levels as one texture: its texels row by row [height · width, C], width and height.

        Between the texel centres of all levels the sum is bilinear. Where each level has exactly half the texels of
        the one before, all centres and borders are multiples of half a texel of the finest level: its values there
        say everything. Kept until a level changes. (Torch's fused optimisers change texels unnoticed: in training mode
        nothing is merged, and leaving it starts anew.)
        """
        state = tuple((texels.data_ptr(), texels._version) for texels in self.levels)
        height, width = (2 * side + 1 for side in self.levels[0].shape[-2:])
        if self._merged is None or self._merged[0] != state:
            like = self.levels[0]
            y, x = (torch.linspace(-1.0, 1.0, n, dtype=like.dtype, device=like.device) for n in (height, width))
            knots = torch.stack([x.repeat(height), y.repeat_interleave(width)], dim=1)
            self._merged = (state, self._summed(knots).detach().contiguous())
        return self._merged[1], width, height


def _split(coordinate: Tensor, knots: int) -> tuple[Tensor, Tensor]:
    """Coordinates [P] in [-1, 1] -> the knot before (int32) and the way from there to the next, in [0, 1]."""
    position = (coordinate.clamp(-1.0, 1.0) + 1.0) * (0.5 * (knots - 1))
    before = position.int().clamp_(max=knots - 2)
    return before, position - before


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
    """Real orthonormal spherical harmonics, bands 0 to 2, of unit vectors [N, 3, ...] -> [N, 9, ...].

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
    """Multiply channels 4 to 12 (one-based) of ``texture`` by the nine harmonics of ``direction``.

    [N, C, H, W] and [N, 3, H, W], or points: [P, C] and [P, 3].
    """
    # One product in the texture's own memory layout: backward, a concatenation of channel ranges takes eight times
    # as long.
    factors = torch.ones_like(texture)
    factors[:, SH_FIRST_CHANNEL : SH_FIRST_CHANNEL + SH_COUNT] = spherical_harmonics(direction)
    return texture * factors

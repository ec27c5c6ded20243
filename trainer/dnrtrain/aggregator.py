"""The 3D texture aggregator: depth, normal and UV maps -> spatial neural texture T.

Paper, section III-D: ``{Tex_D, Tex_N, Tex_U} = {π(D), π(N), π(U)}``, concatenated and fused by a CNN.
The strategies that the paper compares are here side by side:

    concat     T = CNN([Tex_D, Tex_N, Tex_U])                       the paper's
    residual   T = Tex_U + CNN([Tex_D, Tex_N, Tex_U])               the CNN starts at zero (ours)
    early      T = CNN([D D D, N, U V mask]), no neural texture     the paper's "vanilla" 9-channel strategy

With one modality (``uv``) there is nothing to fuse: T = Tex_U, which is DNR itself. For ``early`` the
channels of absent modalities are left out.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .contract import ContractError
from .dataset import Batch
from .precision import at_least_float32
from .renderer import SLOPE
from .settings import ModelSettings
from .textures import TexturePyramid, apply_harmonics, depth_coordinate, octahedral

GEOMETRY_TEXELS = 128
"""Most texels per side of the normal and depth textures: their domains are smooth, small and shared by
the whole scene, so more texels than this would only be seen by single pixels."""


class FusionCNN(nn.Module):
    """1×1 convolution (computed at inside pixels only) -> LeakyReLU -> 3×3 convolution, zero outside."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.point = nn.Linear(inputs, 2 * channels)
        self.conv = nn.Conv2d(2 * channels, channels, 3, padding=1)
        self.activation = nn.LeakyReLU(SLOPE)

    def forward(self, features: Tensor, inside: Inside) -> Tensor:
        """[P, inputs] -> [N, channels, H, W] float32, 0 outside the mask."""
        hidden = inside.scatter(self.activation(self.point(features)))
        return at_least_float32(self.conv(hidden)) * inside.mask


class Inside:
    """The pixels inside the mask, as a flat list: gather maps to points and scatter points to maps."""

    def __init__(self, mask: Tensor) -> None:
        self.mask = mask
        self.index = mask.permute(0, 2, 3, 1).reshape(-1).nonzero()[:, 0]

    def gather(self, image: Tensor) -> Tensor:
        """[N, C, H, W] -> [P, C]."""
        # Along channels, not pixels: selecting short rows is thirty times slower.
        return image.transpose(0, 1).reshape(image.shape[1], -1).index_select(1, self.index).t()

    def scatter(self, points: Tensor) -> Tensor:
        """[P, C] -> [N, C, H, W] in channels-last memory, 0 outside."""
        count, _, height, width = self.mask.shape
        flat = points.new_zeros(count * height * width, points.shape[1])
        flat[self.index] = points  # forward and backward several times faster than index_copy
        return flat.view(count, height, width, -1).permute(0, 3, 1, 2)


class Aggregator(nn.Module):
    """See the module's docstring. ``generator`` seeds the texels; the CNN is initialised by the model."""

    def __init__(self, settings: ModelSettings, generator: torch.Generator) -> None:
        super().__init__()
        self.strategy = settings.aggregator
        self.modalities = settings.modalities.split("+")
        channels = settings.texture_channels
        self.channels = channels
        self.harmonics = settings.spherical_harmonics
        if self.strategy == "early":
            inputs = {"uv": 3, "depth": 3, "normal": 3}
            self.fusion: FusionCNN | None = FusionCNN(sum(inputs[m] for m in self.modalities), channels)
            return

        def pyramid(size: int, dimensions: int) -> TexturePyramid:
            return TexturePyramid(size, settings.texture_levels, channels, dimensions=dimensions, generator=generator)

        small = min(settings.texture_size, GEOMETRY_TEXELS)
        self.texture_uv = pyramid(settings.texture_size, 2)
        if "depth" in self.modalities:
            self.texture_depth = pyramid(small, 1)
        if "normal" in self.modalities:
            self.texture_normal = pyramid(small, 2)
        fused = len(self.modalities) > 1
        self.fusion = FusionCNN(len(self.modalities) * channels, channels) if fused else None

    def surface_texels(self) -> list[nn.Parameter]:
        """Of the UV texture, finest level first; none where there is no texture."""
        return [] if self.strategy == "early" else list(self.texture_uv.levels)

    def zero_residual(self) -> None:
        """Start the residual strategy at T = Tex_U (called after the weights are initialised)."""
        if self.strategy == "residual" and self.fusion is not None:
            nn.init.zeros_(self.fusion.conv.weight)
            assert self.fusion.conv.bias is not None
            nn.init.zeros_(self.fusion.conv.bias)

    def forward(self, batch: Batch, *, bfloat16: bool) -> tuple[Tensor, Tensor]:
        """-> T and what the renderer sees of it, T with the harmonics of the view direction if wanted.

        [N, C, H, W] float32 each, 0 outside the mask. Only the fusion's convolutions may be bfloat16.
        """
        inside = Inside(batch.mask)
        if inside.index.numel() == 0:
            texture = batch.mask.new_zeros(batch.mask.shape[0], self.channels, *batch.mask.shape[-2:])
            return texture, texture
        if self.fusion is None and self.harmonics:
            (features,) = self._sampled(batch, inside)
            seen = apply_harmonics(features, inside.gather(batch.view_dir))
            return inside.scatter(features), inside.scatter(seen)
        texture = self._fused(batch, inside, bfloat16)
        return texture, apply_harmonics(texture, batch.view_dir) if self.harmonics else texture

    def _fused(self, batch: Batch, inside: Inside, bfloat16: bool) -> Tensor:
        features = self._raw(batch, inside) if self.strategy == "early" else self._sampled(batch, inside)
        if self.fusion is None:
            return inside.scatter(features[0])
        device = batch.mask.device.type
        with torch.autocast(device, dtype=torch.bfloat16, enabled=bfloat16):
            fused = self.fusion(torch.cat(features, dim=1), inside)
        return inside.scatter(features[-1]) + fused if self.strategy == "residual" else fused

    def at_chain(self, batch: Batch) -> Tensor:
        """The UV texture at the end of the specular path, times its throughput: [N, C, H, W], 0 where there is none.

        The same texels as at the first hit: what a mirror shows is what the mirrored surface's own views taught.
        Raises ContractError when the views were loaded without base files.
        """
        if batch.chain_uv is None or batch.chain_mask is None or batch.chain_weight is None:
            raise ContractError("this model follows specular paths, but the views were loaded without base files")
        inside = Inside(batch.chain_mask)
        if inside.index.numel() == 0:
            return batch.mask.new_zeros(batch.mask.shape[0], self.channels, *batch.mask.shape[-2:])
        sampled = self.texture_uv(inside.gather(batch.chain_uv))
        return inside.scatter(sampled * inside.gather(batch.chain_weight))

    def _raw(self, batch: Batch, inside: Inside) -> list[Tensor]:
        parts: list[Tensor] = []
        if "depth" in self.modalities:
            parts.append(inside.gather(batch.depth).expand(-1, 3))
        if "normal" in self.modalities:
            parts.append(inside.gather(batch.normal))
        uv = inside.gather(batch.uv)
        return [*parts, uv, torch.ones_like(uv[:, :1])]

    def _sampled(self, batch: Batch, inside: Inside) -> list[Tensor]:
        """Tex_D, Tex_N, Tex_U as [P, C] each, in that order, absent modalities left out."""
        parts: list[Tensor] = []
        if "depth" in self.modalities:
            parts.append(self.texture_depth(depth_coordinate(inside.gather(batch.depth))))
        if "normal" in self.modalities:
            parts.append(self.texture_normal(octahedral(inside.gather(batch.normal))))
        return [*parts, self.texture_uv(inside.gather(batch.uv))]

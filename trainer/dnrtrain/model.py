"""The deferred neural renderer: aggregator + renderer + composition over white."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .aggregator import Aggregator
from .dataset import Batch, ViewSet
from .renderer import SLOPE, UNet
from .settings import ModelSettings
from .textures import apply_harmonics


@dataclass(frozen=True)
class Output:
    """rgb [N, 3, H, W]: display space over white, unbounded; texture: T [N, C, H, W], 0 outside the mask."""

    rgb: Tensor
    texture: Tensor


class DNR(nn.Module):
    """Deferred neural renderer (paper section III; Thies et al. 2019).

    The U-Net sees T (with the harmonics of the per-pixel view direction on channels 4 to 12) and the mask.
    Composition is exact: out = coverage · rgb + (1 − coverage) · 1, so that no capacity is spent on the
    background and silhouettes are anti-aliased by geometry. Measured (analytic scene, 25 views, 128², 400
    steps, L1): 27.6 dB with it, 26.0 dB without (inside the mask 24.3 and 23.9).

    Args:
        seed: fixes all initial weights; no global random state is read or changed.
    """

    def __init__(self, settings: ModelSettings, seed: int) -> None:
        super().__init__()
        self.settings = settings
        self.use_bfloat16 = False
        generator = torch.Generator().manual_seed(seed)
        # Module constructors fill weights from the global generator; they are all overwritten below.
        with torch.random.fork_rng(devices=[]):
            self.aggregator = Aggregator(settings, generator)
            self.renderer = UNet(settings.texture_channels + 1, settings.width, settings.depth)
        initialise(self, generator)
        self.aggregator.zero_residual()
        nn.init.constant_(_bias(self.renderer.head), 0.5)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, batch: Batch) -> Output:
        texture = self.aggregator(batch, bfloat16=self.use_bfloat16)
        seen = texture
        if self.settings.spherical_harmonics:
            seen = apply_harmonics(texture, batch.view_dir)
        rgb = self.renderer(torch.cat([seen, batch.mask], dim=1), bfloat16=self.use_bfloat16)
        return Output(compose(rgb, batch.coverage), texture)


def compose(rgb: Tensor, coverage: Tensor) -> Tensor:
    """Composite display RGB [N, 3, H, W] over white by the geometric coverage [N, 1, H, W]."""
    return coverage * rgb + (1.0 - coverage)


def initialise(module: nn.Module, generator: torch.Generator) -> None:
    """Kaiming-normal weights for LeakyReLU and zero biases for all convolutions and linear layers."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.kaiming_normal_(layer.weight, a=SLOPE, generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def _bias(layer: nn.Conv2d) -> Tensor:
    assert layer.bias is not None
    return layer.bias


@torch.no_grad()
def render_views(model: DNR, views: ViewSet, *, batch: int = 1) -> Tensor:
    """Render all views: display RGB over white in [0, 1], float32 [N, 3, H, W] on the CPU."""
    device = next(model.parameters()).device
    frames: list[Tensor] = []
    for start in range(0, len(views), batch):
        part = views.batch(list(range(start, min(start + batch, len(views))))).to(device)
        frames.append(model(part).rgb.clamp(0.0, 1.0).cpu())
    return torch.cat(frames)

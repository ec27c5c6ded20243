"""The deferred neural renderer: aggregator + renderer + composition over white."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .aggregator import Aggregator
from .correction import correct, guide_channels, guide_maps, require_base, uncorrected
from .dataset import Batch, ViewSet
from .graphs import Graph
from .renderer import SLOPE, build_renderer
from .settings import ModelSettings
from .tiles import tiles

TILE_PIXELS = 1 << 20
"""Most that the network works on at once."""


@dataclass(frozen=True)
class Output:
    """What the model makes of a batch.

    rgb       [N, 3, H, W] display space over white, unbounded
    texture   T [N, C, H, W], 0 outside the mask; None where the model has none
    radiance  [N, 3, H, W] linear Rec.709, straight, >= 0; only where the model's output is "log", else None
    """

    rgb: Tensor
    texture: Tensor | None
    radiance: Tensor | None = None


class DNR(nn.Module):
    """Deferred neural renderer (paper section III; Thies et al. 2019).

    The U-Net sees T (with the harmonics of the per-pixel view direction on channels 4 to 12) and the mask.
    Composition is exact: out = coverage · rgb + (1 − coverage) · 1, so that no capacity is spent on the
    background and silhouettes are anti-aliased by geometry. Measured (analytic scene, 25 views, 128², 400
    steps, L1): 27.6 dB with it, 26.0 dB without (inside the mask 24.3 and 23.9).

    With a base image the network corrects it (see `dnrtrain.correction`). Its last layer starts at zero:
    training starts at the base image itself. Without a neural texture it is a corrector: nothing in it is of a scene.

    Args:
        seed: fixes all initial weights; no global random state is read or changed.
    """

    def __init__(self, settings: ModelSettings, seed: int) -> None:
        super().__init__()
        self.settings = settings
        self.use_bfloat16 = False
        self.graph: Graph | None = None
        generator = torch.Generator().manual_seed(seed)
        # Module constructors fill weights from the global generator; they are all overwritten below.
        with torch.random.fork_rng(devices=[]):
            groups = [1 + guide_channels(settings)]
            if settings.aggregator != "none":
                self.aggregator = Aggregator(settings, generator)
                groups += [settings.texture_channels] * (2 if settings.chain else 1)
            self.renderer = build_renderer(groups, settings)
        initialise(self, generator)
        if settings.aggregator != "none":
            self.aggregator.zero_residual()
        if settings.base == "none":
            assert self.renderer.head.bias is not None
            nn.init.constant_(self.renderer.head.bias, 0.5)
        else:
            nn.init.zeros_(self.renderer.head.weight)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @property
    def reach(self) -> int:
        """How far beyond a tile of the picture (see `dnrtrain.tiles`) lies what decides it, in pixels."""
        fused = self.settings.aggregator != "none" and self.aggregator.fusion is not None
        return self.renderer.reach(self.settings.filter // 2) + fused

    def forward(self, batch: Batch) -> Output:
        settings = self.settings
        groups = [torch.cat([batch.mask, *guide_maps(batch, settings)], dim=1)]
        texture = None
        if settings.aggregator != "none":
            texture, seen = self.aggregator(batch, bfloat16=self.use_bfloat16)
            groups.append(seen)
        if settings.chain:
            groups.append(self.aggregator.at_chain(batch))
        outputs = (self.graph or self._render)(*groups, bfloat16=self.use_bfloat16)
        if settings.base == "none":
            return Output(compose(outputs, batch.coverage), texture)
        rgb, radiance = correct(batch, outputs, settings)
        return Output(compose(rgb, batch.coverage), texture, radiance)

    def uncorrected(self, batch: Batch) -> Output:
        """What `forward` gives where none of the correction is applied, without the network's time."""
        rgb, radiance = uncorrected(batch, self.settings)
        return Output(compose(rgb, batch.coverage), None, radiance)

    def record(self) -> None:
        """Train with CUDA graphs where they pay (see `dnrtrain.graphs`), until `forget`: each forward pass needs its
        backward pass before the next one."""
        self.graph = Graph(self.renderer, self._render)

    def forget(self) -> None:
        """Let the graphs' memory go."""
        self.graph = None

    def _render(self, *groups: Tensor, bfloat16: bool) -> Tensor:
        return self.renderer(groups, bfloat16=bfloat16)


def compose(rgb: Tensor, coverage: Tensor) -> Tensor:
    """Composite display RGB [N, 3, H, W] over white by the geometric coverage [N, 1, H, W]."""
    return torch.lerp(torch.ones_like(coverage), rgb, coverage)


def base_picture(batch: Batch) -> Tensor:
    """The base image itself as display RGB over white, [N, 3, H, W], composed as the network's output is.

    Raises ContractError when the views were loaded without.
    """
    base, display = require_base(batch)
    return compose(display(base), batch.coverage)


def initialise(module: nn.Module, generator: torch.Generator) -> None:
    """Kaiming-normal weights for LeakyReLU and zero biases for all convolutions and linear layers."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.kaiming_normal_(layer.weight, a=SLOPE, generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


@torch.no_grad()
def render_views(model: DNR, views: ViewSet, *, batch: int = 1) -> Tensor:
    """Render all views: display RGB over white in [0, 1], float32 [N, 3, H, W] on the CPU."""
    return render(model, views, batch=batch).rgb


@torch.no_grad()
def render(model: DNR, views: ViewSet, *, batch: int = 1) -> Output:
    """Render all views, large ones in tiles: rgb in [0, 1], and radiance where the model has it, on the CPU.

    The pictures of tiles are those of the whole bit for bit where convolutions of other sizes round alike, as oneDNN's
    do; else as close as rounding. texture is None. Where ``settings.trust`` is 0, no network runs.
    """
    idle = model.settings.base != "none" and model.settings.trust == 0
    draw = model.uncorrected if idle else model
    device = next(model.parameters()).device
    height, width = views.size
    rgb = torch.empty(len(views), 3, height, width)
    radiance = torch.empty_like(rgb) if model.settings.output == "log" else None
    plan = tiles(height, width, alignment=model.renderer.alignment, reach=model.reach, pixels=TILE_PIXELS)
    for start in range(0, len(views), batch):
        part = slice(start, min(start + batch, len(views)))
        maps = views.batch(range(part.start, part.stop))
        for tile in plan:
            output = draw(maps.window(tile.seen_rows, tile.seen_columns).to(device))
            rgb[part, :, tile.rows, tile.columns] = output.rgb[(..., *tile.inner)].clamp(0.0, 1.0)
            if radiance is not None and output.radiance is not None:
                radiance[part, :, tile.rows, tile.columns] = output.radiance[(..., *tile.inner)]
    return Output(rgb, None, radiance)

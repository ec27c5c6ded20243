"""The action-value network Q(s, ·) of the view selector (paper section III-C and figure 3)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..model import initialise
from ..renderer import SLOPE

OBSERVATION_SIDE = 64
"""T is averaged down to at most this many pixels a side before the CNN."""


class QNetwork(nn.Module):
    """State (views selected so far, neural texture) -> one value per candidate view.

    s_cam: mean of the learnable embeddings of the selected views.
    s_obs: CNN on T, averaged over the screen, a hidden vector. T is *detached*: the agent's loss must not
    push gradients into the DNR, its environment, which would let it raise its reward by changing the
    world instead of by choosing views (and would disturb the renderer in training).
    """

    def __init__(self, views: int, channels: int, embedding: int, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            self.camera = nn.Parameter(torch.empty(views, embedding))
            self.observe = nn.ModuleList(
                nn.Conv2d(channels if i == 0 else embedding, embedding, 3, stride=2, padding=1) for i in range(3)
            )
            self.hidden = nn.Linear(2 * embedding, embedding)
            self.value = nn.Linear(embedding, views)
        initialise(self, generator)
        nn.init.normal_(self.camera, std=1.0, generator=generator)
        # Values start at 0: early maxima then come from rewards, not from the initialisation.
        nn.init.zeros_(self.value.weight)

    def encode(self, texture: Tensor) -> Tensor:
        """T [1, C, H, W] -> detached observation [1, C, h, w], float32, at most 64 pixels a side."""
        side = (min(texture.shape[-2], OBSERVATION_SIDE), min(texture.shape[-1], OBSERVATION_SIDE))
        return F.adaptive_avg_pool2d(texture.detach().float(), side).contiguous()

    def forward(self, selected: Tensor, observation: Tensor) -> Tensor:
        """selected: bool [N] (at least one); observation from `encode` -> values [N]."""
        weights = selected.float() / selected.sum()
        x = observation
        for layer in self.observe:
            x = F.leaky_relu(layer(x), SLOPE)
        state = torch.cat([weights @ self.camera, x.mean(dim=(0, 2, 3))])
        return self.value(F.leaky_relu(self.hidden(state), SLOPE))

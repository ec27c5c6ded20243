"""Fisher information of a renderer's weights, and the views that it asks for."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from conftest import Scene
from dnrtrain.model import DNR
from dnrtrain.selector import fisher
from dnrtrain.selector.fisher import choose_by_fisher, information
from dnrtrain.selector.protocol import Candidates
from dnrtrain.settings import ModelSettings


@pytest.fixture(scope="module")
def dnr() -> DNR:
    return DNR(ModelSettings(texture_size=16, width=4, depth=1, aggregator="residual"), 0)


def test_it_is_the_squared_jacobian_on_average(scene: Scene, dnr: DNR, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a group of weights, against the Jacobian of every pixel; four views of few pixels."""
    monkeypatch.setattr(fisher, "PROBES", 64)
    small = scene.raster.subset([0])
    small = type(small)(small.names, small.c2w, small.tensors.crop(12, 12, 4))
    weights = [weight for weight in dnr.parameters() if weight.requires_grad]
    pixels = dnr(small.batch([0])).rgb.reshape(-1)
    exact = torch.zeros(sum(weight.numel() for weight in weights))
    for pixel in pixels:
        gradients = torch.autograd.grad(pixel, weights, retain_graph=True)
        exact += torch.cat([gradient.reshape(-1) for gradient in gradients]).square()
    found = information(dnr, small, 0)[0]
    length = -(-len(exact) // len(found))
    groups = torch.nn.functional.pad(exact, (0, len(found) * length - len(exact))).reshape(-1, length).sum(1).numpy()
    assert found.sum() == pytest.approx(groups.sum(), rel=0.2)
    assert np.corrcoef(found, groups)[0, 1] > 0.9
    assert all(weight.grad is None for weight in weights)


def test_what_was_told_is_not_asked_again(scene: Scene, dnr: DNR) -> None:
    """Gains fall, and a pool of two kinds of pictures is chosen one of each first."""
    views = scene.raster.subset([0, 0, 0, 5, 5])
    turned = np.arange(5)[:, None] * 1e-3  # poses differ, so that only what they tell makes them alike
    candidates = Candidates(views.camera_positions + turned, views.camera_directions)
    choice = choose_by_fisher(dnr, views, candidates, 3, 0)
    assert len({min(view // 3, 1) for view in choice.views[:2]}) == 2
    assert choice.gains == sorted(choice.gains, reverse=True) and min(choice.gains) > 0
    assert choose_by_fisher(dnr, views, candidates, 3, 0) == choice

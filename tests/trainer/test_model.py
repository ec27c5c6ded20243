"""The DNR: sizes, strategies, empty views, seeds, precision."""

from __future__ import annotations

import pytest
import torch
from pydantic import ValidationError

from conftest import Scene
from dnrtrain.dataset import Batch
from dnrtrain.model import DNR, render_views
from dnrtrain.settings import ModelSettings

SMALL = {"texture_size": 16, "width": 4, "depth": 2}


def random_batch(height: int, width: int, count: int = 1, filled: float = 0.6) -> Batch:
    generator = torch.Generator().manual_seed(0)

    def uniform(channels: int) -> torch.Tensor:
        return torch.rand(count, channels, height, width, generator=generator)

    mask = (uniform(1) < filled).float()
    normal = torch.nn.functional.normalize(uniform(3) - 0.5, dim=1)
    return Batch(
        (2 * uniform(2) - 1) * mask, uniform(1) * mask, normal * mask, mask, mask, normal, uniform(3)
    )  # fmt: skip


@pytest.mark.parametrize(("height", "width", "depth"), [(1, 1, 3), (7, 13, 2), (33, 50, 4), (64, 64, 6), (800, 9, 4)])
def test_any_size(height: int, width: int, depth: int) -> None:
    model = DNR(ModelSettings(texture_size=16, width=4, depth=depth), seed=0)
    output = model(random_batch(height, width, count=2))
    assert output.rgb.shape == (2, 3, height, width) and output.texture.shape == (2, 16, height, width)
    assert torch.isfinite(output.rgb).all()


@pytest.mark.parametrize("modalities", ["uv", "uv+depth", "uv+normal", "uv+depth+normal"])
@pytest.mark.parametrize("aggregator", ["concat", "residual", "early"])
def test_every_strategy_trains_its_textures(aggregator: str, modalities: str) -> None:
    settings = ModelSettings.model_validate({**SMALL, "aggregator": aggregator, "modalities": modalities})
    model = DNR(settings, seed=0)
    with torch.no_grad():
        for parameter in model.parameters():  # also the zero-initialised residual
            parameter.add_(0.01)
    batch = random_batch(16, 16)
    output = model(batch)
    assert (output.texture * (1 - batch.mask) == 0).all() and output.texture.abs().sum() > 0
    output.rgb.square().sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
    textures = [name for name, _ in model.named_parameters() if "texture_" in name]
    expected = 0 if aggregator == "early" else modalities.count("+") + 1
    assert len({name.split(".")[1] for name in textures}) == expected


def test_residual_starts_as_the_uv_texture() -> None:
    batch = random_batch(16, 16)
    residual = DNR(ModelSettings.model_validate({**SMALL, "aggregator": "residual"}), seed=0)
    points = batch.uv.permute(0, 2, 3, 1)[batch.mask[:, 0] > 0.5]
    sampled = residual.aggregator.texture_uv(points)
    inside = residual(batch).texture.permute(0, 2, 3, 1)[batch.mask[:, 0] > 0.5]
    assert torch.allclose(inside, sampled, atol=1e-6)


def test_a_view_that_sees_nothing_is_white_and_trains() -> None:
    model = DNR(ModelSettings.model_validate(SMALL), seed=0)
    batch = random_batch(16, 16, filled=0.0)
    output = model(batch)
    assert (output.rgb == 1).all()
    output.rgb.sum().backward()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in model.parameters())


def test_harmonics_make_colour_depend_on_the_view() -> None:
    batch = random_batch(16, 16)
    turned = Batch(**{**vars(batch), "view_dir": -batch.view_dir.flip(1)})
    for harmonics in (True, False):
        settings = ModelSettings.model_validate({**SMALL, "spherical_harmonics": harmonics})
        model = DNR(settings, seed=0)
        differs = not torch.equal(model(batch).rgb, model(turned).rgb)
        assert differs == harmonics


def test_seed_fixes_weights_without_touching_global_state() -> None:
    torch.manual_seed(7)
    before = torch.get_rng_state()
    models = [DNR(ModelSettings.model_validate(SMALL), seed) for seed in (1, 1, 2)]
    assert torch.equal(torch.get_rng_state(), before)
    first, again, other = [torch.cat([p.flatten() for p in m.parameters()]) for m in models]
    assert torch.equal(first, again) and not torch.equal(first, other)
    torch.manual_seed(8)
    assert torch.equal(torch.cat([p.flatten() for p in DNR(models[0].settings, 1).parameters()]), first)


def test_bfloat16_is_close_and_textures_stay_float32() -> None:
    model = DNR(ModelSettings.model_validate(SMALL), seed=0)
    batch = random_batch(32, 32)
    with torch.no_grad():
        exact = model(batch)
        model.use_bfloat16 = True
        coarse = model(batch)
    assert coarse.rgb.dtype == coarse.texture.dtype == torch.float32
    assert not torch.equal(exact.rgb, coarse.rgb)
    assert (exact.rgb - coarse.rgb).abs().max() < 0.05


def test_render_views(scene: Scene) -> None:
    model = DNR(ModelSettings.model_validate(SMALL), seed=0)
    frames = render_views(model, scene.held_out)
    assert frames.shape == (4, 3, 32, 32) and frames.min() >= 0 and frames.max() <= 1
    assert torch.allclose(frames, render_views(model, scene.held_out, batch=3), atol=1e-5)


def test_settings_refuse_nonsense() -> None:
    with pytest.raises(ValidationError, match="greater than or equal to 12"):
        ModelSettings(texture_channels=4)  # nine harmonics need room

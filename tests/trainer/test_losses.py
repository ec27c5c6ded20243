"""The six losses: values, finite gradients on flat and tiny images, switches."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dnrtrain import losses
from dnrtrain.model import Output
from dnrtrain.perceptual import Features, PerceptualLoss, random_weights
from dnrtrain.settings import LossWeights, Step2Settings

TERMS = {"photometric", "ssim", "perceptual", "frequency", "total_variation", "regularisation"}


def images(side: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(1, 3, side, side, generator=generator), torch.rand(1, 3, side, side, generator=generator)


@pytest.mark.parametrize("side", [1, 2, 7, 16, 33])
@pytest.mark.parametrize("content", ["equal", "black and white", "random"])
def test_everything_is_finite(perceptual: PerceptualLoss, side: int, content: str) -> None:
    prediction, target = images(side)
    if content == "equal":
        prediction = target = torch.full((1, 3, side, side), 0.5)
    elif content == "black and white":
        prediction, target = torch.zeros(1, 3, side, side), torch.ones(1, 3, side, side)
    prediction = prediction.clone().requires_grad_()
    texture = torch.zeros(1, 16, side, side, requires_grad=True)
    loss = losses.Step2Loss(Step2Settings(), perceptual)
    total, terms = loss(Output(prediction, texture), target, np.random.default_rng(0), bfloat16=False)
    total.backward()
    assert set(terms) == TERMS
    assert torch.isfinite(torch.stack(list(terms.values()))).all()
    assert prediction.grad is not None and torch.isfinite(prediction.grad).all()
    if content == "equal":
        assert abs(float(total.detach())) < 1e-6


def test_the_total_is_the_weighted_sum(perceptual: PerceptualLoss) -> None:
    prediction, target = images(16)
    texture = torch.ones(1, 16, 16, 16)
    settings = Step2Settings()
    total, terms = losses.Step2Loss(settings, perceptual)(
        Output(prediction, texture), target, np.random.default_rng(0), bfloat16=False
    )
    expected = {"photometric": 1, "ssim": 0.1, "perceptual": 0.1, "frequency": 0.01,
                "total_variation": 0.001, "regularisation": 0.1}  # fmt: skip
    assert float(total) == pytest.approx(sum(w * float(terms[k]) for k, w in expected.items()), rel=1e-5)


def test_zero_weights_and_missing_network_drop_terms() -> None:
    prediction, target = images(16)
    output = Output(prediction, torch.zeros(1, 16, 16, 16))
    off = Step2Settings(loss=LossWeights(ssim=0, total_variation=0))
    _, terms = losses.Step2Loss(off, None)(output, target, np.random.default_rng(0), bfloat16=False)
    assert set(terms) == TERMS - {"ssim", "total_variation", "perceptual"}


def test_frequency_against_numpy() -> None:
    prediction, target = images(8)
    for norm in ("backward", "ortho"):
        spectrum = np.fft.rfft2((prediction - target).numpy().astype(np.float64), norm=norm)
        expected = (np.abs(spectrum.real) + np.abs(spectrum.imag)).mean()
        assert float(losses.frequency(prediction, target, norm)) == pytest.approx(expected, rel=1e-5)
    assert losses.frequency(prediction.bfloat16(), target.bfloat16(), "ortho").dtype == torch.float32


def test_total_variation_by_hand() -> None:
    image = torch.tensor([[0.0, 1.0], [0.0, 3.0]]).expand(1, 3, 2, 2)
    assert float(losses.total_variation(image)) == pytest.approx((0 + 2) / 2 + (1 + 3) / 2)


def test_photometric_kinds() -> None:
    a, b = torch.zeros(1, 3, 2, 2), torch.full((1, 3, 2, 2), 0.5)
    assert float(losses.photometric(a, b, "l1")) == 0.5 and float(losses.photometric(a, b, "mse")) == 0.25


def test_perceptual_is_the_weighted_feature_distance(perceptual: PerceptualLoss) -> None:
    prediction, target = images(32)
    network = Features("vgg", random_weights("vgg"), taps=4)
    expected = sum(
        w * float((a - b).abs().mean())
        for w, a, b in zip((1 / 32, 1 / 16, 1 / 8, 1 / 4), network(prediction), network(target), strict=True)
    )
    assert float(perceptual(prediction, target)) == pytest.approx(expected, rel=1e-5)


def test_crop_is_the_same_window_of_both() -> None:
    prediction, target = images(32)
    random = np.random.default_rng(1)
    a, b = losses.random_crop(prediction, prediction + target, 8, random)
    assert a.shape == (1, 3, 8, 8)
    mirrored = [
        torch.from_numpy(np.pad(image[0].numpy(), ((0, 0), (4, 4), (4, 4)), "symmetric"))
        for image in (prediction, target)
    ]
    found = (mirrored[0][0].unfold(0, 8, 1).unfold(1, 8, 1) == a[0, 0]).all(-1).all(-1).nonzero()[0]
    top, left = int(found[0]), int(found[1])
    assert torch.equal(b[0], a[0] + mirrored[1][:, top : top + 8, left : left + 8])
    assert losses.random_crop(prediction, target, 0, random)[0] is prediction
    assert losses.random_crop(prediction, target, 99, random)[0].shape == prediction.shape


@pytest.mark.parametrize("side", [7, 8, 20])
def test_crop_shows_every_pixel_equally_often(side: int) -> None:
    """From border to border. Windows that stay inside would show the middle up to 20 times as often as row one."""
    places = torch.arange(24.0).expand(1, 1, 24, 24)
    random = np.random.default_rng(0)
    rows = torch.cat([losses.random_crop(places, places, side, random)[0][0, 0, 0] for _ in range(4000)])
    share = torch.bincount(rows.long(), minlength=24) / len(rows)
    assert share.min() > 0.9 / 24 and share.max() < 1.1 / 24

"""Gradients of every hand-written operation against central finite differences, in float64.

Everything here is piecewise smooth: samples keep their distance from the kinks (texel centres, octahedral folds,
the ends of the display transform). ReLU, |x| and max-pooling have theirs where random values do not fall.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from dnrtrain import losses
from dnrtrain.contract import SceneFrame
from dnrtrain.correction import filter_by, from_log, to_log
from dnrtrain.dataset import Batch
from dnrtrain.display import DisplayTransform, srgb_oetf
from dnrtrain.metrics import psnr, psnr_masked, ssim_masked
from dnrtrain.model import DNR, compose
from dnrtrain.perceptual import Lpips, PerceptualLoss, random_weights
from dnrtrain.settings import ModelSettings, Step2Settings
from dnrtrain.textures import TexturePyramid, apply_harmonics, depth_coordinate, octahedral, spherical_harmonics

STEP = 1e-6


def uniform(*shape: int, low: float = 0.0, high: float = 1.0, seed: int = 0, grad: bool = True) -> Tensor:
    values = torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (low + (high - low) * values).requires_grad_(grad)


def directions(count: int, seed: int = 0) -> Tensor:
    """Unit vectors at least 0.05 from the octahedral map's folds (the three coordinate planes)."""
    values = torch.randn(20 * count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    values = values / values.norm(dim=1, keepdim=True)
    return values[(values.abs() > 0.05).all(dim=1)][:count].clone()


def check_entries(function: Callable[[], Tensor], leaves: Sequence[Tensor], entries: int = 3, seed: int = 0) -> None:
    """Compare the gradient of the scalar ``function`` with central differences at the ``entries`` coordinates of
    each leaf where it is largest, and at as many random ones. For functions too large for gradcheck.
    """
    gradients = torch.autograd.grad(function(), leaves)
    random = np.random.default_rng(seed)
    for leaf, gradient in zip(leaves, gradients, strict=True):
        largest = gradient.abs().reshape(-1).topk(min(entries, leaf.numel())).indices.tolist()
        for entry in {*largest, *random.integers(leaf.numel(), size=entries).tolist()}:
            # .data of channels-last parameters cannot be viewed flat: go through the index.
            place = np.unravel_index(entry, leaf.shape)
            value, sides = float(leaf.data[place]), []
            for side in (STEP, -STEP):
                leaf.data[place] = value + side
                sides.append(float(function().detach()))
            leaf.data[place] = value
            numeric, analytic = (sides[0] - sides[1]) / (2 * STEP), float(gradient[place])
            assert math.isclose(analytic, numeric, rel_tol=1e-4, abs_tol=1e-8), (tuple(leaf.shape), entry)


def pyramid(size: int, levels: int, dimensions: int, channels: int = 2) -> TexturePyramid:
    made = TexturePyramid(
        size, levels, channels, dimensions=dimensions, generator=torch.Generator().manual_seed(1)
    ).double()
    return made.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def off_centre(count: int, size: int, low: float, high: float) -> Tensor:
    """Coordinates [count, 2] at least a hundredth of a texel from the texel centres of every level."""
    points = uniform(50 * count, 2, low=low, high=high, grad=False)
    keep = torch.ones(len(points), dtype=torch.bool)
    while size >= 1:
        texel = ((points + 1) * size - 1) / 2
        keep &= ((texel - texel.round()).abs() > 0.01).all(dim=1)
        size //= 2
    return points[keep][:count].clone()


@pytest.mark.parametrize(("size", "levels"), [(8, 3), (5, 1), (2, 2), (1, 1)])
@pytest.mark.parametrize("dimensions", [1, 2])
def test_texture_sampling(size: int, levels: int, dimensions: int) -> None:
    """Texels and coordinates, inside and beyond the border."""
    texture = pyramid(size, levels, dimensions)
    points = off_centre(12, size, -1.3, 1.3)
    if dimensions == 1:
        points[:, 1] = 0.0
    # gradcheck moves its inputs in place: the pyramid's own texels.
    assert gradcheck(lambda *texels: texture(points), tuple(texture.levels))
    x, y = points[:, :1].clone().requires_grad_(), points[:, 1:].clone().requires_grad_(dimensions == 2)
    assert gradcheck(lambda x, y: texture(torch.cat([x, y], dim=1)), (x, y))
    assert float(texture(points).detach().abs().max()) > 0


def test_repeated_points_add_their_gradients() -> None:
    texture = pyramid(4, 2, 2)
    point = off_centre(1, 4, -0.9, 0.9)
    texture(point).sum().backward()
    once = [level.grad.clone() for level in texture.levels]  # type: ignore[union-attr]
    texture.zero_grad()
    texture(point.expand(7, 2)).sum().backward()
    for level, gradient in zip(texture.levels, once, strict=True):
        assert level.grad is not None and torch.allclose(level.grad, 7 * gradient, rtol=1e-12)


def test_octahedral_map_and_depth_coordinate() -> None:
    assert gradcheck(octahedral, (directions(40).requires_grad_(),))
    assert gradcheck(depth_coordinate, (uniform(5, 1),))


def test_harmonics() -> None:
    direction = directions(6).t().reshape(1, 3, 2, 3).clone().requires_grad_()
    assert gradcheck(spherical_harmonics, (direction,))
    assert gradcheck(apply_harmonics, (uniform(1, 13, 2, 3), direction))


def test_harmonics_are_orthonormal_by_quadrature() -> None:
    """Gauss-Legendre in z and equal steps in the angle integrate products of bands 0 to 2 (degree 4) exactly."""
    z, weight = np.polynomial.legendre.leggauss(3)
    angle = 2 * np.pi * np.arange(5) / 5
    flat = np.sqrt(1 - z**2)[:, None]
    points = np.stack([flat * np.cos(angle), flat * np.sin(angle), np.broadcast_to(z[:, None], (3, 5))])
    values = spherical_harmonics(torch.from_numpy(points)[None])[0].reshape(9, -1).numpy()
    gram = values * np.repeat(weight * 2 * np.pi / 5, 5) @ values.T
    assert np.abs(gram - np.eye(9)).max() < 1e-14


@pytest.mark.parametrize("size", [(8, 8), (7, 5), (1, 4)])
def test_frequency_loss(size: tuple[int, int]) -> None:
    pair = (uniform(1, 3, *size), uniform(1, 3, *size, seed=1))
    for norm in ("backward", "ortho"):
        assert gradcheck(lambda a, b, norm=norm: losses.frequency(a, b, norm), pair)


@pytest.mark.parametrize("size", [(12, 11), (6, 9), (1, 1)])
def test_ssim(size: tuple[int, int]) -> None:
    prediction, target = uniform(1, 3, *size), uniform(1, 3, *size, seed=1)
    assert gradcheck(losses.structural, (prediction, target))
    mask = torch.ones(1, 1, *size, dtype=torch.float64)
    mask[..., size[0] // 2 + 1 :, :] = 0
    assert gradcheck(lambda x: ssim_masked(x, target, mask), (prediction,))
    assert gradcheck(lambda x: torch.cat([psnr(x, target), psnr_masked(x, target, mask)]), (prediction,))


def test_other_losses() -> None:
    prediction, target = uniform(1, 3, 4, 5), uniform(1, 3, 4, 5, seed=1)
    for kind in ("l1", "mse", "charbonnier"):
        assert gradcheck(lambda x, y, kind=kind: losses.photometric(x, y, kind), (prediction, target))
    assert gradcheck(losses.total_variation, (prediction,))
    assert gradcheck(losses.total_variation, (uniform(1, 3, 1, 6),))
    assert gradcheck(losses.texture_regularisation, (uniform(1, 16, 2, 3),))


def test_perceptual_loss_and_lpips() -> None:
    prediction, target = uniform(1, 3, 16, 16), uniform(1, 3, 16, 16, seed=1, grad=False)
    loss = PerceptualLoss(random_weights("vgg"), Step2Settings().perceptual_weights).double()
    check_entries(lambda: loss(prediction, target), [prediction])
    small = uniform(1, 3, 5, 6)
    check_entries(lambda: loss(small, target[..., :5, :6]), [small])
    lpips = Lpips("vgg", random_weights("vgg")).double()
    check_entries(lambda: lpips(prediction, target).sum(), [prediction])


def test_composition_and_log_space() -> None:
    assert gradcheck(compose, (uniform(1, 3, 2, 3), uniform(1, 1, 2, 3, seed=1)))
    assert gradcheck(to_log, (uniform(1, 3, 2, 2, low=0.01, high=20.0),))
    assert gradcheck(from_log, (uniform(1, 3, 2, 2, low=-0.5, high=2.0),))


@pytest.mark.parametrize("side", [3, 5])
def test_predicted_kernels(side: int) -> None:
    """By image and by weights, at and within the border."""
    weights = uniform(1, side * side, 3, 4, low=-2.0, high=2.0, seed=1)
    assert gradcheck(filter_by, (uniform(1, 2, 3, 4), weights))


def lut_transform(folder: Path, side: int, gamma: float) -> DisplayTransform:
    """A smooth, channel-mixing LUT of ``side`` nodes, log-spaced up to radiance 16."""
    node = np.linspace(0, 1, side)
    r, g, b = np.meshgrid(node, node, node, indexing="ij")
    lut = np.stack([0.8 * r + 0.1 * g * b, 0.9 * g**2 + 0.05 * r, 0.1 + 0.6 * b + 0.2 * r * g], axis=-1)
    np.savez(folder / "lut.npz", lut=lut.astype(np.float32), max=16.0, k=50.0)
    frame = SceneFrame(near=1, far=2, center=(0, 0, 0), radius=1, display_lut="lut.npz", gamma=gamma)
    return DisplayTransform(frame, folder)


def test_display_transform(tmp_path: Path) -> None:
    """Linear segment and power of sRGB, exposure and gamma, a LUT, un-premultiplication."""
    assert gradcheck(srgb_oetf, (uniform(3, 4, 4, low=2e-4, high=2.9e-3),))
    assert gradcheck(srgb_oetf, (uniform(3, 4, 4, low=0.0035, high=0.99),))
    plain = DisplayTransform(SceneFrame(near=1, far=2, center=(0, 0, 0), radius=1, exposure=-0.7, gamma=1.3), Path())
    image, alpha = uniform(1, 3, 4, 4, low=0.02, high=0.5), uniform(1, 1, 4, 4, low=0.3, high=0.99, seed=1)
    assert gradcheck(plain, (image,)) and gradcheck(plain.over_white, (image, alpha))
    for gamma in (1.0, 0.8):
        transform = lut_transform(tmp_path, 5, gamma)
        coordinate = torch.log2(1 + 50 * image.detach()) / math.log2(1 + 50 * 16.0) * 4
        away = ((coordinate - coordinate.round()).abs() > 1e-4).all()
        assert away and gradcheck(transform, (image,)) and gradcheck(transform.over_white, (image, alpha))


@pytest.mark.parametrize("gamma", [0.5, 1.0, 2.2])
def test_display_gradient_is_finite_everywhere(tmp_path: Path, gamma: float) -> None:
    """Black, the sRGB joint, white and far beyond; a gamma's slope at black is infinite if taken literally."""
    frame = SceneFrame(near=1, far=2, center=(0, 0, 0), radius=1, gamma=gamma)
    for transform in (DisplayTransform(frame, Path()), lut_transform(tmp_path, 5, gamma)):
        values = torch.tensor([-1.0, 0.0, 1e-9, 0.0031308, 1.0, 16.0, 1e4]).expand(3, 1, 7).clone().requires_grad_()
        shown = transform(values)
        shown.sum().backward()
        assert torch.isfinite(shown).all() and values.grad is not None and torch.isfinite(values.grad).all()


def tiny_batch(side: int) -> Batch:
    """A random view in float64 with everything that any model may ask for; 70 % of its pixels see a surface."""
    frame = SceneFrame(near=1, far=2, center=(0, 0, 0), radius=1)

    def image(channels: int, seed: int) -> Tensor:
        return uniform(1, channels, side, side, seed=seed, grad=False)

    mask = (image(1, 2) < 0.7).double()
    chain = mask * (image(1, 9) < 0.5)
    unit = directions(2 * side * side).t().reshape(3, 2, side, side)
    return Batch(
        uv=(2 * image(2, 3) - 1) * mask, depth=image(1, 4) * mask, normal=unit[None, :, 0] * mask, mask=mask,
        coverage=0.2 + 0.8 * image(1, 5), view_dir=unit[None, :, 1], target=image(3, 6),
        base=0.05 + 0.7 * image(3, 7), diffuse=0.03 * image(3, 8), albedo=image(3, 10),
        chain_uv=(2 * image(2, 11) - 1) * chain, chain_mask=chain, chain_weight=image(1, 12) * chain,
        display=DisplayTransform(frame, Path()),
    )  # fmt: skip


MODELS = {
    "vanilla": {"modalities": "uv"},
    "concat": {"aggregator": "concat"},
    "residual": {"aggregator": "residual"},
    "early": {"aggregator": "early"},
    "raster": {"base": "raster", "guides": True, "network": "mlp"},
    "baked": {"base": "baked", "guides": True, "chain": True, "stride": 2, "modalities": "uv", "filter": 3},
    "log": {"base": "baked", "guides": True, "chain": True, "output": "log", "aggregator": "residual"},
}


@pytest.mark.parametrize("name", MODELS)
def test_the_whole_model_with_all_losses(name: str) -> None:
    """Every texel level, weight and bias, through sampling, fusion, network, composition and the weighted sum."""
    settings = ModelSettings.model_validate(
        {"texture_size": 8, "texture_levels": 2, "texture_channels": 12, "width": 4, "depth": 2, **MODELS[name]}
    )
    model = DNR(settings, seed=0).double()
    with torch.no_grad():  # also what starts at zero
        for seed, parameter in enumerate(model.parameters()):
            parameter.add_(uniform(*parameter.shape, low=-0.05, high=0.05, seed=seed, grad=False))
    batch, random = tiny_batch(12), np.random.default_rng(0)
    assert batch.target is not None
    target = batch.target
    loss = losses.Step2Loss(Step2Settings(), None)
    check_entries(lambda: loss(model(batch), target, random, bfloat16=False)[0], list(model.parameters()), entries=2)


class Wrong(torch.autograd.Function):
    """x² whose gradient is a hundredth too large."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:  # type: ignore[override, no-untyped-def]
        ctx.save_for_backward(x)
        return x * x

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:  # type: ignore[override, no-untyped-def]
        return 2.02 * ctx.saved_tensors[0] * gradient


def test_a_wrong_gradient_is_caught() -> None:
    """The checks of this file can fail."""
    x = uniform(3, 4, low=0.5)
    with pytest.raises(RuntimeError, match="Jacobian mismatch"):
        gradcheck(Wrong.apply, (x,))
    with pytest.raises(AssertionError):
        check_entries(lambda: Wrong.apply(x).sum(), [x])  # type: ignore[union-attr]

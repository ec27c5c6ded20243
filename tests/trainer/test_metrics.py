"""PSNR, SSIM and LPIPS against independent computations and published values."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from dnrtrain import perceptual
from dnrtrain.metrics import image_metrics, psnr, psnr_masked, ssim, ssim_map, ssim_masked
from dnrtrain.perceptual import Lpips, build_lpips, random_weights
from dnrtrain.weights import WeightsMissing, load_weights


def images(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    a = torch.rand(2, 3, height, width, generator=generator)
    return a, (a + 0.2 * torch.randn(2, 3, height, width, generator=generator)).clamp(0, 1)


def brute_force_ssim(x: np.ndarray, y: np.ndarray, size: int) -> float:
    """Wang et al. 2004, equation 13, window by window in float64."""
    offsets = np.arange(size) - (size - 1) / 2
    line = np.exp(-0.5 * (offsets / 1.5) ** 2)
    window = np.outer(line, line) / line.sum() ** 2
    values = []
    for a, b in zip(x, y, strict=True):
        for row in range(a.shape[0] - size + 1):
            for column in range(a.shape[1] - size + 1):
                p, q = (i[row : row + size, column : column + size] for i in (a, b))
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
                cov = (window * (p - mp) * (q - mq)).sum()
                values.append((2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    return float(np.mean(values))


@pytest.mark.parametrize(("height", "width", "size"), [(15, 18, 11), (11, 11, 11)])
def test_ssim_against_brute_force(height: int, width: int, size: int) -> None:
    a, b = images(height, width)
    for index in range(2):
        expected = brute_force_ssim(a[index].double().numpy(), b[index].double().numpy(), size)
        assert float(ssim(a, b)[index]) == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize("side", [1, 2, 3, 8, 10])
def test_ssim_of_small_images(side: int) -> None:
    a, b = images(side, side)
    assert torch.isfinite(ssim(a, b)).all()
    assert torch.allclose(ssim(a, a), torch.ones(2), atol=1e-5)


def test_flat_images_are_alike() -> None:
    flat = torch.full((1, 3, 16, 16), 0.3)
    assert float(ssim(flat, flat)) == pytest.approx(1.0, abs=1e-4)
    assert float(ssim(flat, 1 - flat)) < 0.95


def test_psnr_values() -> None:
    zero = torch.zeros(2, 3, 4, 4)
    other = torch.stack([torch.full((3, 4, 4), 0.1), torch.zeros(3, 4, 4)])
    assert psnr(zero, other).tolist() == pytest.approx([20.0, 100.0], abs=1e-4)


def test_masked_metrics_look_inside_only() -> None:
    a, b = images(24, 24)
    mask = torch.zeros(2, 1, 24, 24)
    mask[:, :, 6:18, 8:14] = 1
    changed = torch.where(mask > 0.5, b, 1 - b)
    assert torch.allclose(psnr_masked(a, b, mask), psnr_masked(a, changed, mask))
    inside = (a - b)[:, :, 6:18, 8:14].square().mean(dim=(1, 2, 3))
    assert torch.allclose(psnr_masked(a, b, mask), -10 * inside.log10(), atol=1e-3)
    # A full mask gives the plain metrics; the SSIM map's border is where no window fits.
    full = torch.ones_like(mask)
    assert torch.allclose(ssim_masked(a, b, full), ssim(a, b), atol=1e-6)
    assert torch.allclose(psnr_masked(a, b, full), psnr(a, b), atol=1e-4)
    assert torch.allclose(ssim_masked(a, b, mask), ssim_map(a, b)[:, :, 1:13, 3:9].mean(dim=(1, 2, 3)), atol=1e-6)


def test_empty_masks_are_undefined_not_zero() -> None:
    a, b = images(16, 16)
    empty = torch.zeros(2, 1, 16, 16)
    assert torch.isnan(psnr_masked(a, b, empty)).all() and torch.isnan(ssim_masked(a, b, empty)).all()
    values = image_metrics(a[:1], b[:1], empty[:1])
    assert values["psnr_mask"] is None and values["lpips_vgg"] is None
    assert values["psnr"] is not None and math.isfinite(values["psnr"])


@pytest.mark.parametrize("network", ["vgg", "alex"])
def test_lpips_mechanics(network: str) -> None:
    lpips = Lpips(network, random_weights(network))  # type: ignore[arg-type]
    a, b = images(40, 40)
    same, other = lpips(a, a), lpips(a, b)
    assert torch.allclose(same, torch.zeros(2), atol=1e-7) and (other > 0).all()
    black = torch.zeros(1, 3, lpips.minimum_side, lpips.minimum_side, requires_grad=True)
    lpips(black, torch.zeros_like(black)).sum().backward()
    assert black.grad is not None and torch.isfinite(black.grad).all()
    with pytest.raises(ValueError, match="at least"):
        lpips(a[..., :8, :8], b[..., :8, :8])


@pytest.mark.parametrize("network", ["vgg", "alex"])
@pytest.mark.parametrize("size", [(300, 40), (257, 33), (385, 31), (512, 48), (643, 37)])
def test_lpips_in_bands_is_lpips(network: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    lpips = Lpips(network, random_weights(network)).double()  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.rand(2, 3, *size, generator=generator, dtype=torch.float64) for _ in range(2))
    with torch.no_grad():
        whole = lpips(a, b)
        monkeypatch.setattr(perceptual, "AT_ONCE", 1)
        seen = []
        maps = lpips._maps
        monkeypatch.setattr(lpips, "_maps", lambda x, y: seen.append(x.shape[-2]) or maps(x, y))
        banded = lpips(a, b)
    assert banded.shape == (2,) and torch.allclose(banded, whole, rtol=1e-9)
    assert (len(seen) > 1) == (size[0] > 256) and max(seen) <= 384


def test_lpips_reproduces_the_documented_value() -> None:
    """torchmetrics documents 0.3485 for LPIPS-VGG on this uniform noise (inputs in [-1, 1], seed 123)."""
    try:
        lpips = build_lpips(load_weights())
    except WeightsMissing as reason:
        pytest.skip(str(reason))
    torch.manual_seed(123)
    a, b = torch.rand(10, 3, 100, 100) * 2 - 1, torch.rand(10, 3, 100, 100) * 2 - 1
    with torch.no_grad():
        values = {name: float(network((a + 1) / 2, (b + 1) / 2).mean()) for name, network in lpips.items()}
    assert values["vgg"] == pytest.approx(0.3485, abs=2e-4)
    assert 0.1 < values["alex"] < 0.2

"""Display transform: known code values, HDR safety, LUT, composition over white."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dnrtrain.contract import ContractError, SceneFrame
from dnrtrain.display import DisplayTransform, srgb_oetf


def frame(**changes: object) -> SceneFrame:
    base = SceneFrame(near=1, far=2, center=(0, 0, 0), radius=1)
    return base.model_copy(update=changes)


def write_lut(path: Path, function, nodes: int = 33, maximum: float = 8.0, k: float = 64.0) -> None:
    t = np.linspace(0, 1, nodes)
    x = (2 ** (t * np.log2(1 + k * maximum)) - 1) / k
    r, g, b = np.meshgrid(x, x, x, indexing="ij")
    np.savez(path, lut=np.stack(function(r, g, b), -1).astype(np.float32), max=maximum, k=k)


def test_srgb_code_values() -> None:
    linear = torch.tensor([0.0, 0.0031308, 0.18, 0.5, 1.0])
    expected = torch.tensor([0.0, 0.04045, 0.46136, 0.73536, 1.0])
    assert torch.allclose(srgb_oetf(linear), expected, atol=1e-4)


def test_high_and_negative_radiance_stays_in_range() -> None:
    shown = DisplayTransform(frame(), Path())(torch.tensor([-5.0, 1e30, 0.2]).view(3, 1, 1))
    assert shown.flatten()[0] == 0 and abs(shown.flatten()[1] - 1) < 1e-6 and torch.isfinite(shown).all()


def test_exposure_and_gamma() -> None:
    image = torch.full((3, 2, 2), 0.1)
    brighter = DisplayTransform(frame(exposure=1.0), Path())(image)
    assert torch.allclose(brighter, srgb_oetf(image * 2))
    assert torch.allclose(DisplayTransform(frame(gamma=2.0), Path())(image), srgb_oetf(image) ** 0.5)


def test_gradient_is_finite_at_zero() -> None:
    image = torch.zeros(3, 2, 2, requires_grad=True)
    DisplayTransform(frame(), Path())(image).sum().backward()
    assert image.grad is not None and torch.isfinite(image.grad).all()


def test_lut_axes_and_nodes(tmp_path: Path) -> None:
    """A LUT that mixes channels unevenly is reproduced: r, g, b are not swapped, nodes are log-spaced."""

    def curve(x):
        return np.log2(1 + 64 * np.asarray(x)) / np.log2(1 + 64 * 8)  # linear in the node coordinate: exact

    write_lut(tmp_path / "display.npz", lambda r, g, b: (curve(r), (curve(g) + curve(r)) / 2, curve(b) / 2))
    transform = DisplayTransform(frame(display_lut="display.npz"), tmp_path)
    image = torch.rand(2, 3, 5, 4, generator=torch.Generator().manual_seed(0)) * 8
    r, g, b = image.unbind(1)
    r, g, b = (torch.from_numpy(curve(x)) for x in (r, g, b))
    assert torch.allclose(transform(image), torch.stack([r, (g + r) / 2, b / 2], 1), atol=1e-5)
    assert torch.allclose(transform(image[0]), transform(image)[0])


def test_over_white() -> None:
    transform = DisplayTransform(frame(), Path())
    alpha = torch.tensor([[[[1.0, 0.5, 0.0]]]])
    straight = torch.full((1, 3, 1, 3), 0.18)
    result = transform.over_white(straight * alpha, alpha)
    shown = float(srgb_oetf(torch.tensor(0.18)))
    assert torch.allclose(result[0, 0, 0], torch.tensor([shown, 0.5 * shown + 0.5, 1.0]), atol=1e-6)


@pytest.mark.parametrize("damage", ["missing", "shape", "nan", "text"])
def test_bad_lut_is_refused(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "display.npz"
    if damage == "text":
        path.write_text("not an archive")
    elif damage == "shape":
        np.savez(path, lut=np.zeros((4, 4, 3, 3)), max=1.0, k=1.0)
    elif damage == "nan":
        np.savez(path, lut=np.full((4, 4, 4, 3), np.nan), max=1.0, k=1.0)
    with pytest.raises(ContractError, match=r"display\.npz"):
        DisplayTransform(frame(display_lut="display.npz"), tmp_path)

"""Every loss, metric and operation of the renderer on images that break such code: finite, with finite gradients."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from dnrtrain import losses
from dnrtrain.contract import SceneFrame
from dnrtrain.correction import correct, filter_by, from_log, to_log
from dnrtrain.dataset import Batch
from dnrtrain.display import DisplayTransform
from dnrtrain.metrics import image_metrics, psnr, ssim
from dnrtrain.model import DNR, Output, compose
from dnrtrain.perceptual import Lpips, PerceptualLoss, random_weights
from dnrtrain.settings import LossWeights, ModelSettings, Step2Settings
from dnrtrain.textures import TexturePyramid, apply_harmonics, depth_coordinate, octahedral

HDR = 1e8
SUBNORMAL = 1e-40
KINDS = ("black", "grey", "white", "one pixel", "hdr", "hdr pixel", "subnormal", "checkered", "random", "negative")
SIDES = (1, 2, 3, 5, 7, 8, 11, 13, 16, 23, 31)
"""Odd, prime, tiny; 8 and 16 beside them."""
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def picture(kind: str, height: int, width: int, channels: int = 3) -> Tensor:
    """float32 [1, channels, height, width] of the named kind."""
    flat = {"black": 0.0, "grey": 0.5, "white": 1.0, "hdr": HDR, "subnormal": SUBNORMAL}
    if kind in flat:
        return torch.full((1, channels, height, width), flat[kind])
    if kind in ("one pixel", "hdr pixel"):
        image = torch.zeros(1, channels, height, width)
        image[..., height // 2, width // 2] = 1.0 if kind == "one pixel" else HDR
        return image
    if kind == "checkered":
        board = (torch.arange(height)[:, None] + torch.arange(width)) % 2
        return board.float().expand(1, channels, height, width).clone()
    noise = torch.rand(1, channels, height, width, generator=torch.Generator().manual_seed(height * 64 + width))
    return noise if kind == "random" else -noise


def finite_with_gradients(value: Tensor, *inputs: Tensor) -> None:
    """``value`` is finite, and so is the gradient of its sum (a non-finite one names what it belongs to)."""
    assert torch.isfinite(value).all()
    value.float().sum().backward()
    for number, one in enumerate(inputs):
        assert one.grad is None or torch.isfinite(one.grad).all(), f"gradient of input {number}"


kinds, sides, dtypes = st.sampled_from(KINDS), st.sampled_from(SIDES), st.sampled_from(sorted(DTYPES))
quick = settings(deadline=None, max_examples=60, derandomize=True)


@pytest.fixture(scope="module")
def lpips() -> Lpips:
    return Lpips("alex", random_weights("alex"))


SIMPLE = {
    "l1": lambda a, b: losses.photometric(a, b, "l1"),
    "mse": lambda a, b: losses.photometric(a, b, "mse"),
    "ssim": losses.structural,
    "frequency": lambda a, b: losses.frequency(a, b, "backward"),
    "total variation": lambda a, b: losses.total_variation(a) + losses.total_variation(b),
    "regularisation": lambda a, b: losses.texture_regularisation(a - b),
}


@pytest.mark.parametrize("name", SIMPLE)
@quick
@given(prediction=kinds, target=kinds, height=sides, width=sides, dtype=dtypes)
@example(prediction="hdr", target="black", height=8, width=8, dtype="float32")
@example(prediction="black", target="black", height=8, width=8, dtype="bfloat16")
@example(prediction="subnormal", target="black", height=13, width=23, dtype="float32")
def test_loss_terms(name: str, prediction: str, target: str, height: int, width: int, dtype: str) -> None:
    x = picture(prediction, height, width).to(DTYPES[dtype]).requires_grad_()
    y = picture(target, height, width).to(DTYPES[dtype])
    finite_with_gradients(SIMPLE[name](x, y), x)


@settings(deadline=None, max_examples=12, derandomize=True)
@given(prediction=kinds, target=kinds, side=st.sampled_from((1, 5, 8, 13, 23)), bfloat16=st.booleans())
@example(prediction="hdr", target="black", side=8, bfloat16=True)
def test_perceptual_loss(prediction: str, target: str, side: int, bfloat16: bool, perceptual: PerceptualLoss) -> None:
    x, y = picture(prediction, side, side).requires_grad_(), picture(target, side, side)
    finite_with_gradients(perceptual(x, y, bfloat16=bfloat16), x)


@settings(deadline=None, max_examples=12, derandomize=True)
@given(prediction=kinds, target=kinds, side=st.sampled_from((31, 37)), dtype=dtypes)
@example(prediction="black", target="black", side=31, dtype="float32")
def test_lpips(prediction: str, target: str, side: int, dtype: str, lpips: Lpips) -> None:
    x = picture(prediction, side, side).to(DTYPES[dtype]).requires_grad_()
    finite_with_gradients(lpips(x, picture(target, side, side)), x)


@quick
@given(prediction=kinds, target=kinds, height=sides, width=sides, dtype=dtypes)
@example(prediction="hdr", target="hdr", height=8, width=8, dtype="float32")
def test_metrics(prediction: str, target: str, height: int, width: int, dtype: str) -> None:
    x, y = (picture(kind, height, width).to(DTYPES[dtype]).float() for kind in (prediction, target))
    assert torch.isfinite(psnr(x, y)).all() and torch.isfinite(ssim(x, y)).all()
    values = image_metrics(x, y, torch.zeros(1, 1, height, width))
    assert values["psnr_mask"] is None and all(v is None or np.isfinite(v) for v in values.values())


@pytest.mark.parametrize("side", [800, 797])
def test_large_and_prime_sizes(side: int) -> None:
    """The paper's 800², and a prime beside it, through all six losses (the perceptual one by its crop)."""
    x, y = picture("hdr pixel", side, side).clamp(0, 1).requires_grad_(), picture("random", side, side)
    settings = Step2Settings(perceptual_crop=16)
    loss = losses.Step2Loss(settings, PerceptualLoss(random_weights("vgg"), Step2Settings().perceptual_weights))
    texture = torch.zeros(1, 12, 4, 4, requires_grad=True)
    total, terms = loss(Output(x, texture), y, np.random.default_rng(0), bfloat16=False)
    assert len(terms) == 6
    finite_with_gradients(total, x, texture)


def transforms(folder: Path) -> dict[str, DisplayTransform]:
    axis = np.linspace(0, 1, 5, dtype=np.float32)
    lut = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    np.savez(folder / "display.npz", lut=lut, max=16.0, k=50.0)
    plain = SceneFrame(near=1, far=2, center=(0, 0, 0), radius=1)
    frames = {
        "srgb": plain,
        "bright": plain.model_copy(update={"exposure": 10.0, "gamma": 2.2}),
        "dark": plain.model_copy(update={"exposure": -10.0, "gamma": 0.5}),
        "lut": plain.model_copy(update={"display_lut": "display.npz"}),
    }
    return {name: DisplayTransform(frame, folder) for name, frame in frames.items()}


@pytest.fixture(scope="module")
def displays(tmp_path_factory: pytest.TempPathFactory) -> dict[str, DisplayTransform]:
    return transforms(tmp_path_factory.mktemp("display"))


shown = st.sampled_from(("srgb", "bright", "dark", "lut"))


@quick
@given(colour=kinds, alpha=st.sampled_from(("black", "white", "one pixel", "subnormal", "random")), side=sides,
       dtype=dtypes, name=shown)  # fmt: skip
@example(colour="hdr", alpha="subnormal", side=8, dtype="float32", name="bright")
@example(colour="black", alpha="black", side=8, dtype="float32", name="srgb")
def test_display_over_white(
    colour: str, alpha: str, side: int, dtype: str, name: str, displays: dict[str, DisplayTransform]
) -> None:
    """Fully transparent, one-pixel foreground, radiance of 1e8 under an alpha of 1e-40: code values in [0, 1]."""
    x = picture(colour, side, side).to(DTYPES[dtype]).requires_grad_()
    a = picture(alpha, side, side, 1).to(DTYPES[dtype]).requires_grad_()
    result = displays[name].over_white(x, a)
    values = result.detach()
    assert values.dtype == torch.float32 and float(values.min()) >= 0 and float(values.max()) <= 1
    finite_with_gradients(result, x, a)


def batch_of(height: int, width: int, foreground: str, base: str, display: DisplayTransform) -> Batch:
    """A view with everything that any model may ask for; ``foreground`` says where there is a surface."""
    mask = (picture(foreground, height, width, 1) > 0.5).float()
    unit = torch.nn.functional.normalize(picture("random", height, width) - 0.5, dim=1)
    edge = torch.where(picture("checkered", height, width, 2) > 0.5, 1.0, -1.0)  # the atlas' rims, on both sides
    image = picture(base, height, width)
    return Batch(
        uv=edge * mask, depth=picture("checkered", height, width, 1) * mask, normal=unit * mask, mask=mask,
        coverage=picture(foreground, height, width, 1).clamp(0, 1), view_dir=unit,
        target=picture("random", height, width), base=image, diffuse=0.5 * image,
        albedo=picture("grey", height, width), chain_uv=edge * mask, chain_mask=mask, chain_weight=mask,
        display=display,
    )  # fmt: skip


foregrounds = st.sampled_from(("black", "one pixel", "white", "random"))
bases = st.sampled_from(("black", "random", "hdr", "hdr pixel", "subnormal"))
MODELS = {
    "vanilla": {"modalities": "uv"},
    "concat": {"aggregator": "concat"},
    "residual": {"aggregator": "residual"},
    "early": {"aggregator": "early"},
    "mlp": {"base": "raster", "guides": True, "network": "mlp"},
    "baked": {"base": "baked", "guides": True, "chain": True, "stride": 2, "modalities": "uv", "filter": 3},
    "log": {"base": "baked", "guides": True, "chain": True, "output": "log", "aggregator": "residual"},
}


@pytest.mark.parametrize("name", MODELS)
@settings(deadline=None, max_examples=16, derandomize=True)
@given(height=sides, width=sides, foreground=foregrounds, base=bases, bfloat16=st.booleans(), shown=shown)
@example(height=8, width=8, foreground="black", base="hdr", bfloat16=False, shown="bright")
@example(height=13, width=23, foreground="one pixel", base="hdr", bfloat16=True, shown="lut")
@example(height=1, width=1, foreground="white", base="hdr pixel", bfloat16=True, shown="dark")
def test_the_whole_model(
    name: str, height: int, width: int, foreground: str, base: str, bfloat16: bool, shown: str,
    displays: dict[str, DisplayTransform],
) -> None:  # fmt: skip
    """Forward, all losses and backward through every kind of model: no pixel, weight or texel gets a NaN."""
    chosen = ModelSettings.model_validate(
        {"texture_size": 8, "texture_levels": 2, "texture_channels": 12, "width": 4, "depth": 2, **MODELS[name]}
    )
    model = DNR(chosen, seed=0)
    model.use_bfloat16 = bfloat16
    batch = batch_of(height, width, foreground, base, displays[shown])
    assert batch.target is not None
    total, _ = losses.Step2Loss(Step2Settings(loss=LossWeights(perceptual=0)), None)(
        model(batch), batch.target, np.random.default_rng(0), bfloat16=bfloat16
    )
    finite_with_gradients(total, *model.parameters())


@pytest.mark.parametrize("output", ["log", "display"])
@pytest.mark.parametrize("size", [1.0, 40.0, 100.0, 1e4, 1e9])
def test_a_correction_however_large(output: str, size: float, displays: dict[str, DisplayTransform]) -> None:
    """What the network adds after a learning-rate spike: the picture and all gradients stay finite."""
    chosen = ModelSettings.model_validate({"base": "raster", "output": output, "filter": 3})
    outputs = (size * (2 * picture("random", 7, 5, 15) - 1)).requires_grad_()
    for base in ("black", "hdr", "random"):
        rgb, radiance = correct(batch_of(7, 5, "white", base, displays["bright"]), outputs, chosen)
        value = rgb.clamp(-10, 10).mean() if radiance is None else rgb.mean() + radiance.clamp_max(1).mean()
        outputs.grad = None
        finite_with_gradients(value, outputs)


@quick
@given(value=st.floats(0, HDR, width=32))
@example(value=0.0)
@example(value=2.0**-149)
def test_log_space_there_and_back(value: float) -> None:
    x = torch.tensor(value, requires_grad=True)
    back = from_log(to_log(x))
    assert float(back.detach()) == pytest.approx(value, rel=1e-4, abs=1e-6)
    finite_with_gradients(back, x)


@quick
@given(kind=kinds, weights=st.sampled_from(("black", "hdr", "negative", "subnormal")), height=sides, width=sides)
def test_kernels(kind: str, weights: str, height: int, width: int) -> None:
    """Kernels sum to 1: no filtered pixel leaves its neighbours' range, however extreme their weights."""
    image = picture(kind, height, width).requires_grad_()
    steering = picture(weights, height, width, 9).requires_grad_()
    result = filter_by(image, steering)
    low, high = float(image.detach().min()), float(image.detach().max())
    slack = 1e-5 * max(abs(low), abs(high)) + 1e-43  # the weights' own rounding, the smallest subnormals
    assert low - slack <= float(result.detach().min()) and float(result.detach().max()) <= high + slack
    finite_with_gradients(result, image, steering)


@quick
@given(u=st.floats(-3, 3, width=32), v=st.floats(-3, 3, width=32), train=st.booleans())
@example(u=-1.0, v=1.0, train=True)
@example(u=1.0, v=-1.0, train=False)
@example(u=0.0, v=2.0**-149, train=False)
def test_texture_look_ups_at_seams_and_beyond(u: float, v: float, train: bool) -> None:
    """The atlas' rims, its outside (the border texel goes on) and texel borders; merged or level by level the same."""
    pyramid = TexturePyramid(8, 3, 4, dimensions=2, generator=torch.Generator().manual_seed(0))
    point = torch.tensor([[u, v]])
    if not train:
        with torch.no_grad():
            merged = pyramid.eval()(point)
            assert torch.allclose(merged, pyramid._summed(point), atol=1e-5)
            assert torch.allclose(merged, pyramid(point.clamp(-1, 1)), atol=1e-6)
        return
    point.requires_grad_()
    finite_with_gradients(pyramid(point), point, *pyramid.parameters())


@pytest.mark.parametrize("vector", [(0, 0, 0), (0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -1, 0), (1e-38, 0, -1), (1, 1, 0)])
def test_octahedral_map_at_its_seams(vector: tuple[float, float, float]) -> None:
    normal = torch.tensor([vector], dtype=torch.float32, requires_grad=True)
    mapped = octahedral(normal)
    assert float(mapped.detach().abs().max()) <= 1
    finite_with_gradients(mapped, normal)


@pytest.mark.parametrize("depth", [0.0, 1.0, SUBNORMAL])
def test_depth_texture_at_its_ends(depth: float) -> None:
    coordinate = depth_coordinate(torch.tensor([[depth]], requires_grad=True))
    pyramid = TexturePyramid(8, 2, 4, dimensions=1, generator=torch.Generator().manual_seed(0))
    finite_with_gradients(pyramid(coordinate), *pyramid.parameters())


@quick
@given(kind=kinds, cover=st.sampled_from(("black", "white", "random", "subnormal")), height=sides, width=sides)
def test_composition_and_harmonics(kind: str, cover: str, height: int, width: int) -> None:
    """No coverage is pure white whatever the network says; harmonics of a zero direction are finite."""
    rgb, coverage = picture(kind, height, width).requires_grad_(), picture(cover, height, width, 1)
    result = compose(rgb, coverage)
    if cover == "black":
        assert torch.equal(result.detach(), torch.ones_like(result))
    texture = picture(kind, height, width, 12).requires_grad_()
    finite_with_gradients(result.sum() + apply_harmonics(texture, torch.zeros(1, 3, height, width)).sum(), rgb, texture)

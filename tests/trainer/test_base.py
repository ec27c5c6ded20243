"""The base image and what comes with it: reading, guides, specular chain, residual in two spaces, half resolution."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import synthetic
import torch
from pydantic import ValidationError

from conftest import TEST, TRAIN, Scene
from dnrtrain.contract import ContractError, SceneFrame
from dnrtrain.correction import filter_by, from_log, to_log
from dnrtrain.dataset import DIHEDRAL_ORDER, Batch, ViewSet, load_views, view_in_memory
from dnrtrain.display import DisplayTransform
from dnrtrain.exr import read_exr, write_exr
from dnrtrain.model import DNR, compose, render, render_views
from dnrtrain.renderer import add_pointwise, planes
from dnrtrain.settings import ModelSettings

SMALL = {"texture_size": 16, "width": 4, "depth": 2, "aggregator": "residual", "modalities": "uv"}
WHOLE = ModelSettings.model_validate({**SMALL, "base": "baked", "guides": True, "chain": True, "stride": 2})


def load(scene: Scene, base: str, *, frame: SceneFrame = synthetic.FRAME) -> ViewSet:
    """The training views with ray-traced targets and the named base image."""
    views = synthetic.dome(TRAIN, 32)
    passes, images = ([scene.folder / kind / f"{v.name}.exr" for v in views] for kind in ("passes", "raytraced"))
    files = synthetic.write_bases(scene.folder, views) if base in ("baked", "path") else None
    return load_views(passes, images, frame, cameras=views, folder=scene.folder, base=base, base_files=files)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def baked(scene: Scene) -> ViewSet:
    return load(scene, "baked")


def base_over_white(batch: Batch) -> torch.Tensor:
    assert batch.base is not None and batch.display is not None
    return compose(batch.display(batch.base), batch.coverage)


def test_base_files_are_read_straight(scene: Scene, baked: ViewSet) -> None:
    channels, _ = read_exr(scene.folder / "base" / "0002.exr")
    batch = baked.batch([2])
    assert batch.base is not None and batch.diffuse is not None and batch.albedo is not None
    assert batch.chain_uv is not None and batch.chain_mask is not None and batch.chain_weight is not None
    edge = (channels["base.A"] > 0) & (channels["base.A"] < 1)
    assert edge.any()
    assert np.allclose(batch.base[0, 1].numpy()[edge], (channels["base.G"] / channels["base.A"].clip(1e-6))[edge])
    assert np.allclose(batch.albedo[0].numpy()[:, channels["base.A"] > 0], 0.5, atol=1e-6)
    found = channels["chain.mask"] > 0
    assert found.any() and (batch.chain_weight[0, 0].numpy() == np.where(found, np.float32(0.7), 0)).all()
    assert np.allclose(batch.chain_uv[0, 0].numpy(), np.where(found, 2 * channels["chain.U"] - 1, 0), atol=1e-6)


@pytest.mark.parametrize("base", ["none", "raster", "baked"])
def test_a_view_in_memory_is_as_one_from_files(scene: Scene, base: str) -> None:
    """The same maps from arrays and from files; and the same refusals."""
    whole, view = load(scene, base), synthetic.dome(TRAIN, 32)[2]
    channels, _ = read_exr(scene.folder / "passes" / "0002.exr")
    if base == "baked":
        channels |= read_exr(scene.folder / "base" / "0002.exr")[0]
    display = DisplayTransform(synthetic.FRAME, scene.folder)
    found = view_in_memory(channels, synthetic.FRAME, view, display=display, base=base)  # type: ignore[arg-type]
    expected = whole.batch([whole.index("0002")])
    for field in dataclasses.fields(Batch):
        one, other = getattr(found.tensors, field.name), getattr(expected, field.name)
        if isinstance(other, torch.Tensor) and field.name != "target":
            assert torch.equal(one, other), field.name
        elif field.name != "target":
            assert (one is None) == (other is None), field.name
    assert found.names == ("0002",) and found.tensors.target is None
    with pytest.raises(ContractError, match="missing"):
        view_in_memory(
            {k: v for k, v in channels.items() if k != "uv.U"}, synthetic.FRAME, view, display=display, base="none"
        )
    with pytest.raises(ContractError, match="32x32, its camera 16x32"):
        view_in_memory(channels, synthetic.FRAME, view.model_copy(update={"width": 16}), display=display, base="none")


@pytest.mark.parametrize("output", ["log", "display"])
def test_where_none_of_the_correction_is_applied_no_network_runs(baked: ViewSet, output: str) -> None:
    settings = ModelSettings.model_validate({**WHOLE.model_dump(), "output": output, "trust": 0.0})
    model = DNR(settings, seed=0)
    torch.nn.init.normal_(model.renderer.head.weight)
    with torch.inference_mode():
        expected = model(baked.tensors)
    model._render = None  # type: ignore[method-assign, assignment]
    found = render(model, baked)
    assert torch.equal(found.rgb, expected.rgb.clamp(0, 1))
    if output == "log":
        assert found.radiance is not None and expected.radiance is not None
        assert torch.equal(found.radiance, expected.radiance)


def test_the_raster_colour_as_base(scene: Scene) -> None:
    batch = load(scene, "raster").batch([1])
    assert scene.raster.tensors.target is not None
    assert torch.allclose(base_over_white(batch), scene.raster.tensors.target[1:2], atol=1e-5)
    assert batch.albedo is batch.diffuse is batch.chain_uv is None
    assert scene.traced.tensors.base is None and scene.traced.tensors.display is None


def test_the_normal_in_camera_space_turns_with_the_picture(baked: ViewSet) -> None:
    batch = baked.batch([2]).crop(2, 2, 12)  # of the whole view, what points right and left would cancel out
    assert batch.camera_normal is not None
    axes = torch.from_numpy(baked.c2w[2, :3, :3].astype(np.float32))
    assert torch.allclose(torch.einsum("ij,jhw->ihw", axes, batch.camera_normal[0]), batch.normal[0], atol=1e-6)
    right, up = (float(batch.camera_normal[0, i].sum()) for i in range(2))
    assert abs(right - up) > 1 and abs(right) > 1
    for element, expected in {1: (-up, right), 2: (-right, -up), 3: (up, -right), 4: (-right, up)}.items():
        turned = batch.augment(element).camera_normal
        assert turned is not None
        assert [float(turned[0, i].sum()) for i in range(2)] == pytest.approx(expected, rel=1e-4)


def test_augment_crop_and_subset_move_the_new_maps_alike(baked: ViewSet) -> None:
    batch = baked.batch([2])

    def rows(part: Batch) -> torch.Tensor:
        maps = [part.uv, part.base, part.diffuse, part.albedo, part.chain_uv, part.chain_mask, part.chain_weight]
        maps += [part.noise, part.rays]
        stack = torch.cat([m for m in maps if m is not None], dim=1)
        assert stack.shape[1] == 17
        return stack[0].flatten(1).t()

    for element in range(DIHEDRAL_ORDER):
        before, after = rows(batch), rows(batch.augment(element))
        assert torch.equal(before[np.lexsort(before.numpy().T)], after[np.lexsort(after.numpy().T)])
    window = batch.crop(3, 5, 8)
    assert window.target is not None and batch.target is not None and window.base is not None
    assert torch.equal(window.target, batch.target[..., 3:11, 5:13]) and window.base.shape[-2:] == (8, 8)
    assert window.display is batch.display is baked.subset([4, 2]).tensors.display
    assert torch.equal(rows(baked.subset([4, 2]).batch([1])), rows(batch))


@pytest.mark.parametrize("output", ["display", "log"])
@pytest.mark.parametrize("network", [{"stride": 1}, {"stride": 2}, {"network": "mlp"}])
@pytest.mark.parametrize("base", ["raster", "baked"])
def test_training_starts_at_the_base_image(scene: Scene, base: str, network: dict, output: str) -> None:
    views = load(scene, base)
    parts = {"base": base, "guides": True, "chain": base == "baked", "output": output}
    model = DNR(ModelSettings.model_validate({**SMALL, **parts, **network}), seed=0)
    out = model(views.batch([0, 3]))
    assert torch.allclose(out.rgb, base_over_white(views.batch([0, 3])), atol=1e-4)
    assert (out.radiance is None) == (output == "display")


def test_every_part_learns(baked: ViewSet) -> None:
    """After one step away from zero, gradients reach all weights, those behind the chain too."""
    for settings in (
        WHOLE,
        WHOLE.model_copy(update={"output": "log", "filter": 3}),
        WHOLE.model_copy(update={"network": "mlp"}),
    ):
        model = DNR(settings, seed=0)
        with torch.no_grad():
            model.renderer.head.weight.add_(0.01)
        batch = baked.batch([0])
        assert batch.target is not None
        (model(batch).rgb - batch.target).square().sum().backward()
        for name, parameter in model.named_parameters():
            assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_the_chain_looks_up_what_it_reaches(baked: ViewSet) -> None:
    """Texels under the disk's mirror image change the sphere's pixels only through the chain."""
    batch = baked.batch([1])
    assert batch.chain_mask is not None and batch.chain_weight is not None
    model = DNR(WHOLE, seed=0)
    seen = model.aggregator.at_chain(batch)
    assert (seen * (1 - batch.chain_mask) == 0).all()
    swapped = dataclasses.replace(batch, uv=batch.chain_uv, mask=batch.chain_mask)
    inside = batch.chain_mask.expand_as(seen) > 0.5
    expected = model.aggregator(swapped, bfloat16=False)[0][inside] * 0.7
    assert torch.allclose(seen[inside], expected, atol=1e-6)


def test_log_space_keeps_highlights() -> None:
    values = torch.tensor([0.0, 1e-4, 0.2, 1.0, 50.0, 4000.0])
    assert torch.allclose(from_log(to_log(values)), values, rtol=1e-4, atol=1e-6)
    assert to_log(torch.ones(1)) == pytest.approx(1.0)
    frame = synthetic.FRAME.model_copy(update={"exposure": 1.0})
    maps = torch.rand(1, 3, 8, 8)
    radiance = 100 * torch.rand(1, 3, 8, 8)
    one = torch.ones(1, 1, 8, 8)
    display = DisplayTransform(frame, Path())
    batch = Batch(maps[:, :2], one, maps, one, one, maps, None, base=radiance, display=display)
    settings = ModelSettings.model_validate({**SMALL, "base": "raster", "guides": True, "output": "log"})
    out = DNR(settings, seed=0)(batch)
    assert torch.allclose(out.radiance, radiance, rtol=1e-3) and out.rgb.max() <= 1


def test_radiance_of_whole_view_sets(baked: ViewSet) -> None:
    views = baked.subset([0, 1, 2])
    hdr = DNR(WHOLE.model_copy(update={"output": "log"}), seed=0)
    radiance = render(hdr, views, batch=2).radiance
    assert radiance is not None and views.tensors.base is not None and views.tensors.display is not None
    assert torch.allclose(radiance, views.tensors.base, rtol=1e-3, atol=1e-5)
    over_white = compose(views.tensors.display(radiance), views.tensors.coverage)
    assert torch.allclose(over_white, render_views(hdr, views), atol=1e-5)
    assert render(DNR(WHOLE, seed=0), views).radiance is None


@pytest.mark.parametrize("side", [3, 5])
def test_kernels_smooth_as_convolutions_do(side: int) -> None:
    """One kernel for all pixels is a convolution with it; none given, nearly the identity; a flat image stays."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, 3, 9, 7, generator=generator)
    weights = torch.rand(side * side, generator=generator)
    ahead = torch.zeros(side * side)
    ahead[side * side // 2] = 4.0
    kernel = (weights + ahead).softmax(0).view(1, 1, side, side).expand(3, 1, side, side)
    padded = torch.nn.functional.pad(image, (side // 2,) * 4, mode="replicate")
    expected = torch.nn.functional.conv2d(padded, kernel, groups=3)
    assert torch.allclose(filter_by(image, weights.view(1, -1, 1, 1).expand(2, -1, 9, 7)), expected, atol=1e-6)
    none = torch.zeros(2, side * side, 9, 7)
    assert (filter_by(image, none) - image).abs().mean() < 0.15
    assert torch.allclose(filter_by(torch.full_like(image, 0.3), none), torch.tensor(0.3))


@pytest.mark.parametrize("output", ["display", "log"])
def test_the_filter_smooths_the_base(baked: ViewSet, output: str) -> None:
    """Before any training: kernels near the identity, so a picture near the base image, and smoother."""
    batch = baked.batch([1])
    rgb = DNR(WHOLE.model_copy(update={"filter": 3, "output": output}), seed=0)(batch).rgb
    base = base_over_white(batch)
    assert 0 < (rgb - base).abs().mean() < 0.03
    assert rgb.diff(dim=-1).abs().mean() < base.diff(dim=-1).abs().mean()


@pytest.mark.parametrize(("height", "width", "depth"), [(1, 1, 3), (7, 13, 2), (33, 50, 3), (64, 64, 1)])
def test_half_resolution_takes_any_size(height: int, width: int, depth: int) -> None:
    maps = torch.rand(2, 3, height, width)
    one = torch.ones(2, 1, height, width)
    batch = Batch(maps[:, :2], one, maps, one, one, maps, None)
    settings = ModelSettings.model_validate({**SMALL, "depth": depth, "stride": 2, "guides": True})
    out = DNR(settings, seed=0)(batch)
    assert out.rgb.shape == (2, 3, height, width) and torch.isfinite(out.rgb).all()


def test_pointwise_layers_equal_convolutions() -> None:
    """They read and write other memory layouts than the convolutions that they stand for, and compute the same."""
    generator = torch.Generator().manual_seed(0)
    maps, total = (torch.randn(2, channels, 5, 7, generator=generator) for channels in (6, 4))
    total = total.contiguous(memory_format=torch.channels_last)
    plain, biased = torch.nn.Conv2d(6, 4, 1, bias=False), torch.nn.Conv2d(4, 3, 1)
    assert torch.allclose(add_pointwise(total, plain, maps), total + plain(maps), atol=1e-5)
    assert add_pointwise(total, plain, maps).is_contiguous(memory_format=torch.channels_last)
    assert torch.allclose(planes(biased, total), biased(total), atol=1e-5)
    assert planes(biased, total).is_contiguous()


@pytest.mark.parametrize(("bfloat16", "tolerance"), [(False, 1e-5), (True, 0.03)])
def test_inference_equals_training(baked: ViewSet, bfloat16: bool, tolerance: float) -> None:
    """Without gradients textures are sampled in another way; bfloat16 may round the last bit otherwise."""
    model = DNR(WHOLE.model_copy(update={"filter": 3, "output": "log"}), seed=0)
    model.use_bfloat16 = bfloat16
    with torch.no_grad():
        model.renderer.head.weight.add_(0.05)
        inferred = model.eval()(baked.batch([0, 3]))
    assert model.aggregator.texture_uv._merged is not None
    trained = model.train()(baked.batch([0, 3]))
    assert (inferred.texture - trained.texture).abs().max() < 1e-6
    assert (inferred.rgb - trained.rgb).abs().max() < tolerance
    assert (inferred.rgb - trained.rgb).abs().mean() < tolerance / 30


def test_the_mlp_sees_one_pixel_and_the_half_net_its_neighbours(baked: ViewSet) -> None:
    batch = baked.batch([0])
    assert batch.base is not None
    changed = batch.base.clone()
    changed[..., 16, 16] += 1.0
    for settings, reach in ((WHOLE.model_copy(update={"network": "mlp"}), 1), (WHOLE, 9)):
        model = DNR(settings, seed=0)
        with torch.no_grad():
            model.renderer.head.weight.add_(0.1)
        difference = model(batch).rgb - model(dataclasses.replace(batch, base=changed)).rgb
        touched = (difference.abs().sum(1) > 1e-6).sum()
        assert touched == reach if reach == 1 else touched >= reach


def test_refusals(scene: Scene, baked: ViewSet, tmp_path: Path) -> None:
    with pytest.raises(ContractError, match="without"):
        DNR(WHOLE, seed=0)(scene.traced.batch([0]))
    bare = dataclasses.replace(baked.tensors, chain_uv=None)
    with pytest.raises(ContractError, match="specular paths"):
        DNR(WHOLE, seed=0)(bare)
    view = synthetic.dome(TRAIN, 32)[0]
    passes, images = ([scene.folder / kind / f"{view.name}.exr"] for kind in ("passes", "raytraced"))

    def attempt(files: list[Path] | None, base: str = "baked") -> None:
        load_views(passes, images, synthetic.FRAME, cameras=[view], folder=tmp_path, base=base, base_files=files)  # type: ignore[arg-type]

    with pytest.raises(ContractError, match="no base files"):
        attempt(None)
    with pytest.raises(ContractError, match="must agree"):
        attempt([tmp_path / "a.exr"], "raster")
    with pytest.raises(ContractError, match="must agree"):
        attempt([tmp_path / "a.exr", tmp_path / "b.exr"])
    with pytest.raises(ContractError, match="no such file"):
        attempt([tmp_path / "a.exr"])
    channels = synthetic.base(view)
    write_exr(tmp_path / "less.exr", {k: v for k, v in channels.items() if k != "chain.U"}, {})
    with pytest.raises(ContractError, match=r"chain\.U are missing; delete it"):
        attempt([tmp_path / "less.exr"])
    broken = {k: np.ascontiguousarray(v * np.nan, dtype=np.float32) for k, v in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, broken) as file:  # our own writer refuses
        file.write(str(tmp_path / "nan.exr"))
    with pytest.raises(ContractError, match="non-finite"):
        attempt([tmp_path / "nan.exr"])


def test_settings_that_contradict_each_other() -> None:
    for wrong in ({"chain": True}, {"chain": True, "base": "raster"}, {"output": "log"}, {"filter": 3}):
        with pytest.raises(ValidationError, match="base"):
            ModelSettings.model_validate(wrong)
    with pytest.raises(ValidationError, match="neural texture"):
        ModelSettings(chain=True, base="baked", aggregator="early")
    coarse = WHOLE.coarse()
    assert (coarse.base, coarse.guides, coarse.chain, coarse.stride) == ("none", False, False, 2)
    assert ModelSettings().coarse() == ModelSettings()


def test_bfloat16_is_close(baked: ViewSet) -> None:
    model = DNR(WHOLE, seed=0)
    with torch.no_grad():
        model.renderer.head.weight.add_(0.05)
        exact = render_views(model, baked, batch=TEST)
        model.use_bfloat16 = True
        coarse = render_views(model, baked)
    assert not torch.equal(exact, coarse) and (exact - coarse).abs().max() < 0.05


def test_a_frame_that_remembers_is_mixed_with_the_frame_itself(scene: Scene) -> None:
    """Read from its channels; by g alone the picture goes from what is remembered to what the frame saw."""
    view = synthetic.dome(TRAIN, 32)[2]
    channels = {
        k: v for folder in ("passes", "base") for k, v in read_exr(scene.folder / folder / "0002.exr")[0].items()
    }
    own = {f"fresh.{c}": 0.5 * channels[f"base.{c}"] for c in "RGB"} | {"fresh.rays": 0 * channels["rays"] + 2}
    display = DisplayTransform(synthetic.FRAME, scene.folder)
    alone, both = (
        view_in_memory(c, synthetic.FRAME, view, display=display, base="baked").batch([0])
        for c in (channels, channels | own)
    )
    assert alone.fresh is None and both.fresh is not None and both.fresh_rays is not None
    assert torch.allclose(both.fresh, 0.5 * both.base) and (both.fresh_rays == 2).all()
    settings = ModelSettings.model_validate(
        {**SMALL, "aggregator": "none", "base": "baked", "guides": "camera", "filter": 3, "output": "log", "stride": 2}
    )
    model = DNR(settings, seed=0).eval()
    shown = {}
    with torch.inference_mode():
        for bias in (-40.0, 40.0):
            model.renderer.head.bias.data[-1] = bias  # type: ignore[union-attr]
            shown[bias] = model(both).radiance
        still = model(alone).radiance
        halved = model(dataclasses.replace(alone, base=both.fresh)).radiance
    assert torch.allclose(shown[-40.0], still, atol=1e-6) and torch.allclose(shown[40.0], halved, atol=1e-6)
    assert not torch.allclose(shown[-40.0], shown[40.0], atol=1e-3)

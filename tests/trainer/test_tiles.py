"""Pictures in tiles: those of the whole, whatever the network, the size and the tiles."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch

from dnrtrain import model as model_module
from dnrtrain.dataset import ViewSet, view_in_memory
from dnrtrain.display import DisplayTransform
from dnrtrain.model import DNR, Output, render
from dnrtrain.settings import ModelSettings
from dnrtrain.shipped import corrector
from dnrtrain.tiles import Tile, tiles

BASE = {"base": "baked", "guides": "camera", "filter": 3, "output": "log", "modalities": "uv"}
NETWORKS = {
    "half": {"stride": 2, "chain": True, "aggregator": "residual", **BASE, "modalities": "uv+normal"},
    "paper": {"aggregator": "concat"},
    "early": {"aggregator": "early", "base": "raster", "guides": True},
    "pixels": {"network": "mlp", "aggregator": "residual", **BASE},
}


def view(height: int, width: int) -> ViewSet:
    """The analytic scene with grain in its base image, whose last rows and columns are surfaces, too."""
    camera = synthetic.look_at(np.array([1.4, -1.2, 1.9]), height, "v", width=width)
    channels = synthetic.gbuffer(camera) | synthetic.base(camera) | synthetic.render(camera, raytraced=False)
    random = np.random.default_rng(0)
    for name in (*"RGB", "base.R", "base.G", "base.B", "noise"):
        channels[name] = channels[name] * random.random((height, width))
    channels |= {f"fresh.{c}": channels[f"base.{c}"] * random.random((height, width)) for c in "RGB"}
    channels["fresh.rays"] = np.full((height, width), 2.0)
    channels = {name: plane.astype(np.float32) for name, plane in channels.items()}
    display = DisplayTransform(synthetic.FRAME, Path())
    found = view_in_memory(channels, synthetic.FRAME, camera, display=display, base="baked")
    assert found.tensors.mask[..., -1].any() and found.tensors.mask[..., -1, :].any()
    return found


def random_model(name: str) -> DNR:
    """All weights at random, those that start at zero, too."""
    model = DNR(ModelSettings.model_validate({"texture_size": 32, "width": 8, "depth": 2, **NETWORKS[name]}), seed=1)
    generator = torch.Generator().manual_seed(2)
    for parameter in model.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.1, generator=generator)
    return model.eval()


def rendered(model: DNR, views: ViewSet, pixels: int, monkeypatch: pytest.MonkeyPatch) -> Output:
    monkeypatch.setattr(model_module, "TILE_PIXELS", pixels)
    return render(model, views)


def difference(one: Output, other: Output) -> float:
    """The greatest, of pictures absolute, of radiance relative where it is above 1."""
    found = float((one.rgb - other.rgb).abs().max())
    if one.radiance is not None and other.radiance is not None:
        off = (one.radiance - other.radiance).abs() / one.radiance.clamp_min(1.0)
        found = max(found, float(off.max()))
    return found


def span(part: slice) -> int:
    return part.stop - part.start


@pytest.mark.parametrize(
    ("height", "width", "alignment", "reach", "pixels"),
    [(1, 1, 16, 78, 1), (91, 203, 8, 20, 5000), (2160, 3840, 16, 78, 1 << 21), (64, 9000, 32, 160, 1 << 17)],
)
def test_tiles_cover_every_pixel_once_and_see_enough(
    height: int, width: int, alignment: int, reach: int, pixels: int
) -> None:
    count = np.zeros((height, width), int)
    found = tiles(height, width, alignment=alignment, reach=reach, pixels=pixels)
    for tile in found:
        count[tile.rows, tile.columns] += 1
        assert span(tile.seen_rows) * span(tile.seen_columns) <= pixels
        for size, own, seen in ((height, tile.rows, tile.seen_rows), (width, tile.columns, tile.seen_columns)):
            assert seen.start % alignment == 0 and (seen.stop % alignment == 0 or seen.stop == size)
            assert own.start - seen.start >= reach or seen.start == 0
            assert seen.stop - own.stop >= reach or seen.stop == size
    assert (count == 1).all() and (len(found) > 1 or pixels == 1)


def test_a_picture_that_fits_is_one_tile() -> None:
    assert tiles(720, 1280, alignment=16, reach=78, pixels=1 << 20) == [
        Tile(*[slice(0, 720)] * 2, *[slice(0, 1280)] * 2)
    ]


@pytest.mark.parametrize("name", NETWORKS)
def test_tiles_show_no_seam(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At a size that is no multiple of anything; and what the halo is for: a smaller one shows."""
    model, views = random_model(name), view(131, 203)
    whole = rendered(model, views, 1 << 20, monkeypatch)
    assert float(whole.rgb.std()) > 0.05
    pixels = 3000 if name == "pixels" else 9000
    plan = tiles(131, 203, alignment=model.renderer.alignment, reach=model.reach, pixels=pixels)
    assert len({tile.rows.start for tile in plan}) > 1 and len({tile.columns.start for tile in plan}) > 2
    parts = rendered(model, views, pixels, monkeypatch)
    assert difference(whole, parts) <= 1e-5
    short = math.floor((model.reach - 1) / model.renderer.alignment) * model.renderer.alignment
    monkeypatch.setattr(DNR, "reach", short)
    assert difference(whole, rendered(model, views, pixels, monkeypatch)) > 1e-4


@pytest.mark.parametrize(("precision", "bound"), [("float32", 1e-5), ("bfloat16", 1e-2)])
def test_tiles_of_the_shipped_corrector(precision: str, bound: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """bfloat16: bits are equal with oneDNN; the bound is that of its rounding elsewhere."""
    model, views = corrector(precision=precision), view(211, 310)
    whole = rendered(model, views, 1 << 20, monkeypatch)
    assert difference(whole, rendered(model, views, 40000, monkeypatch)) <= bound
    assert len(tiles(211, 310, alignment=16, reach=model.reach, pixels=40000)) > 3

"""Pyramids, harmonics and the aggregator against their readable twin; properties of the mappings."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import reference
import torch

from conftest import Scene
from dnrtrain.aggregator import Inside
from dnrtrain.model import DNR, compose
from dnrtrain.settings import ModelSettings
from dnrtrain.textures import (
    TexturePyramid,
    apply_harmonics,
    depth_coordinate,
    octahedral,
    spherical_harmonics,
)


def random_directions(count: int, seed: int = 0) -> torch.Tensor:
    vectors = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return vectors / vectors.norm(dim=1, keepdim=True)


def test_aggregator_equals_the_reference(scene: Scene) -> None:
    settings = ModelSettings(texture_size=16, texture_levels=3, width=4, depth=1, aggregator="concat")
    model = DNR(settings, seed=3)
    batch = scene.traced.batch([1])
    everywhere = random_directions(32 * 32).t().reshape(1, 3, 32, 32) * batch.mask  # both hemispheres
    batch = dataclasses.replace(batch, normal=everywhere)
    with torch.no_grad():
        texture, shaded = model.eval().aggregator(batch, bfloat16=False)
    weights = {name: value.double().numpy() for name, value in model.state_dict().items()}
    view = {k: getattr(batch, k)[0].double().numpy() for k in ("uv", "depth", "normal", "mask")}
    expected = reference.spatial_texture(weights, 3, view)
    assert expected.std() > 1e-3
    assert np.abs(texture[0].numpy() - expected).max() < 1e-5
    twin = reference.view_dependent(expected, batch.view_dir[0].double().numpy())
    assert np.abs(shaded[0].numpy() - twin).max() < 1e-5


def test_composition_equals_the_reference(scene: Scene) -> None:
    batch = scene.traced.batch([0])
    rgb = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    expected = reference.over_white(rgb[0].numpy(), batch.coverage[0].numpy())
    assert np.abs(compose(rgb, batch.coverage)[0].numpy() - expected).max() < 1e-6


def test_harmonics_are_orthonormal() -> None:
    """∫ Y_i Y_j dω = δ_ij, by Monte Carlo over 400,000 directions."""
    values = spherical_harmonics(random_directions(400_000).t()[None, :, None])[0, :, 0].double()
    gram = 4 * np.pi * values @ values.t() / values.shape[1]
    assert torch.allclose(gram, torch.eye(9, dtype=torch.float64), atol=0.02)


def test_only_channels_four_to_twelve_are_shaded() -> None:
    texture = torch.ones(1, 16, 1, 1)
    shaded = apply_harmonics(texture, torch.tensor([0.0, 0.6, 0.8]).view(1, 3, 1, 1)).flatten()
    assert (shaded[:3] == 1).all() and (shaded[12:] == 1).all() and (shaded[3:12] != 1).all()


def test_octahedral_is_injective_and_fills_the_square() -> None:
    directions = random_directions(20_000)
    points = octahedral(directions)
    assert points.abs().max() <= 1.0 and points.min() < -0.98 and points.max() > 0.98
    # inverse map
    x, y = points.unbind(1)
    z = 1 - x.abs() - y.abs()
    fold = z < 0
    back_x = torch.where(fold, (1 - y.abs()) * x.sign(), x)
    back_y = torch.where(fold, (1 - x.abs()) * y.sign(), y)
    back = torch.stack([back_x, back_y, z], 1)
    assert torch.allclose(back / back.norm(dim=1, keepdim=True), directions, atol=1e-5)
    assert torch.isfinite(octahedral(torch.zeros(1, 3))).all()


@pytest.mark.parametrize("dimensions", [1, 2])
def test_levels_are_summed_and_reach_the_border(dimensions: int) -> None:
    pyramid = TexturePyramid(8, 4, 2, dimensions=dimensions, generator=torch.Generator().manual_seed(0))
    assert [level.shape[-1] for level in pyramid.levels] == [8, 4, 2, 1]
    with torch.no_grad():
        for value, level in enumerate(pyramid.levels):
            level.fill_(10.0**value)
    points = torch.tensor([[-1.0, 0.0], [1.0, 0.0], [0.3, 0.0]])
    assert torch.allclose(pyramid(points), torch.full((3, 2), 1111.0))


def test_depth_texture_orders_by_depth() -> None:
    pyramid = TexturePyramid(8, 1, 1, dimensions=1, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        pyramid.levels[0].copy_(torch.arange(8.0).view(1, 1, 1, 8))
    depth = torch.tensor([[0.0], [0.5], [1.0]])
    assert torch.allclose(pyramid(depth_coordinate(depth))[:, 0], torch.tensor([0.0, 3.5, 7.0]))


def test_texels_are_seeded_and_small() -> None:
    def build(seed: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        return TexturePyramid(16, 2, 4, dimensions=2, generator=generator).levels[0].detach()

    assert torch.equal(build(1), build(1)) and not torch.equal(build(1), build(2))
    assert 0 < build(1).abs().max() <= 0.05


def test_gather_and_scatter_are_inverse(scene: Scene) -> None:
    batch = scene.traced.batch([0, 3])
    inside = Inside(batch.mask)
    assert torch.equal(inside.scatter(inside.gather(batch.normal)), batch.normal)


@pytest.mark.parametrize("dimensions", [1, 2])
@pytest.mark.parametrize(("size", "levels", "merges"), [(16, 4, True), (8, 4, True), (5, 1, True), (12, 4, False)])
def test_merged_levels_sample_as_the_sum_does(size: int, levels: int, merges: bool, dimensions: int) -> None:
    """To float32 rounding: between texels, on centres, at and beyond the border; and after every change of a texel."""
    pyramid = TexturePyramid(size, levels, 3, dimensions=dimensions, generator=torch.Generator().manual_seed(0))
    random = 2.4 * torch.rand(500, 2, generator=torch.Generator().manual_seed(1)) - 1.2
    knots = torch.linspace(-1.0, 1.0, 2 * size + 1)
    points = torch.cat([random, torch.cartesian_prod(knots, knots)])
    optimiser = torch.optim.Adam(pyramid.parameters(), lr=0.1, fused=True)

    def difference() -> float:
        with torch.no_grad():
            return float((pyramid(points) - plain).abs().max())

    for _ in range(2):
        plain = pyramid.eval()(points)
        assert difference() < 1e-6 and plain.std() > 0.01
        pyramid.train()(points).square().sum().backward()
        optimiser.step()
    plain = pyramid.eval()(points)
    assert difference() < 1e-6
    before = pyramid._merged
    assert difference() < 1e-6 and pyramid._merged is before
    pyramid.load_state_dict({name: 2.0 * texels for name, texels in pyramid.state_dict().items()})
    assert difference() > 0.01
    plain = pyramid(points)
    assert difference() < 1e-6
    assert pyramid.mergeable == merges == (pyramid._merged is not None)

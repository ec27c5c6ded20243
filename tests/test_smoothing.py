"""Smoothing over tiles: noise goes, edges stay, and nothing crosses from one object to another."""

from __future__ import annotations

import numpy as np
import pytest

from dnrpipe.raytrace.recorded import aligned
from dnrpipe.raytrace.sequence import ORDER, TILE
from dnrpipe.raytrace.smoothing import Smoother

mi = pytest.importorskip("mitsuba")
WIDTH, HEIGHT, SIGMA = 60, 36, 0.05


@pytest.fixture(autouse=True)
def _variant(mitsuba_variant: str) -> None:
    if mitsuba_variant.startswith("scalar"):
        pytest.skip("smoothing needs a jit variant of Mitsuba; this machine has none")


def wall(specular: np.ndarray, noise: float = SIGMA) -> dict[str, np.ndarray]:
    """A wall that fills the picture: grey under ``specular`` [H, W], whose standard error is ``noise``."""
    flat = np.ones((HEIGHT, WIDTH), np.float32)
    channels = {f"base.{c}": (0.3 + specular).astype(np.float32) for c in "RGB"}
    channels |= {f"diffuse.{c}": 0.3 * flat for c in "RGB"} | {"normal.X": 0 * flat, "normal.Y": 0 * flat}
    return channels | {"normal.Z": flat, "object.Id": flat, "mask": flat, "noise": noise * flat}


def test_grain_goes_and_edges_beyond_it_stay() -> None:
    rng = np.random.default_rng(0)
    truth = np.where(np.arange(WIDTH) < WIDTH // 2, 0.5, 2.5) * np.ones((HEIGHT, 1))
    noisy = truth + SIGMA * rng.normal(size=truth.shape)
    smooth = Smoother(mi)(wall(noisy))["base.R"] - 0.3
    assert np.std(smooth - truth) < 0.6 * SIGMA
    assert np.abs(smooth - truth).max() < 4 * SIGMA, "the edge is forty times the noise"


def test_the_pattern_of_the_tiles_goes() -> None:
    """Each pixel of a tile has other samples of the same sequences: their mean is what all of them say."""
    tiles = (ORDER - ORDER.mean()) / ORDER.std()
    pattern = np.tile(tiles, (HEIGHT // TILE, WIDTH // TILE)) * 0.2 * SIGMA
    smooth = Smoother(mi)(wall(1 + pattern))["base.G"] - 1.3
    assert np.std(smooth[1:-1, 1:-1]) < 0.02 * np.std(pattern)


def test_nothing_crosses_from_one_object_to_another() -> None:
    """Nor where normals differ, nor into pixels of no object; light without noise stays as it is."""
    left = np.arange(WIDTH) < WIDTH // 2
    light = np.where(left, 1.0, 1.02) * np.ones((HEIGHT, 1))
    smoother = Smoother(mi)
    for apart in (
        {"object.Id": np.where(left, 1, 2)},
        {"normal.Z": np.where(left, 1, 0), "normal.X": np.where(left, 0, 1)},
        {"mask": np.where(left, 1, 0)},
    ):
        planes = {name: (values * np.ones((HEIGHT, 1))).astype(np.float32) for name, values in apart.items()}
        found = smoother(wall(light) | planes)["base.B"]
        assert np.abs(found - 0.3 - light).max() < 1e-5
    together = smoother(wall(light))["base.B"]
    assert np.abs(together - 0.3 - light).max() > 0.005, "on one object it does"
    clean = smoother(wall(light, noise=0.0))["base.B"]
    assert np.abs(clean - 0.3 - light).max() < 1e-5


def test_channels_in_one_memory_are_read_apart_when_they_are_not() -> None:
    """Recorded with the normal, the object and the mask in one plane, then called with another normal."""
    left = np.arange(WIDTH) < WIDTH // 2
    light = np.where(left, 1.0, 1.02) * np.ones((HEIGHT, 1))
    one = aligned(np.ones((HEIGHT, WIDTH))).reshape(HEIGHT, WIDTH)
    shared = wall(light) | {"normal.Z": one, "object.Id": one, "mask": one}
    turned = {"normal.Z": one * left, "normal.X": one * ~left}
    smoother = Smoother(mi)
    assert np.abs(smoother(shared)["base.B"] - 0.3 - light).max() > 0.005, "one object"
    assert np.abs(smoother(shared | turned)["base.B"] - 0.3 - light).max() < 1e-5

"""What views see of the atlas, and that baked light spends its samples there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.corner_room import corner_room, onwards, rgb

from dnrpipe.core.cameras import look_at_view
from dnrpipe.core.settings import CameraSettings
from dnrpipe.raytrace.gathering import GatheringBaker
from dnrpipe.raytrace.lightmap import LightBaker
from dnrpipe.raytrace.seen_texels import CELLS, pixels_of_cells
from dnrtrain.contract import View

mi = pytest.importorskip("mitsuba")
FLOOR, WALL = (slice(3, 12), slice(3, 12)), (slice(3, 12), slice(19, 28))
"""Texels of the charts, of a map of 32²."""
GREY = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(0.5, 0.5, 0.5)}}
MIRROR = {"type": "twosided", "b": {"type": "conductor", "specular_reflectance": rgb(0.9, 0.9, 0.9)}}


@pytest.fixture(autouse=True)
def _variant(mitsuba_variant: str) -> None:
    if mitsuba_variant.startswith("scalar"):
        pytest.skip("baked light needs a jit variant of Mitsuba; this machine has none")


def looking(eye: tuple[float, float, float], target: tuple[float, float, float]) -> View:
    """Eleven degrees across."""
    return look_at_view("v", np.array(eye), np.array(target), 320.0, CameraSettings(width=64, height=64))


def share(cells: np.ndarray, chart: tuple[slice, slice]) -> float:
    each = CELLS // 32
    rows, columns = (slice(part.start * each, part.stop * each) for part in chart)
    return float((cells[rows, columns] > 0).mean())


def test_a_view_sees_what_is_before_it_and_what_a_mirror_shows(tmp_path: Path) -> None:
    scene = corner_room(tmp_path, GREY, MIRROR, {"type": "constant"})
    down = pixels_of_cells(mi, scene, [looking((0, -0.01, 5), (0, 0, 0))], 1.0)
    assert 0.1 < share(down, FLOOR) < 0.9 and share(down, WALL) == 0
    at_mirror = looking((0, -1.5, 1.5), (0, 1, 0.8))  # what comes back meets the floor
    across = pixels_of_cells(mi, scene, [at_mirror], 1.0)
    assert share(across, WALL) > 0.1 and share(across, FLOOR) > 0.05
    matt = pixels_of_cells(mi, corner_room(tmp_path, GREY, GREY, {"type": "constant"}), [at_mirror], 1.0)
    assert share(matt, WALL) > 0.1 and share(matt, FLOOR) == 0
    assert not pixels_of_cells(mi, scene, [], 1.0).any()


@pytest.mark.parametrize("gathered", [False, True])
def test_samples_go_where_views_look_and_are_as_many(tmp_path: Path, gathered: bool) -> None:
    """Less noise on the floor, more on the wall; the same light on both."""
    scene = corner_room(
        tmp_path, GREY, GREY, {"type": "point", "position": [-0.5, 0.0, 1.0], "intensity": rgb(1, 1, 1)}
    )
    cells = np.zeros((CELLS, CELLS), np.float32)
    cells[: CELLS // 2, : CELLS // 2] = 3  # where the floor's chart is

    def baker(pixels: np.ndarray | None) -> LightBaker:
        if gathered:
            return GatheringBaker(mi, scene, onwards(7), caustics=True, pixels=pixels)
        return LightBaker(mi, scene, onwards(7), pixels=pixels)

    def bake(pixels: np.ndarray | None, spp: int, seed: int) -> np.ndarray:
        one = baker(pixels)
        one._smooth = lambda total, weight, least, texels, found, guides, size: _plain(total, weight, texels, size)  # type: ignore[method-assign]
        return one.bake(32, spp, seed)[0, 0]

    truth, seeds = bake(None, 8192, 9), range(1, 6)  # one seed's error is off by a tenth
    pictures = {name: [bake(pixels, 64, seed) for seed in seeds] for name, pixels in (("even", None), ("seen", cells))}
    for chart, quieter in ((FLOOR, True), (WALL, False)):
        error = {name: _error(baked, truth, chart) for name, baked in pictures.items()}
        assert np.mean([one[chart] for one in pictures["seen"]]) == pytest.approx(truth[chart].mean(), rel=0.02)
        assert error["seen"] < 0.85 * error["even"] if quieter else error["seen"] > 1.3 * error["even"], error


def _error(baked: list[np.ndarray], truth: np.ndarray, chart: tuple[slice, slice]) -> float:
    return float(np.sqrt(np.mean([(one[chart] - truth[chart]) ** 2 for one in baked])))


def test_samples_go_by_pixels_and_noise_and_brightness(tmp_path: Path) -> None:
    """As many in all, whatever asks for them, and of each texel a power of two."""
    cells = np.zeros((2, 2), np.float32)
    cells[0, 0] = 1
    scene = corner_room(tmp_path, GREY, GREY, {"type": "constant"})
    even, seen = (LightBaker(mi, scene, onwards(2), pixels=pixels) for pixels in (None, cells))
    texels, ones = np.arange(64 * 64), np.ones((64 * 64, 3))
    left, top = texels % 64 < 32, texels < 32 * 64

    def further(baker: LightBaker, light: np.ndarray, change: np.ndarray) -> np.ndarray:
        counts = baker._further(texels, 64, light, change, 16)
        assert set(np.unique(counts)) <= {0, *(1 << k for k in range(10))}
        assert counts.mean() == pytest.approx(16, rel=0.03)
        return counts

    assert set(further(even, ones, 0 * ones)) == {16} == set(further(even, ones, ones))
    noisy = further(even, ones, np.where(left, 16.0, 1.0)[:, None] * ones)
    assert noisy[left].mean() == pytest.approx(4 * noisy[~left].mean(), rel=0.1)
    bright = further(even, np.where(left, 16.0, 1.0)[:, None] * ones, ones)
    assert bright[~left].mean() == pytest.approx(2 * bright[left].mean(), rel=0.1)
    looked_at = further(seen, ones, ones)
    assert looked_at[left & top].mean() > 10 * looked_at[~(left & top)].mean()


def _plain(total: np.ndarray, weight: np.ndarray, texels: np.ndarray, size: int) -> np.ndarray:
    """The means as they are."""
    image = np.zeros((size * size, 3), np.float32)
    image[texels] = total / np.maximum(weight, 1e-9)
    return image.reshape(size, size, 3)

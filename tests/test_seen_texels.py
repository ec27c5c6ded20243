"""What views see of the atlas, and that baked light spends its samples there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.corner_room import corner_room, onwards, rgb

from dnrpipe.core.cameras import look_at_view
from dnrpipe.core.settings import CameraSettings
from dnrpipe.raytrace.gathering import GatheringBaker
from dnrpipe.raytrace.lightmap import FEWER, LightBaker
from dnrpipe.raytrace.seen_texels import CELLS, seen_cells
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
    return float(cells[rows, columns].mean())


def test_a_view_sees_what_is_before_it_and_what_a_mirror_shows(tmp_path: Path) -> None:
    scene = corner_room(tmp_path, GREY, MIRROR, {"type": "constant"})
    down = seen_cells(mi, scene, [looking((0, -0.01, 5), (0, 0, 0))], 1.0)
    assert 0.1 < share(down, FLOOR) < 0.9 and share(down, WALL) == 0
    at_mirror = looking((0, -1.5, 1.5), (0, 1, 0.8))  # what comes back meets the floor
    across = seen_cells(mi, scene, [at_mirror], 1.0)
    assert share(across, WALL) > 0.1 and share(across, FLOOR) > 0.05
    matt = seen_cells(mi, corner_room(tmp_path, GREY, GREY, {"type": "constant"}), [at_mirror], 1.0)
    assert share(matt, WALL) > 0.1 and share(matt, FLOOR) == 0
    assert not seen_cells(mi, scene, [], 1.0).any()


@pytest.mark.parametrize("gathered", [False, True])
def test_samples_go_where_views_look_and_are_as_many(tmp_path: Path, gathered: bool) -> None:
    """Less noise on the floor, more on the wall; the same light on both."""
    scene = corner_room(
        tmp_path, GREY, GREY, {"type": "point", "position": [-0.5, 0.0, 1.0], "intensity": rgb(1, 1, 1)}
    )
    cells = np.zeros((CELLS, CELLS), bool)
    cells[: CELLS // 2, : CELLS // 2] = True  # where the floor's chart is

    def baker(seen: np.ndarray | None) -> LightBaker:
        if gathered:
            return GatheringBaker(mi, scene, onwards(7), caustics=True, seen=seen)
        return LightBaker(mi, scene, onwards(7), seen=seen)

    paths, texels = LightBaker(mi, scene, onwards(7), seen=cells), np.arange(32 * 32)
    counted = {count: int(which.sum()) for which, count in paths._shares(texels, 32, 16)}
    assert max(counted) > 2.5 * 16 and max(counted) >= 0.8 * FEWER * min(counted)
    assert sum(count * size for count, size in counted.items()) == pytest.approx(16 * len(texels), rel=0.05)

    raw: dict[str, Any] = {}
    for name, seen in {"even": None, "seen": cells, "truth": None}.items():
        one = baker(seen)
        one._smooth = lambda total, weight, least, texels, found, guides, size: _plain(total, weight, texels, size)  # type: ignore[method-assign]
        raw[name] = one.bake(32, 8192 if name == "truth" else 64, 1)[0, 0]
    for chart, quieter in ((FLOOR, True), (WALL, False)):
        truth = raw["truth"][chart]
        error = {name: float(np.sqrt(np.mean((raw[name][chart] - truth) ** 2))) for name in ("even", "seen")}
        assert raw["seen"][chart].mean() == pytest.approx(truth.mean(), rel=0.05)
        assert (error["seen"] < 0.85 * error["even"]) == quieter, error


def _plain(total: np.ndarray, weight: np.ndarray, texels: np.ndarray, size: int) -> np.ndarray:
    """The means as they are."""
    image = np.zeros((size * size, 3), np.float32)
    image[texels] = total / np.maximum(weight, 1e-9)
    return image.reshape(size, size, 3)

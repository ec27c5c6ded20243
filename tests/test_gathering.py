"""Light that is gathered from a coarse map: where it is known, and beside light that is path-traced."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.corner_room import corner_room, onwards, quad, rgb

from dnrpipe.raytrace import gathering
from dnrpipe.raytrace.gathering import GatheringBaker, enlarged
from dnrpipe.raytrace.light_worker import light_baker
from dnrpipe.raytrace.lightmap import LightBaker
from dnrpipe.raytrace.tasks import LightTask

mi = pytest.importorskip("mitsuba")
FLOOR, WALL = (slice(3, 12), slice(3, 12)), (slice(3, 12), slice(19, 28))
"""Texels of the charts, of a map of 32²."""


@pytest.fixture(autouse=True)
def _variant(mitsuba_variant: str) -> None:
    if mitsuba_variant.startswith("scalar"):
        pytest.skip("baked light needs a jit variant of Mitsuba; this machine has none")


def matte(*colour: float) -> dict[str, Any]:
    return {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(*colour)}}


def test_white_surfaces_under_a_white_sky_are_a_furnace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What reflects everything is as bright as the sky, in the corner too: light is counted once."""
    monkeypatch.setattr(gathering, "COARSE", 16)
    scene = corner_room(tmp_path, matte(1, 1, 1), matte(1, 1, 1), {"type": "constant"})
    baker = GatheringBaker(mi, scene, onwards(30), caustics=True)
    light = baker.bake(32, 256, 0)
    assert light.shape == (2, 2, 32, 32, 3) and baker.lost == 0
    for chart in (FLOOR, WALL):
        assert light[0, 0][chart].mean() == pytest.approx(1, abs=0.015)
        assert np.abs(light[0, 0][chart] - 1).max() < 0.15
    alone = LightBaker(mi, scene, None).bake(32, 256, 0)  # the wall lights the floor
    assert alone[0, 0][FLOOR].mean() < 0.9


def mirror_room(folder: Path, veiled: bool) -> Any:
    """A glowing quad above a floor, and a mirror that throws its light there; perhaps a black veil between."""
    grey, red = matte(0.5, 0.5, 0.5), matte(0.8, 0.3, 0.3)
    glow = quad(folder / "g.ply", [[-1, -1, 1.5], [-1, 0, 1.5], [1, 0, 1.5], [1, -1, 1.5]], (0.05, 0.55), grey)
    glow["emitter"] = {"type": "area", "radiance": rgb(4, 3, 2)}
    mirror = {"type": "twosided", "b": {"type": "conductor", "specular_reflectance": rgb(0.9, 0.9, 0.9)}}
    side = quad(folder / "s.ply", [[1, -1, 0], [1, 1, 0], [1, 1, 1.5], [1, -1, 1.5]], (0.55, 0.55), red)
    more = {"side": side}
    if veiled:
        place = mi.ScalarTransform4f().translate([0, 0, 1])
        more["veil"] = {
            "type": "rectangle",
            "to_world": place,
            "b": {"type": "mask", "opacity": 0.5, "b": matte(0, 0, 0)},
        }
    return corner_room(folder, matte(0.7, 0.7, 0.7), mirror, glow, **more)


@pytest.mark.parametrize("veiled", [False, True])
def test_gathered_light_is_the_traced_with_glow_and_mirrors(tmp_path: Path, veiled: bool) -> None:
    """A glowing surface counts once where emitters are sampled, through holes too, and once by way of the mirror."""
    scene, kind = mirror_room(tmp_path, veiled), "volpath" if veiled else "path"
    truth = LightBaker(mi, scene, onwards(12, kind)).bake(32, 1024, 0)[0, 0][FLOOR]

    def gathered(caustics: bool) -> np.ndarray:
        return GatheringBaker(mi, scene, onwards(11, kind), caustics=caustics).bake(32, 256, 0)[0, 0][FLOOR]

    ours = gathered(caustics=True)
    assert ours.mean(axis=(0, 1)) == pytest.approx(truth.mean(axis=(0, 1)), rel=0.02)
    assert np.sqrt(np.mean((ours - truth) ** 2)) < 0.05 * truth.mean()
    if not veiled:
        direct = LightBaker(mi, scene, None).bake(32, 256, 0)[0, 0][FLOOR]
        assert direct.mean() < gathered(caustics=False).mean() < 0.95 * ours.mean()


@pytest.mark.parametrize(("depth", "fog", "gathers"), [(2, False, False), (8, False, True), (8, True, False)])
def test_paths_are_traced_where_a_map_does_not_know(tmp_path: Path, depth: int, fog: bool, gathers: bool) -> None:
    """Where something has volume, or nothing bounces."""
    more: dict[str, Any] = {}
    if fog:
        medium = {"type": "homogeneous", "albedo": 0.5, "sigma_t": rgb(1, 1, 1)}
        more["fog"] = {"type": "cube", "b": {"type": "null"}, "interior": medium}
    scene = corner_room(tmp_path, matte(1, 1, 1), matte(1, 1, 1), {"type": "constant"}, **more)
    task = LightTask(
        output=tmp_path / "l.npz",
        size=32,
        spp=4,
        gather=True,
        integrator="volpath" if fog else "path",
        max_depth=depth,
        seed=0,
        fingerprint="",
    )
    assert isinstance(light_baker(mi, scene, [], task), GatheringBaker) == gathers
    assert not isinstance(light_baker(mi, scene, [], task.model_copy(update={"gather": False})), GatheringBaker)


def test_enlarging_keeps_a_ramp() -> None:
    ramp = np.arange(8, dtype=np.float32)[:, None, None] * np.ones((1, 8, 3), np.float32)
    large = enlarged(ramp, 32)
    assert large.shape == (32, 32, 3)
    expected = (np.arange(32) + 0.5) / 4 - 0.5
    assert np.allclose(large[2:-2, 5, 0], expected[2:-2], atol=1e-5)
    assert np.array_equal(enlarged(ramp, 8), ramp)

"""The path tracer where surfaces let light straight through: what is known, and what Mitsuba's ``volpath`` says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dnrpipe.raytrace.visibility import camera_integrator

mi = pytest.importorskip("mitsuba")

SUN = {"type": "directional", "direction": [0, 1, 0], "irradiance": {"type": "rgb", "value": float(np.pi)}}
WHITE = {"type": "constant"}


@pytest.fixture(autouse=True)
def _variant(mitsuba_variant: str) -> None:
    if mitsuba_variant.startswith("scalar"):
        pytest.skip("the scalar variant has no path tracer of ours")


def sheet(opacity: float, distance: float = 0.0, kind: str = "mask") -> dict[str, Any]:
    """A square of reflectance 0.5 across the view, ``distance`` behind the origin."""
    place = mi.ScalarTransform4f().look_at([0, distance, 0], [0, distance - 1, 0], [0, 0, 1])
    matt = {"type": "twosided", "nested": {"type": "diffuse"}}
    bsdf = {"type": kind, "opacity": opacity, "nested": matt} if opacity < 1 else matt
    return {"type": "rectangle", "to_world": place @ mi.ScalarTransform4f().scale(4), "bsdf": bsdf}


def seen(kind: str, **parts: dict[str, Any]) -> np.ndarray:
    """Mean RGBA [4] seen from y = -10 towards +y."""
    place = mi.ScalarTransform4f().look_at([0, -10, 0], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 4, "height": 4, "pixel_format": "rgba"}
    sensor = {"type": "perspective", "fov": 5, "to_world": place, "film": film}
    scene = mi.load_dict({"type": "scene", **parts})
    integrator, _ = camera_integrator(mi, scene, 8, kind)
    return np.array(mi.render(scene, integrator=integrator, sensor=mi.load_dict(sensor), spp=4096)).mean((0, 1))


@pytest.mark.parametrize("kind", ["path", "path-without-caustics"])
@pytest.mark.parametrize("opacity", [0.05, 0.5, 1.0])
@pytest.mark.parametrize("light", [SUN, WHITE], ids=["sun", "white"])
def test_a_sheet_of_opacity_o_shows_o_of_its_light(kind: str, opacity: float, light: dict[str, Any]) -> None:
    colour = seen(kind, sheet=sheet(opacity), light=light)
    assert colour == pytest.approx([opacity / 2] * 3 + [opacity], rel=0.04)
    assert colour[:3] == pytest.approx([opacity / 2] * 3, rel=0.01 if light is SUN else 0.04)


@pytest.mark.parametrize("kind", ["path", "path-without-caustics"])
def test_lamps_light_what_lies_behind_sheets(kind: str) -> None:
    """Of the sun's light 0.6 * 0.7 comes to the wall, and as much of its light back; the sheets reflect the rest."""
    sheets = {"a": sheet(0.4, 0.0, "dnr_transparent"), "b": sheet(0.3, 1.0), "wall": sheet(1.0, 2.0)}
    ours, theirs = seen(kind, **sheets, light=SUN), seen("volpath", **sheets, light=SUN)
    assert ours == pytest.approx(theirs, rel=0.01)
    assert ours[0] > 0.4 / 2 + 0.6 * 0.3 / 2 * 0.6 + 0.42**2 / 2


def test_the_eye_sees_what_glows_through_a_hole_and_no_lamp() -> None:
    glow = sheet(1.0, 3.0) | {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": 2.0}}}
    hole = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
        "bsdf": {"type": "mask", "opacity": 0.0, "nested": {"type": "diffuse"}},
    }
    through = seen("path", hole=hole, screen=glow | {"id": "screen"})
    assert through[3] == pytest.approx(1) and through[0] == pytest.approx(2, rel=0.01)
    lamp = seen("path", hole=hole, **{"light-lamp": glow})
    assert lamp == pytest.approx([0, 0, 0, 0], abs=1e-6)

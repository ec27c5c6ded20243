"""Alpha behind coloured transparency: 1 - the mean of what passes, over all layers, as Cycles counts it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dnrpipe.raytrace.visibility import camera_integrator

mi = pytest.importorskip("mitsuba")


pytestmark = pytest.mark.usefixtures("mitsuba_variant")


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def pane(depth: float, *tint: float, opacity: float = 0.0, **more: Any) -> dict[str, Any]:
    """A sheet across the view at this distance, which passes ``tint`` of the light where it is not opaque."""
    bsdf: dict[str, Any] = {"type": "dnr_transparent", "transmittance": rgb(*tint), "opacity": opacity}
    if opacity > 0:
        bsdf["nested"] = {"type": "twosided", "nested": {"type": "diffuse"}}
    transform = mi.ScalarTransform4f().translate([0, 0, -depth]).scale(50)
    return {"type": "rectangle", "to_world": transform, "bsdf": bsdf, **more}


def traced(shapes: dict[str, dict[str, Any]], integrator: str) -> np.ndarray:
    """Mean RGBA [4] of the view down -z, under radiance 1 from everywhere."""
    scene = mi.load_dict({"type": "scene", "light": {"type": "constant"}, **shapes})
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    camera = mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, -1], [0, 1, 0])
    sensor = mi.load_dict({"type": "perspective", "fov": 20, "to_world": camera, "film": film})
    found, _ = camera_integrator(mi, scene, 8, integrator)
    return np.array(mi.render(scene, sensor=sensor, integrator=found, spp=256, seed=3)).mean(axis=(0, 1))


@pytest.mark.parametrize("integrator", ["path", "volpath"])
def test_alpha_is_one_minus_the_mean_of_what_passes_all_panes(integrator: str) -> None:
    red, blue, tint = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.2, 0.5, 0.8)
    lamp = pane(1.5, 1, 1, 1, id="light-lamp", emitter={"type": "area", "radiance": rgb(1, 1, 1)})
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -4]).scale(50)}

    def alpha(**shapes: dict[str, Any]) -> float:
        return traced(shapes, integrator)[3]

    assert alpha(a=pane(2, *tint)) == pytest.approx(0.5, abs=0.01)
    assert alpha(a=pane(2, *tint), b=pane(3, *tint)) == pytest.approx(1 - (0.04 + 0.25 + 0.64) / 3, abs=0.01)
    assert alpha(a=pane(2, *red), b=pane(3, *blue)) == 1.0
    assert alpha(a=pane(2, *tint, opacity=0.4)) == pytest.approx(1 - 0.6 * 0.5, abs=0.01)
    assert alpha(lamp=lamp, a=pane(2, *tint)) == pytest.approx(0.5, abs=0.01)
    assert alpha(a=pane(2, *tint), wall=wall) == 1.0


def test_colour_is_what_it_was() -> None:
    found = traced({"a": pane(2, 0.2, 0.5, 0.8), "wall": {**pane(3, 0, 0, 0, opacity=1.0)}}, "path")
    assert found[:3] == pytest.approx([0.02, 0.125, 0.32], rel=0.03)  # albedo 0.5, lit and seen through the pane

"""Views as Mitsuba sensors: pinhole, and thin lens where the scene's camera has depth of field.

A bundle may have units of its own: see `dnrpipe.blender.bundle.units`.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import View

SQUARE = 1e-6
"""Relative difference of the focal lengths up to which pixels count as square."""

Camera = tuple[list[Any], list[Any], Any]
"""Right, up, backwards and place, columns of c2w; fl_x, fl_y, cx, cy in pixels; the picture's width. As data of
recorded kernels, which are compiled once for all views and sizes."""


def opaque_camera(mi: Any, view: View) -> Camera:
    """The view's, in its own units."""
    import drjit as dr

    m = view.matrix
    axes = [mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in m[:3, i])) for i in range(4)]
    film = [dr.opaque(mi.Float, float(value)) for value in (view.fl_x, view.fl_y, view.cx, view.cy)]
    return axes, film, dr.opaque(mi.UInt32, view.width)


def sensor_dict(mi: Any, view: View, lens: dict[str, float] | None = None) -> dict[str, Any]:
    """Mitsuba sensor of a view: box filter, RGBA film.

    Mitsuba's ``perspective`` for a pinhole with square pixels, else ``dnr_camera`` (`plugins.cameras`), which scalar
    variants are slow with. Mitsuba looks along +Z with +X left; flipping X and Z takes our OpenGL axes there.

    lens: {"aperture_radius", "focus_distance"}, scene units; Blender's camera with depth of field:
    aperture_radius = lens / (2000 fstop).
    """
    to_world = view.matrix @ np.diag([-1.0, 1.0, -1.0, 1.0])
    common: dict[str, Any] = {
        "to_world": mi.ScalarTransform4f(to_world.tolist()),
        "sampler": {"type": "independent"},
        "film": {
            "type": "hdrfilm",
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},
            "width": view.width,
            "height": view.height,
        },
    }
    if lens is None and math.isclose(view.fl_x, view.fl_y, rel_tol=SQUARE):
        return {
            **common,
            "type": "perspective",
            "fov_axis": "x",
            "near_clip": 1e-4,
            "far_clip": 1e7,
            "fov": math.degrees(2 * math.atan(0.5 * view.width / view.fl_x)),
            "principal_point_offset_x": (view.width / 2 - view.cx) / view.width,
            "principal_point_offset_y": (view.height / 2 - view.cy) / view.height,
        }
    intrinsics = view.model_dump(include={"fl_x", "fl_y", "cx", "cy"})
    return {**common, "type": "dnr_camera", **intrinsics, **(lens or {})}


def row_of_sensors(cameras: list[dict[str, Any]]) -> dict[str, Any]:
    """Sensor whose picture shows those of ``cameras``, dictionaries of `sensor_dict` of one size, side by side.

    Small pictures cost what recording and starting a kernel costs; so they are rendered in one launch
    (https://mitsuba.readthedocs.io/en/stable/src/generated/plugins_sensors.html, "batch").
    """
    film = cameras[0]["film"] | {"width": cameras[0]["film"]["width"] * len(cameras)}
    named = {f"camera{i}": camera for i, camera in enumerate(cameras)}
    return {"type": "batch", "film": film, "sampler": cameras[0]["sampler"], **named}


def unit_scale(bundle: Path) -> float:
    """What the bundle's lengths are multiples of the scene's by; 1 for scenes of usual size."""
    with bundle.open(encoding="utf-8") as file:
        found = re.search(r'<default name="unit_scale" value="([^"]+)"', file.read(512))
    return float(found[1]) if found else 1.0


def scaled_view(view: View, factor: float) -> View:
    """The view from the same place of a scene ``factor`` times as large."""
    if factor == 1.0:
        return view
    rows = [(*row[:3], row[3] * factor) for row in view.c2w[:3]]
    return view.model_copy(update={"c2w": (*rows, view.c2w[3])})


def scaled_lens(lens: dict[str, float] | None, factor: float) -> dict[str, float] | None:
    """Aperture and focus distance, both lengths."""
    return lens and {name: length * factor for name, length in lens.items()}

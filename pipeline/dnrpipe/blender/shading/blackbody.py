"""Colour of a black body, from Blender's own table."""

from __future__ import annotations

import bpy
import numpy as np


def blackbody_colour(kelvin: float) -> np.ndarray:
    """Linear Rec.709 colour of luminance 1 (Blackbody node; a lamp's temperature), float64 [3], not below 0."""
    lamp = bpy.data.lights.new("dnrpipe.blackbody", "POINT")
    try:
        lamp.use_temperature = True
        lamp.temperature = kelvin
        return np.maximum(np.array(lamp.temperature_color, dtype=np.float64), 0.0)
    finally:
        bpy.data.lights.remove(lamp)

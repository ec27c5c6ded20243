"""sRGB's transfer functions (IEC 61966-2-1) on numpy arrays, and luminance. Without torch; see `display.srgb_oetf`."""

from __future__ import annotations

import numpy as np

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Of linear Rec.709, whose primaries sRGB has."""
LINEAR_END = 0.0031308
"""Linear value at which the straight segment ends."""


def encode(linear: np.ndarray) -> np.ndarray:
    """Linear light -> code values, same shape and type. Values below 0 and above 1 go on along the curve."""
    curve = 1.055 * np.maximum(linear, LINEAR_END) ** (1 / 2.4) - 0.055
    return np.where(linear <= LINEAR_END, 12.92 * linear, curve)


def decode(encoded: np.ndarray) -> np.ndarray:
    """Code values -> linear light, the inverse of `encode`."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0) + 0.055) / 1.055) ** 2.4)

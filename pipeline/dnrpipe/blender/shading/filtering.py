"""Image interpolation as Cycles does it, for a renderer that interpolates bilinearly in linear light. No bpy here.

Cycles keeps 8-bit sRGB images encoded and decodes what it has *interpolated*; Mitsuba decodes texels and then
interpolates. Between two texels of different brightness the two differ, visibly so where texels are large. Small
images are therefore interpolated here, on a finer grid.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from .textures import srgb_to_linear

LARGEST = 1024
"""No side becomes longer than this."""
MAX_FACTOR = 8


def finer(texels: np.ndarray, srgb: bool, wrap: str, kernel: Literal["linear", "cubic"]) -> tuple[np.ndarray, bool]:
    """``texels`` [H, W, C] resampled so that bilinear lookups come close to Cycles'; and whether they are sRGB codes.

    kernel: linear, or Cycles' cubic, which is a B-spline. 8-bit sRGB images stay so under the linear kernel. Images
    too large to become finer are filtered (cubic) or returned (linear) as they are.
    """
    height, width = texels.shape[:2]
    factor = max(1, min(MAX_FACTOR, LARGEST // max(height, width)))
    if kernel == "linear" and (factor == 1 or not srgb):
        return texels, srgb
    values = texels.astype(np.float32) / (255 if texels.dtype == np.uint8 else 1)
    for axis in (0, 1):
        values = _resampled(values, axis, factor, wrap, kernel)
    if kernel == "linear":
        return np.round(np.clip(values, 0, 1) * 255).astype(np.uint8), True
    return (srgb_to_linear(values) if srgb else values), False


def _resampled(values: np.ndarray, axis: int, factor: int, wrap: str, kernel: str) -> np.ndarray:
    count = values.shape[axis]
    places = (np.arange(count * factor) + 0.5) / factor - 0.5
    first = np.floor(places).astype(np.int64)
    t = (places - first).astype(np.float32)
    if kernel == "linear":
        weights = {0: 1 - t, 1: t}
    else:
        weights = {
            -1: (1 - t) ** 3 / 6,
            0: (3 * t**3 - 6 * t**2 + 4) / 6,
            1: (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
            2: t**3 / 6,
        }
    shape = [1, 1, 1]
    shape[axis] = -1
    result = np.zeros_like(np.take(values, np.zeros(len(t), np.int64), axis=axis))
    for shift, weight in weights.items():
        result += weight.reshape(shape) * np.take(values, wrapped(first + shift, count, wrap), axis=axis)
    return result


def wrapped(index: np.ndarray, count: int, mode: str) -> np.ndarray:
    """Texel indices beyond an image's edges: repeat, clamp or mirror."""
    if mode == "clamp":
        return np.clip(index, 0, count - 1)
    if mode == "mirror":
        folded = np.mod(index, 2 * count)
        return np.where(folded < count, folded, 2 * count - 1 - folded)
    return np.mod(index, count)

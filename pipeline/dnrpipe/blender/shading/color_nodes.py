"""Blender's colour and converter nodes as functions on arrays [..., 3] of linear colour (scalars repeat).

Sources: Blender manual (Color, Converter nodes) and Cycles' svm_mix / svm_math.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .textures import LUMINANCE

Arrays = list[np.ndarray]


@dataclass(frozen=True)
class Operation:
    """inputs: socket identifiers or names, in the order of the arrays; evaluate: result, None if unsupported.

    fallback: the input that stands for an unsupported result.
    """

    inputs: Callable[[Any], list[tuple[str, ...]]]
    evaluate: Callable[[Any, Any, Arrays], np.ndarray | None]
    fallback: int = 0


def _grey(x: np.ndarray) -> np.ndarray:
    return np.broadcast_to((x @ LUMINANCE)[..., None], x.shape)


def _gamma(node: Any, socket: Any, a: Arrays) -> np.ndarray:
    """Gamma: c ** gamma where c > 0."""
    return np.where(a[0] > 0, np.power(np.maximum(a[0], 1e-20), _grey(a[1])), a[0])


def _bright_contrast(node: Any, socket: Any, a: Arrays) -> np.ndarray:
    """Brightness/Contrast: max(c (1 + contrast) + brightness - contrast / 2, 0)."""
    contrast = _grey(a[2])
    return np.maximum(a[0] * (1 + contrast) + _grey(a[1]) - contrast * 0.5, 0)


BLEND: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = {
    "MIX": lambda t, x, y: x + (y - x) * t,
    "MULTIPLY": lambda t, x, y: x * (1 - t + t * y),
    "ADD": lambda t, x, y: x + t * y,
    "SUBTRACT": lambda t, x, y: x - t * y,
    "SCREEN": lambda t, x, y: 1 - (1 - t + t * (1 - y)) * (1 - x),
    "DIFFERENCE": lambda t, x, y: x + (np.abs(x - y) - x) * t,
    "DARKEN": lambda t, x, y: x + (np.minimum(x, y) - x) * t,
    "LIGHTEN": lambda t, x, y: x + (np.maximum(x, y) - x) * t,
    "DIVIDE": lambda t, x, y: np.where(np.abs(y) > 0, (1 - t) * x + t * x / np.where(y == 0, 1, y), x),
    "OVERLAY": lambda t, x, y: np.where(x < 0.5, x * (1 - t + 2 * t * y), 1 - (1 - t + 2 * t * (1 - y)) * (1 - x)),
    "LINEAR_LIGHT": lambda t, x, y: x + t * (2 * y - 1),
}
"""Blend modes of Mix Color (Cycles svm_mix), t the factor."""


def _mix_inputs(node: Any) -> list[tuple[str, ...]]:
    if node.type == "MIX_RGB":
        return [("Fac",), ("Color1",), ("Color2",)]
    kind = {"FLOAT": "Float", "VECTOR": "Vector", "RGBA": "Color"}.get(node.data_type, "Float")
    return [("Factor_Float",), (f"A_{kind}",), (f"B_{kind}",)]


def _mix(node: Any, socket: Any, a: Arrays) -> np.ndarray | None:
    """Mix (Color, Float, Vector) and the older MixRGB."""
    modern = node.type == "MIX"
    if modern and node.data_type == "ROTATION":
        return None
    t = _grey(a[0])
    t = np.clip(t, 0, 1) if not modern or node.clamp_factor else t
    kind = node.blend_type if not modern or node.data_type == "RGBA" else "MIX"
    if kind not in BLEND:
        return None
    result = BLEND[kind](t, a[1], a[2])
    return np.clip(result, 0, 1) if (node.clamp_result if modern else node.use_clamp) else result


MATH: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = {
    "ADD": lambda x, y, z: x + y,
    "SUBTRACT": lambda x, y, z: x - y,
    "MULTIPLY": lambda x, y, z: x * y,
    "DIVIDE": lambda x, y, z: np.where(y != 0, x / np.where(y == 0, 1, y), 0),
    "MULTIPLY_ADD": lambda x, y, z: x * y + z,
    "POWER": lambda x, y, z: np.power(np.maximum(x, 0), y),
    "SQRT": lambda x, y, z: np.sqrt(np.maximum(x, 0)),
    "ABSOLUTE": lambda x, y, z: np.abs(x),
    "MINIMUM": lambda x, y, z: np.minimum(x, y),
    "MAXIMUM": lambda x, y, z: np.maximum(x, y),
    "LESS_THAN": lambda x, y, z: (x < y).astype(np.float32),
    "GREATER_THAN": lambda x, y, z: (x > y).astype(np.float32),
    "ROUND": lambda x, y, z: np.floor(x + 0.5),
    "FLOOR": lambda x, y, z: np.floor(x),
    "CEIL": lambda x, y, z: np.ceil(x),
    "FRACT": lambda x, y, z: x - np.floor(x),
    "SINE": lambda x, y, z: np.sin(x),
    "COSINE": lambda x, y, z: np.cos(x),
}


def _math(node: Any, socket: Any, a: Arrays) -> np.ndarray | None:
    function = MATH.get(node.operation)
    if function is None:
        return None
    result = np.asarray(function(_grey(a[0]), _grey(a[1]), _grey(a[2])))
    return np.clip(result, 0, 1) if node.use_clamp else result


def _clamp(node: Any, socket: Any, a: Arrays) -> np.ndarray:
    low, high = _grey(a[1]), _grey(a[2])
    if node.clamp_type == "RANGE":
        low, high = np.minimum(low, high), np.maximum(low, high)
    return np.minimum(np.maximum(_grey(a[0]), low), high)


def _map_range(node: Any, socket: Any, a: Arrays) -> np.ndarray | None:
    if node.data_type != "FLOAT" or node.interpolation_type != "LINEAR":
        return None
    value, low, high, to_low, to_high = (_grey(x) for x in a[:5])
    span = high - low
    t = np.where(span != 0, (value - low) / np.where(span == 0, 1, span), 0)
    result = to_low + t * (to_high - to_low)
    if node.clamp:
        result = np.clip(result, np.minimum(to_low, to_high), np.maximum(to_low, to_high))
    return result


def _ramp(node: Any, socket: Any, a: Arrays) -> np.ndarray:
    """Color Ramp, sampled at 1025 places as dense as 8-bit input can tell apart."""
    samples = np.array([node.color_ramp.evaluate(t) for t in np.linspace(0, 1, 1025)], dtype=np.float32)
    position = np.clip(_grey(a[0])[..., 0], 0, 1) * 1024
    low = np.floor(position).astype(int)
    high = np.minimum(low + 1, 1024)
    t = (position - low)[..., None]
    mixed = samples[low] * (1 - t) + samples[high] * t
    if socket.name == "Alpha":
        return np.repeat(mixed[..., 3:], 3, axis=-1)
    return mixed[..., :3]


def _separate(node: Any, socket: Any, a: Arrays) -> np.ndarray | None:
    """Separate Color (RGB) / Separate XYZ: one channel, repeated."""
    if getattr(node, "mode", "RGB") != "RGB":
        return None
    order = {"Red": 0, "Green": 1, "Blue": 2, "R": 0, "G": 1, "B": 2, "X": 0, "Y": 1, "Z": 2}
    channel = order[socket.name]
    return np.repeat(a[0][..., channel : channel + 1], 3, axis=-1)


def _combine(node: Any, socket: Any, a: Arrays) -> np.ndarray | None:
    if getattr(node, "mode", "RGB") != "RGB":
        return None
    grey = np.broadcast_arrays(*(_grey(x)[..., 0] for x in a[:3]))
    return np.stack(grey, axis=-1)


def _hue_saturation(node: Any, socket: Any, a: Arrays) -> np.ndarray:
    """Hue/Saturation/Value: hue shifted by hue - 0.5, saturation and value scaled, mixed by the factor."""
    hue, saturation, value, factor, colour = _grey(a[0]), _grey(a[1]), _grey(a[2]), _grey(a[3]), a[4]
    hsv = _rgb_to_hsv(colour)
    h = np.mod(hsv[..., 0] + hue[..., 0] + 0.5, 1.0)
    s = np.clip(hsv[..., 1] * saturation[..., 0], 0, 1)
    v = hsv[..., 2] * value[..., 0]
    changed = np.maximum(_hsv_to_rgb(*np.broadcast_arrays(h, s, v)), 0)
    return colour + (changed - colour) * factor


def _rgb_to_hsv(rgb: np.ndarray) -> np.ndarray:
    high, low = rgb.max(-1), rgb.min(-1)
    span = high - low
    safe = np.where(span == 0, 1, span)
    r, g, b = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    h = np.where(high == r, (g - b) / safe, np.where(high == g, 2 + (b - r) / safe, 4 + (r - g) / safe))
    return np.stack([np.where(span == 0, 0, np.mod(h / 6, 1)), span / np.where(high == 0, 1, high), high], -1)


def _hsv_to_rgb(h: np.ndarray, s: np.ndarray, v: np.ndarray) -> np.ndarray:
    k = np.mod(np.stack([5 + h * 6, 3 + h * 6, 1 + h * 6], -1), 6)
    fall = np.clip(np.minimum(k, 4 - k), 0, 1)
    return v[..., None] * (1 - s[..., None] * fall)


def _sockets(*names: str | tuple[str, ...]) -> Callable[[Any], list[tuple[str, ...]]]:
    """Inputs that are the same whatever the node's settings; a tuple holds other names of the same socket."""
    return lambda node: [(name,) if isinstance(name, str) else name for name in names]


_SEPARATE = Operation(_sockets(("Color", "Image", "Vector")), _separate)
_COMBINE = Operation(_sockets(("Red", "R", "X"), ("Green", "G", "Y"), ("Blue", "B", "Z")), _combine)
OPERATIONS: dict[str, Operation] = {
    # Mix of c and 1 - c by the factor.
    "INVERT": Operation(_sockets("Fac", "Color"), lambda node, socket, a: a[1] + (1 - 2 * a[1]) * _grey(a[0]), 1),
    "GAMMA": Operation(_sockets("Color", "Gamma"), _gamma),
    "BRIGHTCONTRAST": Operation(_sockets("Color", ("Bright", "Brightness"), "Contrast"), _bright_contrast),
    "RGBTOBW": Operation(_sockets("Color"), lambda node, socket, a: _grey(a[0])),
    "MIX": Operation(_mix_inputs, _mix, fallback=1),
    "MIX_RGB": Operation(_mix_inputs, _mix, fallback=1),
    "MATH": Operation(_sockets("Value", "Value_001", "Value_002"), _math),
    "CLAMP": Operation(_sockets("Value", "Min", "Max"), _clamp),
    "MAP_RANGE": Operation(_sockets("Value", "From Min", "From Max", "To Min", "To Max"), _map_range),
    "VALTORGB": Operation(_sockets("Fac"), _ramp),
    "SEPARATE_COLOR": _SEPARATE,
    "SEPRGB": _SEPARATE,
    "SEPXYZ": _SEPARATE,
    "COMBINE_COLOR": _COMBINE,
    "COMBRGB": _COMBINE,
    "COMBXYZ": _COMBINE,
    "HUE_SAT": Operation(_sockets("Hue", "Saturation", "Value", "Fac", "Color"), _hue_saturation),
}

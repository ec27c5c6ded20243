"""Arithmetic on values of sockets (constants and textures). No bpy here."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .textures import Constant, Textured, Value, constant, scale

SMOOTH = 0.03
"""Roughness below which a lobe is treated as a perfect mirror or a clear interface (alpha < 1e-3)."""
Report = Callable[[str, str], None]
"""Called with (feature, note) when a product or sum cannot be exact."""


def equals(value: Value, number: float) -> bool:
    """Whether the value is the same number everywhere."""
    return isinstance(value, Constant) and abs(value.scalar - number) < 1e-5


def is_white(value: Value) -> bool:
    """Whether the value is a colour of 1 everywhere."""
    return isinstance(value, Constant) and bool(np.allclose(value.mean, 1.0, atol=1e-3))


def is_smooth(roughness: Value) -> bool:
    """Whether the roughness is a constant below `SMOOTH`."""
    return isinstance(roughness, Constant) and roughness.scalar < SMOOTH


def squared(value: Value) -> Value:
    """Microfacet alpha of a roughness: its square, kept above 0."""
    if isinstance(value, Constant):
        return constant(max(value.scalar, SMOOTH) ** 2)
    return value.map(lambda x: np.maximum(x, SMOOTH) ** 2)


def square_root(value: Value) -> Value:
    """Per-interface tint of a transmission colour that light crosses twice."""
    if isinstance(value, Constant):
        return constant(np.sqrt(np.maximum(value.mean, 0)))
    return value.map(lambda x: np.sqrt(np.maximum(x, 0)))


def complement(value: Value) -> Value:
    """1 - value."""
    if isinstance(value, Constant):
        return constant(1 - value.scalar)
    return value.map(lambda x: 1 - x)


def weaken(texels: np.ndarray, strength: float) -> np.ndarray:
    """Normal map of another strength: n' = normalise(z + s (n - z)) (Cycles svm_node_normal_map)."""
    flat = np.array([0.0, 0.0, 1.0], dtype=np.float32)
    normal = flat + (texels * 2 - 1 - flat) * max(strength, 0.0)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    return normal * 0.5 + 0.5


def product(value: Value | None, factor: Value, report: Report) -> Value | None:
    """``value`` times ``factor``; texel by texel where at most one of them is textured."""
    if value is None:
        return None
    if isinstance(factor, Constant):
        return scale(value, factor.scalar)
    if isinstance(value, Constant):
        return scale(factor, value.mean) if np.ptp(value.mean) else scale(factor, float(value.mean[0]))
    if value.placement == factor.placement and value.texels.shape[:2] == factor.texels.shape[:2]:
        return value.map(lambda texels: texels * factor.linear())
    report("textured value under a textured mix", "the mix factor's mean is used")
    return scale(value, factor.scalar)


def total(a: Value | None, b: Value | None, report: Report) -> Value | None:
    """Sum of two contributions; of two different textures, the mean of the second counts."""
    if a is None or b is None:
        return b if a is None else a
    if isinstance(a, Constant) and isinstance(b, Constant):
        return constant(a.mean + b.mean)
    if isinstance(a, Constant):
        a, b = b, a
    assert isinstance(a, Textured)
    if isinstance(b, Constant):
        offset = b.mean if a.texels.shape[2] == 3 else b.mean[:1]
        return a.map(lambda texels: texels + offset) if np.any(offset) else a
    if a.placement == b.placement and a.texels.shape == b.texels.shape:
        return a.map(lambda texels: texels + b.linear())
    report("sum of two textures", "the mean of the second is used")
    mean = b.mean[: a.texels.shape[2]]
    return a.map(lambda texels: texels + mean)

"""Principled BSDF -> Mitsuba ``principled``: the numbers that make the two agree. No bpy here.

Measured in a white furnace (unit sphere, unit radiance from everywhere, mean over the disc), Blender 5.0.1
Cycles against Mitsuba 3.9.1; tests/test_export.py repeats the comparison end to end.
"""

from __future__ import annotations

import math

import numpy as np

ROUGHNESS = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
METAL_MITSUBA = np.array([1.0, 0.9999, 0.9998, 0.9976, 0.9867, 0.9563, 0.8963, 0.8050, 0.6907, 0.5671, 0.4474, 0.3413])
"""Albedo of Mitsuba's single-scattering white metal, by roughness."""
METAL_CYCLES_HALF = np.array(
    [0.5024, 0.5023, 0.5022, 0.5018, 0.4992, 0.4917, 0.4758, 0.4502, 0.4152, 0.3727, 0.3255, 0.2777]
)
"""Albedo of Cycles' multiple-scattering metal of base colour 0.5, by roughness."""
SPECULAR_ROUGHNESS = np.array([0.0, 0.1, 0.3, 0.5, 0.8, 1.0])
SPECULAR_CYCLES = np.array([0.049, 0.049, 0.0486, 0.0445, 0.0278, 0.0168])
"""Share of light that Cycles' dielectric layer (IOR 1.5) keeps from the diffuse base."""
DIFFUSE_MITSUBA = np.array([0.976, 0.980, 0.993, 1.006, 1.0245, 1.0369])
"""Albedo of Mitsuba's Disney diffuse lobe per unit base colour; its specular layer takes nothing away."""
F0_REFERENCE = 0.04
GRAZING = 0.009
"""Mean albedo of a smooth dielectric minus its F0 (IOR 1.5: 0.049 - 0.04)."""


def metal_gain(colour: np.ndarray, roughness: float) -> np.ndarray:
    """Factor on a metal's base colour that makes up for Mitsuba's missing multiple scattering.

    Cycles scales its lobe to ``c E (1 + F_ms (1 - E) / E)`` with ``F_ms = c E / (1 - c (1 - E))`` (Kulla and
    Conty 2017, as in Cycles' microfacet multi-GGX). E is recovered from its albedo at base colour 0.5.

    Args:
        colour: linear base colour [3], in [0, 1].
        roughness: Blender's roughness in [0, 1].
    """
    half = float(np.interp(roughness, ROUGHNESS, METAL_CYCLES_HALF / 0.5024 * 0.5))
    single = _single_scatter(half)
    c = np.clip(np.asarray(colour, dtype=np.float64), 1e-3, 1.0)
    multiple = c * single / (1 - c * (1 - single))
    total = c * single + c * multiple * (1 - single)
    return total / (c * float(np.interp(roughness, ROUGHNESS, METAL_MITSUBA)))


def _single_scatter(albedo_half: float) -> float:
    """E with ``0.5 E + 0.25 E (1 - E) / (1 - 0.5 (1 - E)) = albedo_half``, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(40):
        e = 0.5 * (low + high)
        value = 0.5 * e + 0.25 * e * (1 - e) / (1 - 0.5 * (1 - e))
        low, high = (e, high) if value < albedo_half else (low, e)
    return 0.5 * (low + high)


def diffuse_gain(f0: float, roughness: float) -> float:
    """Factor on a dielectric's base colour: Cycles' layer takes energy from the base, Mitsuba's does not."""
    kept = float(np.interp(roughness, SPECULAR_ROUGHNESS, SPECULAR_CYCLES))
    share = 0.0 if f0 <= 0 else kept * (f0 + GRAZING) / (F0_REFERENCE + GRAZING)
    return (1 - min(share, 1.0)) / float(np.interp(roughness, SPECULAR_ROUGHNESS, DIFFUSE_MITSUBA))


def normal_reflectance(ior: float, specular_level: float) -> float:
    """Fresnel reflectance at normal incidence: ((ior - 1) / (ior + 1))^2 times twice the specular level.

    An index below 1e-5 counts as that, as in Cycles.
    """
    ior = max(ior, 1e-5)
    return min(((ior - 1) / (ior + 1)) ** 2 * 2 * max(specular_level, 0.0), 0.99)


def eta_of(f0: float) -> float:
    """Relative index of refraction with normal reflectance ``f0``."""
    root = math.sqrt(max(f0, 0.0))
    return (1 + root) / (1 - root)

"""Energy of GGX lobes: albedo tables that layering and multiple scattering need, and Mitsuba textures of them.

Notation
    m       cosine between view and normal; r roughness, alpha = r^2
    E       albedo of the lobe with Fresnel 1:  E(m, r) = E_h[G2 / G1], h drawn from the visible normals (Heitz 2018)
    S       the same, weighted by s(h) = (F(h) - F0) / (1 - F0), F the dielectric Fresnel term of an index of refraction

So a lobe with Fresnel term f0 + (1 - f0) s has the albedo f0 E + (1 - f0) S.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from ...core.optics import fresnel

COSINES, ROUGHNESSES = 32, 32
STRATA = 24
MIN_ALPHA = 1e-3


def average_fresnel(eta: float) -> float:
    """Cosine-weighted mean of the dielectric Fresnel term over the hemisphere."""
    cosine = (np.arange(512) + 0.5) / 512
    return float((2 * cosine * fresnel(cosine, eta)).mean())


@lru_cache(maxsize=64)
def tables(eta: float) -> tuple[np.ndarray, np.ndarray]:
    """(E, S), float32 [ROUGHNESSES, COSINES]; row r = i / (ROUGHNESSES - 1), column m = (j + 0.5) / COSINES."""
    u1, u2, view = _samples()
    f0 = ((eta - 1) / (eta + 1)) ** 2
    whole, share = np.zeros((2, ROUGHNESSES, COSINES), np.float32)
    for row in range(ROUGHNESSES):
        alpha = max((row / (ROUGHNESSES - 1)) ** 2, MIN_ALPHA)
        half = _visible_normals(view[:, None, :], alpha, u1[None], u2[None])
        along = (view[:, None, :] * half).sum(-1)
        out = 2 * along[..., None] * half - view[:, None, :]
        lambda_in, lambda_out = _smith(view[:, None, 2], alpha), _smith(out[..., 2], alpha)
        kept = np.where(out[..., 2] > 0, (1 + lambda_in) / (1 + lambda_in + lambda_out), 0)
        s = np.clip((fresnel(np.clip(along, 0, 1), eta) - f0) / (1 - f0), 0, 1)
        whole[row], share[row] = kept.mean(1), (kept * s).mean(1)
    return whole, share


@lru_cache(maxsize=64)
def interface_table(eta: float) -> np.ndarray:
    """Albedo of both lobes of a rough dielectric together, seen from the side where the relative index is ``eta``.

    float32 [ROUGHNESSES, COSINES], laid out as `tables`. The masking terms of the two directions are
    independent, G1(wi) G1(wo) (Walter et al. 2007), as in Mitsuba's ``roughdielectric``.
    """
    u1, u2, view = _samples()
    view = view[:, None, :]
    whole = np.zeros((ROUGHNESSES, COSINES), np.float32)
    for row in range(ROUGHNESSES):
        alpha = max((row / (ROUGHNESSES - 1)) ** 2, MIN_ALPHA)
        half = _visible_normals(view, alpha, u1[None], u2[None])
        along = np.clip((view * half).sum(-1, keepdims=True), 0, 1)
        reflected = 2 * along * half - view
        inside = np.sqrt(np.clip(1 - (1 - along**2) / eta**2, 0, 1))
        refracted = (along / eta - inside) * half - view / eta
        share = fresnel(along[..., 0], eta)
        back = np.where(reflected[..., 2] > 0, 1 / (1 + _smith(reflected[..., 2], alpha)), 0)
        through = np.where(refracted[..., 2] < 0, 1 / (1 + _smith(refracted[..., 2], alpha)), 0)
        whole[row] = (share * back + (1 - share) * through).mean(1)
    return whole


def _samples() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u1, u2) of a stratified square [STRATA^2], and directions of view [COSINES, 3] at the tables' columns."""
    axis = (np.arange(STRATA) + 0.5) / STRATA
    u1, u2 = (grid.ravel() for grid in np.meshgrid(axis, axis))
    cosine = (np.arange(COSINES) + 0.5) / COSINES
    return u1, u2, np.stack([np.sqrt(1 - cosine**2), np.zeros(COSINES), cosine], axis=-1)


def _smith(cosine: np.ndarray, alpha: float) -> np.ndarray:
    """Smith's Lambda of GGX."""
    c2 = np.clip(cosine * cosine, 1e-12, 1)
    return 0.5 * (np.sqrt(1 + alpha * alpha * (1 - c2) / c2) - 1)


def _visible_normals(view: np.ndarray, alpha: float, u1: np.ndarray, u2: np.ndarray) -> np.ndarray:
    """GGX normals seen from ``view``, by spherical caps (Dupuy and Benyoub 2023)."""
    std = np.stack([view[..., 0] * alpha, view[..., 1] * alpha, view[..., 2]], axis=-1)
    std /= np.linalg.norm(std, axis=-1, keepdims=True)
    phi = 2 * np.pi * u1
    z = (1 - u2) * (1 + std[..., 2]) - std[..., 2]
    flat = np.sqrt(np.clip(1 - z * z, 0, 1))
    h = np.stack([flat * np.cos(phi), flat * np.sin(phi), z], axis=-1) + std
    h = np.stack([h[..., 0] * alpha, h[..., 1] * alpha, np.maximum(h[..., 2], 1e-9)], axis=-1)
    return h / np.linalg.norm(h, axis=-1, keepdims=True)


def table_of(mi: Any, channels: list[np.ndarray]) -> Any:
    """Raw ``bitmap`` texture of three float arrays [H, W]."""
    texels = np.ascontiguousarray(np.stack(channels, axis=-1), dtype=np.float32)
    data = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "wrap_mode": "clamp"}
    return mi.load_dict(data, parallel=False)  # a worker's thread pool may be empty


def look_up(mi: Any, table: Any, si: Any, cosine: Any, row: Any, active: Any) -> Any:
    """The three channels at (cosine, row)."""
    at = mi.SurfaceInteraction3f(si)
    at.uv = mi.Point2f(cosine, row)
    return table.eval_3(at, active)


def row_of(roughness: Any) -> Any:
    """Where a roughness in [0, 1] lies along v."""
    return (roughness * (ROUGHNESSES - 1) + 0.5) / ROUGHNESSES

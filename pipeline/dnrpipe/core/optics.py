"""Optics that the conversion of shaders and the plugins share."""

from __future__ import annotations

import numpy as np


def fresnel(cosine: np.ndarray, eta: float) -> np.ndarray:
    """Unpolarised reflectance of a dielectric interface; 1 under total reflection.

    eta: index beyond the surface over index on the side of the view.
    """
    g2 = eta * eta - 1 + cosine * cosine
    g = np.sqrt(np.maximum(g2, 0))
    parallel = (g - cosine) / np.maximum(g + cosine, 1e-9)
    ratio = (cosine * (g + cosine) - 1) / np.maximum(cosine * (g - cosine) + 1, 1e-9)
    return np.where(g2 > 0, 0.5 * parallel**2 * (1 + ratio**2), 1.0)

"""Albedo tables of `energy` as textures over cosine and roughness."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import energy


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
    return (roughness * (energy.ROUGHNESSES - 1) + 0.5) / energy.ROUGHNESSES

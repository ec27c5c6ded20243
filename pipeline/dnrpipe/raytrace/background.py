"""The world behind everything, as a camera sees it: the bundle leaves it out of pictures (see `visibility`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import View

from .engine import Engine
from .frames import pinhole
from .recorded import Recorded
from .sensors import scaled_view

CELLS = 2
"""Rays per pixel and side: a sun or a sharp horizon is not jagged."""


class Background:
    """Radiance of a bundle's environment. Black where it has none."""

    def __init__(self, engine: Engine, bundle: Path) -> None:
        self.engine, self.mi = engine, engine.mi
        self.environment = engine.scenes[str(bundle)].environment()
        self.kernel = Recorded(self._kernel)

    def frame(self, view: View) -> np.ndarray:
        """Linear Rec.709, float32 [H, W, 3]."""
        import drjit as dr

        if self.environment is None:
            return np.zeros((view.height, view.width, 3), np.float32)
        mi, moved = self.mi, scaled_view(view, self.engine.unit_scale)
        numbers = (*moved.matrix[:3].ravel(), moved.fl_x, moved.cx, moved.cy)
        camera = [dr.opaque(mi.Float, float(number)) for number in numbers]
        values = self.kernel(camera, view.width, view.height)
        return np.stack([np.array(value) for value in values], axis=-1).reshape(view.height, view.width, 3)

    def _kernel(self, camera: list[Any], width: int, height: int) -> list[Any]:
        import drjit as dr

        mi = self.mi
        pixel = dr.arange(mi.UInt32, width * height)
        total = mi.Color3f(0)
        for cell in range(CELLS * CELLS):
            offset = mi.Point2f((cell % CELLS + 0.5) / CELLS, (cell // CELLS + 0.5) / CELLS)
            hit = dr.zeros(mi.SurfaceInteraction3f, width * height)
            hit.wi = -pinhole(mi, camera, pixel, offset, width).d
            total += mi.Color3f(self.environment.eval(hit)) / (CELLS * CELLS)
        return [total.x, total.y, total.z]

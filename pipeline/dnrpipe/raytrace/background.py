"""The world behind everything, as a camera sees it: the bundle leaves it out of pictures (see `visibility`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import View

from .engine import Engine
from .frames import pinhole
from .recorded import Recorded
from .sensors import Camera, opaque_camera, scaled_view

CELLS = 2
"""Rays per pixel and side: a sun or a sharp horizon is not jagged."""


class Background:
    """Radiance of a bundle's environment. Black where it has none."""

    def __init__(self, engine: Engine, bundle: Path) -> None:
        self.engine, self.mi = engine, engine.mi
        self.scene = engine.scenes[str(bundle)]
        self.kernel = Recorded(self._kernel, self.scene)

    def frame(self, view: View) -> np.ndarray:
        """Linear Rec.709, float32 [H, W, 3]."""
        if self.scene.environment() is None:
            return np.zeros((view.height, view.width, 3), np.float32)
        camera = opaque_camera(self.mi, scaled_view(view, self.engine.unit_scale))
        values = self.kernel(self.scene, camera, view.width, view.height)
        planes = [np.broadcast_to(np.array(value), view.width * view.height) for value in values]  # a colour may be one
        return np.stack(planes, axis=-1).reshape(view.height, view.width, 3)

    def _kernel(self, scene: Any, camera: Camera, width: int, height: int) -> list[Any]:
        import drjit as dr

        mi = self.mi
        pixel = dr.arange(mi.UInt32, width * height)
        total = mi.Color3f(0)
        for cell in range(CELLS * CELLS):
            offset = mi.Point2f((cell % CELLS + 0.5) / CELLS, (cell // CELLS + 0.5) / CELLS)
            hit = dr.zeros(mi.SurfaceInteraction3f, width * height)
            hit.wi = -pinhole(mi, camera, pixel, offset).d
            total += mi.Color3f(scene.environment().eval(hit)) / (CELLS * CELLS)
        return [total.x, total.y, total.z]

"""All groups of samples of a view in one kernel launch: as many sensors side by side.

A launch costs 0.1 to 0.5 s before the first ray (Mitsuba traces its Python code anew), so that one a group would be
most of a small picture's time.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import View

from .engine import MAX_WAVEFRONT, Engine
from .noise import GROUPS
from .sensors import scaled_lens, scaled_view, sensor_dict

LAUNCH_BITS = 14
"""Seeds of a view: its own 18 bits, then the number of the launch."""


class GroupedSensor:
    """A view as Mitsuba sensor that renders several groups at once.

    Args:
        view: in scene units.
        lens: see `sensors.sensor_dict`.
    """

    def __init__(self, engine: Engine, bundle: Path, view: View, lens: dict[str, float] | None) -> None:
        self.engine, self.scene = engine, engine.scenes[str(bundle)]
        self.height, self.width = view.height, view.width
        mi = engine.mi
        one = sensor_dict(mi, scaled_view(view, engine.unit_scale), scaled_lens(lens, engine.unit_scale))
        pixels = view.width * view.height
        self.together = GROUPS
        while self.together > 1 and self.together * pixels > MAX_WAVEFRONT:
            self.together //= 2
        self.largest = max(1, MAX_WAVEFRONT // (self.together * pixels))
        sensor = one
        if self.together > 1:
            film = {**one["film"], "width": self.together * view.width, "height": view.height}
            parts = {f"group{i}": one for i in range(self.together)}
            sensor = {"type": "batch", "film": film, "sampler": one["sampler"], **parts}
        self.sensor = mi.load_dict(sensor)

    def render(self, integrator: Any, samples: int, seed: int, first: int) -> tuple[np.ndarray, int]:
        """(means of the groups, float64 [G, H, W, 4], linear Rec.709, premultiplied; number of kernel launches).

        Args:
            samples: per pixel, in each group.
            seed: of the view, 18 bits.
            first: number of launches of this view so far.
        """
        result = np.zeros((GROUPS, self.height, self.width, 4))
        launches = 0
        for start in range(0, GROUPS, self.together):
            for size in launch_sizes(samples, self.largest):
                number = (seed << LAUNCH_BITS) + (first + launches) % (1 << LAUNCH_BITS)
                part = self.engine.render(
                    self.scene,
                    sensor=self.sensor,
                    integrator=integrator,
                    spp=size,
                    seed=number,
                )
                image = np.array(part, dtype=np.float64)[..., :4].reshape(self.height, self.together, self.width, 4)
                result[start : start + self.together] += image.transpose(1, 0, 2, 3) * size
                launches += 1
        return result / samples, launches


def launch_sizes(samples: int, largest: int) -> list[int]:
    """``samples`` in as few launches as possible of nearly equal size, none above ``largest``."""
    count = -(-samples // largest)
    return [samples // count + (i < samples % count) for i in range(count)]

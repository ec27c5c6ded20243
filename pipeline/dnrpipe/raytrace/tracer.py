"""The ray-tracing worker: path-traces views of a Mitsuba bundle into EXR files.

Notation
    A, B     two independent half renders of a view, each spp/2 samples per pixel: they cost nothing extra, as their
             mean is the image
    noise    estimated relative RMSE of (A+B)/2 in display space (:func:`.noise.half_noise`); of denoised views, A and
             B are denoised first: the noise that is left, not the denoiser's own error. raw_noise: before the denoiser

This is tracing with so many samples per pixel; to a noise level or within a time it is :mod:`.pass_worker` that traces.
"""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import View
from dnrtrain.exr import write_exr

from .engine import Engine
from .noise import half_noise
from .pictures import finished, repair
from .sensors import sensor_dict


class Worker:
    """Loads the bundle once; each call traces one view.

    common: {"bundle": path of scene.xml, "variant": str, "threads": int}
    task: {"view": View as JSON, "output": path, "spp", "max_depth", "seed", "fingerprint"}, and optionally
    "integrator" (direct, path, volpath; default path), "lens" (see :func:`.sensors.sensor_dict`) and "denoise":
    R G B are then denoised, and what was traced is in the channels ``raw.R``, ``raw.G``, ``raw.B``.
    """

    def __init__(self, common: dict[str, Any]) -> None:
        self.bundle = Path(common["bundle"])
        self.engine = Engine(common["variant"], int(common["threads"]), [self.bundle])

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        view = View.model_validate(task["view"])
        spp, seed, depth = int(task["spp"]), int(task["seed"]), int(task["max_depth"])
        started, cpu = time.monotonic(), time.process_time()
        lens = task.get("lens")
        sensor = self.engine.sensor(view, lens)
        integrator, name = self.engine.integrator(self.bundle, task.get("integrator", "path"), depth)

        def render(samples: int, number: int) -> tuple[np.ndarray, int]:
            return self.engine.frame(self.bundle, integrator, sensor, view, samples, number)

        half_a, done_a = render((spp + 1) // 2, seed * 2)
        half_b, done_b = render(spp // 2, seed * 2 + 1) if spp > 1 else (half_a, 0)

        def again(attempt: int, half: int) -> np.ndarray:
            return render(max(1, spp // 2), 0x80000 + seed + 0x1000 * (attempt * 2 + half))[0]

        repaired, masked = repair([half_a, half_b], again)
        total = done_a + done_b
        image = (half_a * done_a + half_b * done_b) / total
        halves = (half_a, half_b) if done_b else None
        raw = half_noise(half_a, half_b) if done_b else None
        channels, left = finished(self.engine, self.bundle, view, image, halves, raw, bool(task.get("denoise")))
        numbers = {
            "spp": total,
            "max_depth": depth,
            "seed": seed,
            "integrator": name + ("+lens" if lens else ""),
            "variant": self.engine.variant,
            "seconds": time.monotonic() - started,
            "cpu_seconds": time.process_time() - cpu,
            "load_seconds": self.engine.load_seconds,
            "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            **left,
            "repaired": repaired,
            "masked": masked,
            "denoised": bool(task.get("denoise")),
        }
        write_exr(
            Path(task["output"]),
            channels,
            {**numbers, "fingerprint": task["fingerprint"], "view": view.model_dump(mode="json")},
        )
        return numbers


__all__ = ["Worker", "sensor_dict"]

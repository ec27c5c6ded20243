"""The ray-tracing worker: path-traces views of a Mitsuba bundle into EXR files.

Notation
    A, B     two independent half renders of a view, each spp/2 samples per pixel: they cost nothing extra, as their
             mean is the image
    noise    estimated relative RMSE of (A+B)/2 in display space (`noise.half_noise`); of denoised views, A and
             B are denoised first: the noise that is left, not the denoiser's own error. raw_noise: before the denoiser

This traces a number of samples per pixel; `pass_worker` traces to a noise level or within a time.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from dnrtrain.exr import write_exr

from .engine import BundleWorker
from .noise import half_noise
from .pictures import finished, repair
from .tasks import Costs, NoiseFigures, TraceAnswer, TracedView, TraceTask, costs_since


class ViewTracer(BundleWorker):
    """What this worker and `pass_worker` share."""

    def integrator(self, task: TracedView) -> tuple[Any, str]:
        return self.engine.integrator(self.bundle, task.integrator, task.max_depth)

    def answer(
        self, task: TracedView, spp: int, costs: Costs, noise: NoiseFigures, repaired: int, masked: int
    ) -> TraceAnswer:
        return {
            "spp": spp,
            "max_depth": task.max_depth,
            "seed": task.seed,
            "integrator": self.integrator(task)[1] + ("+lens" if task.lens else ""),
            "variant": self.engine.variant,
            **costs,
            "load_seconds": self.engine.load_seconds,
            **noise,
            "repaired": repaired,
            "masked": masked,
            "denoised": task.denoise,
        }


class Worker(ViewTracer):
    """Each call traces one view. common: a `BundleCommon`, task: a `TraceTask`."""

    def __call__(self, asked: dict[str, Any]) -> TraceAnswer:
        task = TraceTask.model_validate(asked)
        view, spp, seed = task.view, task.spp, task.seed
        started, cpu = time.monotonic(), time.process_time()
        sensor = self.engine.sensor(view, task.lens)
        integrator, _ = self.integrator(task)

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
        channels, noise = finished(self.engine, self.bundle, view, image, halves, raw, task.denoise)
        answer = self.answer(task, total, costs_since(started, cpu), noise, repaired, masked)
        header = {**answer, "fingerprint": task.fingerprint, "view": view.model_dump(mode="json")}
        write_exr(task.output, channels, header)
        return answer

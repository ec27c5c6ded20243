"""Worker that renders views by Cycles as the file has it, at a few samples, raw and with Blender's denoiser.

For `dnrpipe frontier` and `tools.bench_shots`: Cycles is what the artist would render with. Bounces, clamping and
caustics stay as in the file; adaptive sampling and time limits are off, so that samples are what they say. Persistent
data keeps the BVH between frames, and each way of rendering is warmed by a frame that is thrown away.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from dnrtrain.atomic import write_json
from dnrtrain.contract import View

from ..tasks import CyclesAnswer, CyclesCommon, CyclesTask, PassesCommon
from .drawing import make_renderer

METHODS: dict[str, tuple[str, str] | None] = {
    "raw": None,
    "denoised-fast": ("FAST", "FAST"),
    "denoised": ("ACCURATE", "HIGH"),
}
"""Blender's Open Image Denoise: (prefilter of albedo and normal, quality); ``denoised`` is Blender's default."""
REFERENCE = "reference"
SEEDS = 1 << 16
"""Between the numbers of two pictures of a view."""


class Worker:
    """Renders a `CyclesTask`; common: a `CyclesCommon`. Answers and writes a `CyclesAnswer`."""

    def __init__(self, common: dict[str, Any]) -> None:
        self.threads = CyclesCommon.model_validate(common).threads or os.cpu_count() or 1

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        wanted = CyclesTask.model_validate(task)
        made = self._render(wanted).data()
        write_json(wanted.output, made)
        return made

    def _render(self, task: CyclesTask) -> CyclesAnswer:
        samples = {"raster_samples": 1, "coverage_samples": 1}
        common = PassesCommon(scene_dir=task.scene_dir, raster_engine="cycles", threads=self.threads, **samples)
        draw = make_renderer("raster", common)
        scene = bpy.context.scene
        scene.render.film_transparent = not task.background
        ms: dict[str, list[float]] = {}
        seconds: dict[str, list[float]] = {}
        for spp in task.samples:
            for method in task.methods or METHODS:
                _sampling(scene, spp, METHODS[method])
                name = f"{spp} spp {method}"
                ms[name], seconds[name] = self._frames(draw, task, name, task.seed)
        if task.reference_spp is not None:
            _sampling(scene, task.reference_spp, None)
            self._frames(draw, task, REFERENCE, task.seed + 1, warm=False)
        return CyclesAnswer(threads=self.threads, ms=ms, seconds=seconds)

    def _frames(
        self, draw: Callable[[View, Path], None], task: CyclesTask, name: str, seed: int, warm: bool = True
    ) -> tuple[list[float], list[float]]:
        """Render the views, each with numbers of its own -> milliseconds and seconds of a `CyclesAnswer`."""
        folder = task.folder / name
        folder.mkdir(parents=True, exist_ok=True)
        if warm:
            draw(task.views[0], folder / f"{task.views[0].name}.exr")
        ms, seconds = [], []
        for place, view in enumerate(task.views):
            bpy.context.scene.cycles.seed = seed * SEEDS + place
            wall, cpu = time.monotonic(), time.process_time()
            draw(view, folder / f"{view.name}.exr")
            ms.append(1000 * (time.process_time() - cpu) / self.threads)
            seconds.append(time.monotonic() - wall)
        return ms, seconds


def _sampling(scene: bpy.types.Scene, samples: int, denoiser: tuple[str, str] | None) -> None:
    cycles = scene.cycles
    cycles.samples = samples
    cycles.use_denoising = denoiser is not None
    if denoiser is None:
        return
    cycles.denoiser, cycles.denoising_use_gpu = "OPENIMAGEDENOISE", False
    cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
    cycles.denoising_prefilter, cycles.denoising_quality = denoiser
    for layer in scene.view_layers:
        layer.cycles.use_denoising = True

"""Worker: views of the prepared scene by Cycles as the file has it, at a few samples, raw and with Blender's denoiser.

For `dnrpipe frontier`: Cycles is what the artist would render with. Bounces, clamping and caustics stay as in the file;
adaptive sampling and time limits are off, so that samples are what they say. Persistent data keeps the BVH between
frames, and each way of rendering is warmed by a frame that is thrown away.
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

from .drawing import make_renderer

METHODS: dict[str, tuple[str, str] | None] = {
    "raw": None,
    "denoised-fast": ("FAST", "FAST"),
    "denoised": ("ACCURATE", "HIGH"),
}
"""Blender's Open Image Denoise: (prefilter of albedo and normal, quality); ``denoised`` is Blender's default."""
REFERENCE = "reference"


class Worker:
    """common: {"threads"}; task: {"scene_dir", "views", "samples", "reference_spp", "folder", "output"}.

    Writes ``folder/NAME/VIEW.exr`` (linear Rec.709, premultiplied RGBA) for every NAME, such as ``4 spp raw``, and the
    reference, and then ``output``: {"threads", "ms": {NAME: processor time over the threads, per view}}.
    """

    def __init__(self, common: dict[str, Any]) -> None:
        self.threads = int(common["threads"]) or os.cpu_count() or 1

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        folder = Path(task["folder"])
        common = {"scene_dir": task["scene_dir"], "raster_engine": "cycles", "raster_samples": 1}
        draw = make_renderer("raster", {**common, "threads": self.threads})
        scene = bpy.context.scene
        views = [View.model_validate(view) for view in task["views"]]
        ms: dict[str, list[float]] = {}
        for spp in task["samples"]:
            for method, denoiser in METHODS.items():
                _sampling(scene, int(spp), 1, denoiser)
                ms[f"{spp} spp {method}"] = self._frames(draw, views, folder / f"{spp} spp {method}")
        _sampling(scene, int(task["reference_spp"]), 2, None)
        self._frames(draw, views, folder / REFERENCE, warm=False)
        made = {"threads": self.threads, "ms": ms}
        write_json(Path(task["output"]), made)
        return made

    def _frames(
        self, draw: Callable[[View, Path], None], views: list[View], folder: Path, warm: bool = True
    ) -> list[float]:
        folder.mkdir(parents=True, exist_ok=True)
        if warm:
            draw(views[0], folder / f"{views[0].name}.exr")
        found = []
        for view in views:
            cpu = time.process_time()
            draw(view, folder / f"{view.name}.exr")
            found.append(1000 * (time.process_time() - cpu) / self.threads)
        return found


def _sampling(scene: bpy.types.Scene, samples: int, seed: int, denoiser: tuple[str, str] | None) -> None:
    cycles = scene.cycles
    cycles.samples, cycles.seed = samples, seed
    cycles.use_denoising = denoiser is not None
    if denoiser is None:
        return
    cycles.denoiser, cycles.denoising_use_gpu = "OPENIMAGEDENOISE", False
    cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
    cycles.denoising_prefilter, cycles.denoising_quality = denoiser
    for layer in scene.view_layers:
        layer.cycles.use_denoising = True

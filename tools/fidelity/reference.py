"""Worker: build one scene, save it, render it with Cycles under two seeds. The only other user of bpy here."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import bpy

from dnrpipe.blender.passes.raster import output_exr, render_to

from .reference_settings import BOUNCES


class Worker:
    """task: {"case": name, "blend": path, "outputs": [path per seed], "spp": samples of each}."""

    def __init__(self, common: dict[str, Any]) -> None:
        del common

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        from . import studio
        from .catalogue import all_cases

        case = all_cases()[task["case"]]
        scene = studio.empty()
        case.build()
        scene.render.engine = "CYCLES"
        scene.render.resolution_x, scene.render.resolution_y = case.size
        scene.render.resolution_percentage = 100
        blend = Path(task["blend"])
        blend.parent.mkdir(parents=True, exist_ok=True)
        bpy.context.preferences.filepaths.save_version = 0
        bpy.ops.wm.save_as_mainfile(filepath=str(blend), compress=True)
        seconds = []
        for seed, output in enumerate(task["outputs"]):
            started = time.monotonic()
            configure_cycles(scene, int(task["spp"]), seed)
            render_to(scene, Path(output))
            seconds.append(time.monotonic() - started)
        return {"seconds": seconds}


def configure_cycles(scene: Any, samples: int, seed: int) -> None:
    """What a path tracer does by the book: box filter, no denoising, no clamping, caustics, transparent film."""
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.film_transparent = True
    render.use_compositing = render.use_sequencer = render.use_motion_blur = False
    render.dither_intensity = 0.0
    render.threads_mode, render.threads = "FIXED", 1
    cycles.device = "CPU"
    cycles.samples, cycles.seed = samples, seed
    cycles.use_animated_seed = False
    cycles.use_denoising = cycles.use_adaptive_sampling = False
    cycles.time_limit = 0
    cycles.film_exposure = 1.0
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
    cycles.caustics_reflective = cycles.caustics_refractive = True
    cycles.max_bounces = cycles.transparent_max_bounces = BOUNCES
    for kind in ("diffuse", "glossy", "transmission", "volume"):
        setattr(cycles, f"{kind}_bounces", BOUNCES)
    output_exr(scene, "image")

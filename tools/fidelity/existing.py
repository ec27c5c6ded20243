"""Worker: render an existing .blend with Cycles from its own camera. bpy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from dnrpipe.blender.passes.raster import render_to
from dnrpipe.blender.reading.opening import open_scene

from .reference import configure_cycles


class Worker:
    """task: {"blend": path, "outputs": [path per seed], "spp": samples of each, "size": [width, height]}."""

    def __init__(self, common: dict[str, Any]) -> None:
        del common

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        open_scene(Path(task["blend"]))
        scene: Any = bpy.context.scene
        scene.render.resolution_x, scene.render.resolution_y = task["size"]
        scene.render.resolution_percentage = 100
        scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1.0
        scene.render.use_border = scene.render.use_crop_to_border = scene.render.use_simplify = False
        scene.render.use_stamp = False
        for seed, output in enumerate(task["outputs"]):
            Path(output).parent.mkdir(parents=True, exist_ok=True)
            configure_cycles(scene, int(task["spp"]), seed)
            render_to(scene, Path(output))
        return {}

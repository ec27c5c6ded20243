"""Pictures of a world alone, rendered by Cycles."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from ..shading.colour_spaces import read_pixels

SIZE = (1024, 512)
SAMPLES = 16
"""Per pixel: a world has no noise of its own, so they only smooth edges."""


def render_equirect(world: Any) -> np.ndarray:
    """Radiance of ``world`` from the origin as float32 [H, W, 3], bottom row first, Blender's equirect layout.

    As Cycles renders it; values may not be finite.
    """

    def panorama(camera: Any, body: Any) -> None:
        camera.type = "PANO"
        holder: Any = camera if hasattr(camera, "panorama_type") else camera.cycles
        holder.panorama_type = "EQUIRECTANGULAR"
        # The image's centre is +X, its left half +Y.
        body.rotation_euler = (math.pi / 2, 0.0, -math.pi / 2)

    return _render(world, panorama, SIZE)


def render_close_up(world: Any, direction: np.ndarray, angle: float, size: int) -> np.ndarray:
    """Radiance around a direction (world space), float32 [size, size, 3], perspective, ``angle`` radians wide."""

    def aim(camera: Any, body: Any) -> None:
        camera.type = "PERSP"
        camera.lens_unit = "FOV"
        camera.sensor_fit = "HORIZONTAL"
        # The field of view has a lower limit; the focal length goes further, and a small sensor helps.
        camera.sensor_width = 1.0
        camera.lens = 0.5 / math.tan(angle / 2)
        body.rotation_mode = "QUATERNION"
        body.rotation_quaternion = Vector(direction.tolist()).to_track_quat("-Z", "Y")

    return _render(world, aim, (size, size))


def _render(world: Any, place: Callable[[Any, Any], None], size: tuple[int, int]) -> np.ndarray:
    """Cycles' picture of nothing but ``world``; ``place`` sets up the camera and its object."""
    scene = bpy.data.scenes.new("dnrpipe.world")
    camera = bpy.data.cameras.new("dnrpipe.world")
    body = bpy.data.objects.new("dnrpipe.world", camera)
    try:
        scene.collection.objects.link(body)
        place(camera, body)
        scene.camera, scene.world = body, world
        render = scene.render
        render.engine = "CYCLES"
        render.film_transparent = False
        render.resolution_x, render.resolution_y = size
        render.resolution_percentage = 100
        render.use_compositing = render.use_sequencer = False
        settings: Any = scene.cycles
        settings.device = "CPU"
        settings.samples = SAMPLES
        settings.use_adaptive_sampling = settings.use_denoising = False
        settings.sample_clamp_direct = settings.sample_clamp_indirect = 0.0
        settings.pixel_filter_type = "BOX"
        image = render.image_settings
        image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGB", "32"
        with tempfile.TemporaryDirectory() as folder:
            render.filepath = str(Path(folder) / "world.exr")
            bpy.ops.render.render(scene=scene.name, write_still=True)
            return read_pixels(Path(render.filepath), "Linear Rec.709")
    finally:
        bpy.data.objects.remove(body)
        bpy.data.cameras.remove(camera)
        bpy.data.scenes.remove(scene)

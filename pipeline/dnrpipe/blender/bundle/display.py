"""The scene's display transform: plain sRGB, or Blender's own OpenColorIO transform baked into a cube."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from dnrtrain.atomic import atomic_path

from ..shading.colour_spaces import read_pixels

LUT_SIZE = 49
"""Nodes per axis. With LUT_MAX and LUT_K node 30 of 48 falls on x = 1, where clipping transforms have their kink."""
LUT_MAX = 64.0
LUT_K = 1024.0
LUT_FILE = "display.npz"


def export_display(scene: bpy.types.Scene, scene_dir: Path) -> dict[str, Any]:
    """Fields exposure (stops), gamma, view_transform, display_lut of ``SceneFrame``.

    "Standard" without look, curves, gamma and white balance is the sRGB curve after 2^exposure: no file. Anything
    else is baked, exposure and gamma included (returned as 0 and 1), into ``scene_dir/display.npz``:
    ``lut`` float32 [N, N, N, 3] indexed [r, g, b], display values in [0, 1]; ``max``, ``k`` such that a linear value
    x lies at t = log2(1 + k x) / log2(1 + k max) of each axis.
    """
    view = scene.view_settings
    fields = {"exposure": 0.0, "gamma": 1.0, "view_transform": view.view_transform, "display_lut": None}
    if (
        view.view_transform == "Standard"
        and view.look == "None"
        and view.gamma == 1.0
        and not view.use_curve_mapping
        and not view.use_white_balance
        and scene.display_settings.display_device == "sRGB"
    ):
        return fields | {"exposure": float(view.exposure)}
    with atomic_path(scene_dir / LUT_FILE) as temporary:
        np.savez_compressed(temporary, lut=bake_lut(scene), max=np.float32(LUT_MAX), k=np.float32(LUT_K))
    return fields | {"display_lut": LUT_FILE}


def bake_lut(scene: bpy.types.Scene) -> np.ndarray:
    """Display values of all node colours under the scene's view settings, float32 [N, N, N, 3]."""
    t = np.linspace(0, 1, LUT_SIZE)  # log2(1 + k x) / log2(1 + k max)
    nodes = ((np.exp2(t * np.log2(1 + LUT_K * LUT_MAX)) - 1) / LUT_K).astype(np.float32)
    grid = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1)
    flat = grid.reshape(LUT_SIZE * LUT_SIZE, LUT_SIZE, 3)
    return display_values(scene, flat).reshape(grid.shape)


def display_values(scene: bpy.types.Scene, linear: np.ndarray) -> np.ndarray:
    """Send linear colours [H, W, 3] through ``image.save_render`` (Blender's OCIO), 16 bits per channel."""
    height, width = linear.shape[:2]
    rgba = np.ones((height, width, 4), dtype=np.float32)
    rgba[..., :3] = linear
    image = bpy.data.images.new("dnrpipe.display", width, height, alpha=False, float_buffer=True)
    try:
        image.colorspace_settings.name = "Linear Rec.709"
        image.pixels.foreach_set(rgba.ravel())
        image.update()
        with _png_output(scene), tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "display.png"
            image.save_render(str(path), scene=scene)
            return np.clip(read_pixels(path, "Non-Color"), 0, 1)
    finally:
        bpy.data.images.remove(image)


@contextmanager
def _png_output(scene: bpy.types.Scene) -> Iterator[None]:
    """16-bit RGB PNG through the scene's own view settings, without dithering; restored afterwards."""
    render: Any = scene.render
    settings = render.image_settings
    names = ["media_type", "file_format", "color_mode", "color_depth", "color_management"]
    kept = {name: getattr(settings, name) for name in names}
    dither = render.dither_intensity
    try:
        settings.media_type = "IMAGE"
        settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGB", "16"
        settings.color_management = "FOLLOW_SCENE"
        render.dither_intensity = 0.0
        yield
    finally:
        render.dither_intensity = dither
        for name in names:
            setattr(settings, name, kept[name])

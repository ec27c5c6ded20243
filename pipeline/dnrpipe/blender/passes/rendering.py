"""Render a scene of the open file to an EXR file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import bpy


def output_exr(scene: bpy.types.Scene, kind: Literal["layers", "image"]) -> None:
    """Let the scene write uncompressed float32 EXR: all passes, or the picture as linear Rec.709 RGBA."""
    settings = scene.render.image_settings
    if kind == "layers":
        settings.media_type = "MULTI_LAYER_IMAGE"
        settings.file_format = "OPEN_EXR_MULTILAYER"
        settings.use_exr_interleave = True  # one part: 5.0 writes a part per pass otherwise
    else:
        settings.media_type = "IMAGE"
        settings.file_format = "OPEN_EXR"
        settings.color_mode = "RGBA"
        # Files may work in another space (Rec.2020, ACEScg); the contract is Rec.709.
        settings.color_management = "OVERRIDE"
        settings.linear_colorspace_settings.name = "Linear Rec.709"
    settings.color_depth = "32"
    settings.exr_codec = "NONE"
    scene.render.use_file_extension = True
    scene.render.use_overwrite = True
    scene.render.use_placeholder = False


def render_to(scene: bpy.types.Scene, path: Path) -> None:
    """Render ``scene`` to ``path`` (.exr, see `output_exr`). Raises RuntimeError without a picture."""
    path.unlink(missing_ok=True)
    scene.render.filepath = str(path)
    layers = scene.view_layers
    single = {"layer": layers[0].name} if len(layers) == 1 else {}
    bpy.ops.render.render(write_still=True, scene=scene.name, **single)
    if not path.is_file():
        raise RuntimeError(f"Blender rendered scene '{scene.name}' without writing a picture")

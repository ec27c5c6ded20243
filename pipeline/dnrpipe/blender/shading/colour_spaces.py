"""Images that Blender loads for us, and decodes from their colour space by its own OpenColorIO."""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy
import numpy as np

from .image_files import write_colour_exr


def decode(texels: np.ndarray, space: str) -> np.ndarray:
    """RGBA [H, W, 4], uint8 codes in colour space ``space``, as float32 in the scene's linear space.

    Blender converts float files from their colour space when it loads them, so the codes take that way. Alpha is
    data and stays.
    """
    rgb = texels[..., :3].astype(np.float32) / 255
    with tempfile.TemporaryDirectory(prefix="dnrpipe-") as folder:
        path = Path(folder) / "codes.exr"
        write_colour_exr(path, rgb)
        decoded = read_pixels(path, space)
    # Files are written in array order, bottom row first; Blender takes the first row of a file for the top.
    decoded = decoded[::-1]
    alpha = texels[..., 3:].astype(np.float32) / 255
    return np.concatenate([decoded, alpha], axis=2)


def read_pixels(path: Path, space: str) -> np.ndarray:
    """Pixels of an image file, decoded from colour space ``space``: float32 [H, W, 3], bottom row first."""
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.name = space
        width, height = image.size
        flat = np.empty(width * height * image.channels, dtype=np.float32)
        image.pixels.foreach_get(flat)
        return flat.reshape(height, width, -1)[..., :3]
    finally:
        bpy.data.images.remove(image)

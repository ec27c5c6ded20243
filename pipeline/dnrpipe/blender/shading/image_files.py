"""Texture images as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dnrtrain.atomic import atomic_path

HALF_MAX = 65504.0


def write_png(path: Path, texels: np.ndarray) -> None:
    """8-bit grey or RGB PNG from uint8 [H, W, 1 or 3]."""
    from PIL import Image

    picture = Image.fromarray(texels[..., 0] if texels.shape[2] == 1 else texels)
    with atomic_path(path) as temporary:
        picture.save(temporary, format="PNG", compress_level=4)


def write_colour_exr(path: Path, texels: np.ndarray) -> None:
    """EXR from float [H, W, 1 or 3], linear Rec.709; half precision unless a value exceeds its range."""
    import OpenEXR

    kind = np.float16 if np.abs(texels).max(initial=0.0) < HALF_MAX else np.float32
    data = np.ascontiguousarray(texels, dtype=kind)
    channels = {"Y": data[..., 0].copy()} if data.shape[2] == 1 else {"RGB": data}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary, OpenEXR.File(header, channels) as file:
        file.write(str(temporary))

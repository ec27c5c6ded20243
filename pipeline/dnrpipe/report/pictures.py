"""Images of the workspace as data URIs: 8-bit files as they are, EXR files through the display transform."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, UnidentifiedImageError

from dnrtrain.contract import RASTER_CHANNELS, ContractError
from dnrtrain.exr import read_exr

from ..core.errors import UserError
from .data import Picture

if TYPE_CHECKING:
    from dnrtrain.display import DisplayTransform

FEATURED_SIDE = 800  # the paper's resolution, pixel for pixel
THUMBNAIL_SIDE = 192


def load_png(root: Path, file: str, *, side: int, heat: bool = False) -> Picture | None:
    """An image file of the workspace, reduced to ``side`` pixels if larger; None when there is no such file.

    heat: colour a one-channel error map with matplotlib's magma (perceptually uniform, readable in grey).
    Raises UserError: the file is damaged.
    """
    from matplotlib import colormaps

    path = root / file
    try:
        with Image.open(path) as opened:
            image = opened.copy()
    except FileNotFoundError:
        return None
    except (OSError, UnidentifiedImageError) as error:
        raise UserError(f"{path}: damaged image ({error}); run `dnrpipe evaluate` again") from None
    if heat and image.mode in ("L", "I;16", "I", "F"):
        values = np.asarray(image, dtype=np.float32)
        full = 255.0 if image.mode == "L" else 65535.0 if image.mode != "F" else 1.0
        image = Image.fromarray(np.rint(colormaps["magma"](values / full)[..., :3] * 255).astype(np.uint8))
    return encode(image.convert("RGBA" if "A" in image.getbands() else "RGB"), file, side)


def encode(image: Image.Image, file: str, side: int) -> Picture:
    """PNG data URI (lossless) at full size; a reduced image becomes WebP, eight times smaller."""
    buffer = io.BytesIO()
    if max(image.size) > side:
        scale = side / max(image.size)
        size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
        image.resize(size, Image.Resampling.LANCZOS).save(buffer, "WEBP", quality=90, method=4)
        kind = "webp"
    else:
        size = image.size
        image.save(buffer, "PNG", optimize=True)
        kind = "png"
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return Picture(uri=f"data:image/{kind};base64,{data}", width=size[0], height=size[1], file=file)


def load_exr(root: Path, file: str, display: DisplayTransform) -> Picture | None:
    """R G B A of an EXR (linear, premultiplied) over white as a thumbnail; None when the file or its colour is missing.

    Raises UserError: the file is damaged.
    """
    import torch

    path = root / file
    if not path.is_file():
        return None
    try:
        channels, _ = read_exr(path)
    except ContractError as error:
        raise UserError(str(error)) from None
    if not set(RASTER_CHANNELS) <= set(channels):
        return None
    rgba = torch.from_numpy(np.stack([channels[c] for c in RASTER_CHANNELS]))[None]
    rgb = display.over_white(rgba[:, :3], rgba[:, 3:])[0].clamp(0, 1)
    pixels = np.rint(rgb.permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    return encode(Image.fromarray(pixels), file, THUMBNAIL_SIDE)

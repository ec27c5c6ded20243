"""Open Image Denoise on the CPU: noisy path-traced images in, smooth ones out.

Notation
    image     linear Rec.709 radiance (HDR), any scale; premultiplied where it has alpha
    albedo    mean reflectance of what the pixel shows first, in [0, 1], 0 where nothing
    normal    world-space shading normal, in [-1, 1], 0 where nothing
    auxiliary albedo and normal: what keeps the denoiser from blurring textures and edges

The library is Intel's (https://www.openimagedenoise.org, Apache-2.0), bound by ``mitsuba-oidn`` (BSD-3-Clause), which
works in Dr.Jit's thread pool. The same input gives the same bits with any number of threads: the exposure, which the
library's threads would add up in any order, is given to it. One call at a time: filters are shared within the process.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Any, Literal

import numpy as np

from dnrpipe.core.errors import UserError
from dnrtrain.srgb import LUMINANCE

Quality = Literal["high", "balanced", "fast"]
BORDER = 2
"""Texels by which a chart goes on beyond its border: what is looked up there takes nothing from the chart beside it."""
GREY, BLOCK, DARKEST = 0.18, 16, 1e-8
"""The library's own exposure: mean log luminance of blocks of BLOCK² pixels goes to GREY; darker ones do not count."""


def denoise(
    image: np.ndarray,
    albedo: np.ndarray | None = None,
    normal: np.ndarray | None = None,
    *,
    clean: bool = True,
    quality: Quality = "high",
    threads: int = 0,
    scale: float | None = None,
) -> np.ndarray:
    """``image`` without its noise, float32, same shape.

    Args:
        image: [H, W, 3] or [H, W, 4]; alpha comes back as it is. Radiance below 0 becomes 0.
        albedo, normal: [H, W, 3]; the normal only together with the albedo.
        clean: the auxiliary images have no noise of their own (primary rays through many points of the pixel): the
            result then follows them more closely.
        quality: of the network; ``high`` takes the larger one where clean auxiliary images are given (2.4x the time),
            ``fast`` a smaller one (half the time).
        threads: 0: as many as Dr.Jit uses in this process.
        scale: exposure that the network sees the image at; None: the image's own.

    Raises:
        ValueError: wrong shape, or not finite; the message says where.
        UserError: the denoiser is not installed.
    """
    noisy = _checked("image", image, (3, 4))
    images = {"color": noisy[..., :3]}
    for name, auxiliary in (("albedo", albedo), ("normal", normal)):
        if auxiliary is not None:
            images[name] = _checked(name, auxiliary, (3,), noisy.shape)
    if "normal" in images and "albedo" not in images:
        raise ValueError("normal: needs the albedo beside it; the denoiser has no network for a normal alone")
    result = noisy.copy()
    result[..., :3] = _filtered(images, threads, quality, clean_aux=clean and len(images) > 1, scale=scale)
    return result


def filled(light: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """[H, W, C] float32 with the texels outside ``valid`` [H, W] made up: those next to valid ones from these, so that
    each chart goes on beyond its border, the rest by pull and push.

    Gortler et al., "The Lumigraph", 1996, section 3.4.2: averages of the valid texels at coarser and coarser levels
    fill the finer ones. Valid texels stay as they are; without any, the result is 0.
    """
    light, valid = light.astype(np.float32), valid.copy()
    for _ in range(BORDER):
        grown = beside(np.concatenate([light * valid[..., None], valid[..., None]], axis=-1))
        new = ~valid & (grown[..., -1] > 0)
        light[new] = grown[new][:, :-1] / grown[new][:, -1:]
        valid |= new
    weight = valid.astype(np.float32)[..., None]
    return np.where(valid[..., None], light, _pull_push(light * weight, weight)).astype(np.float32)


def beside(texels: np.ndarray) -> np.ndarray:
    """Sums over 3x3 texels."""
    for axis in (0, 1):
        padded = np.pad(texels, [(1, 1) if i == axis else (0, 0) for i in range(3)])
        first, middle, last = (np.moveaxis(padded, axis, 0)[k : k + texels.shape[axis]] for k in range(3))
        texels = np.moveaxis(first + middle + last, 0, axis)
    return texels


def filled_map(values: np.ndarray, texels: np.ndarray, size: int) -> np.ndarray:
    """[size, size, C] of the texels' values [T, C], the rest made up by `filled`. texels: their numbers [T]."""
    valid, image = np.zeros(size * size, bool), np.zeros((size * size, values.shape[1]), np.float32)
    valid[texels], image[texels] = True, values
    return filled(image.reshape(size, size, -1), valid.reshape(size, size))


def _pull_push(total: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Means of the valid texels, where there are none those of the next coarser level. ``total`` is weighted."""
    known = weight > 0
    mean = np.divide(total, weight, out=np.zeros_like(total), where=known)
    if max(total.shape[:2]) == 1 or known.all():
        return mean
    coarse = _pull_push(_halved(total), _halved(weight))
    height, width = total.shape[:2]
    finer = coarse.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(known, mean, finer)


def _halved(texels: np.ndarray) -> np.ndarray:
    """Means of blocks of 2x2; an odd last row or column is padded with nothing."""
    height, width = texels.shape[:2]
    padded = np.pad(texels, ((0, height % 2), (0, width % 2), (0, 0)))
    return padded.reshape((height + 1) // 2, 2, (width + 1) // 2, 2, -1).mean(axis=(1, 3))


def _checked(name: str, image: np.ndarray, channels: tuple[int, ...], like: tuple[int, ...] = ()) -> np.ndarray:
    """``image`` as contiguous float32 of its own. Raises ValueError."""
    array = np.array(image, dtype=np.float32, order="C")
    if array.ndim != 3 or array.shape[2] not in channels or min(array.shape[:2]) == 0:
        wanted = " or ".join(f"[H, W, {count}]" for count in channels)
        raise ValueError(f"{name}: has shape {array.shape}, expected {wanted}")
    if like and array.shape[:2] != like[:2]:
        raise ValueError(f"{name}: is {array.shape[1]}x{array.shape[0]}, expected {like[1]}x{like[0]} pixels")
    bad = ~np.isfinite(array).all(axis=-1)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise ValueError(
            f"{name}: not finite in {int(bad.sum())} of {bad.size} pixels, the first in row {row}, column {column};"
            " trace these again before denoising"
        )
    return array


@cache
def _device(threads: int) -> Any:
    """The CPU as OIDN device with so many threads; costs some ms, so it is kept."""
    try:
        import mitsuba_oidn as oidn
    except ModuleNotFoundError as error:
        raise UserError(
            f"the denoiser is not installed ({error}); install it with: pip install 'dnrpipe[render]'"
        ) from None
    device = oidn.Device(oidn.DeviceType.CPU)
    if threads > 0:
        device.num_threads = threads
    device.commit()
    return device


@lru_cache(maxsize=16)
def _filter(threads: int, shape: tuple[int, int], names: tuple[str, ...], quality: Any, clean_aux: bool) -> Any:
    """Filters are kept: a new one reads and arranges its weights, which takes longer than an image."""
    del shape, names  # each combination has a filter of its own
    filter_ = _device(threads).new_filter("RT")
    filter_.quality, filter_.hdr, filter_.clean_aux = quality, True, clean_aux
    return filter_


def exposure(image: np.ndarray) -> float:
    """What the network's input is multiplied with: 0.18 over the geometric mean of blocks' luminance."""
    height, width = image.shape[:2]
    rows, columns = np.arange(0, height, BLOCK), np.arange(0, width, BLOCK)
    sums = np.add.reduceat(np.add.reduceat(image.clip(0) @ LUMINANCE, rows, axis=0), columns, axis=1)
    means = sums / np.outer(np.minimum(BLOCK, height - rows), np.minimum(BLOCK, width - columns))
    lit = means[means > DARKEST]
    return float(GREY / np.exp2(np.log2(lit).mean())) if lit.size else 1.0


def _filtered(
    images: dict[str, np.ndarray], threads: int, quality: Quality, *, clean_aux: bool, scale: float | None
) -> np.ndarray:
    """Run one filter. images: contiguous or strided float32 [H, W, 3] by OIDN's names."""
    _device(threads)  # says what is missing before the import below fails
    import mitsuba_oidn as oidn

    levels = {"high": oidn.Quality.High, "balanced": oidn.Quality.Balanced, "fast": oidn.Quality.Fast}
    if quality not in levels:
        raise ValueError(f"quality: is {quality!r}, expected one of {', '.join(levels)}")
    shape = next(iter(images.values())).shape[:2]
    filter_ = _filter(threads, shape, tuple(images), levels[quality], clean_aux)
    # The filter keeps what it was last bound to, hence copies of its own and never the caller's memory.
    bound = {name: np.ascontiguousarray(image) for name, image in images.items()}
    result = np.empty((*shape, 3), dtype=np.float32)
    for name, image in bound.items():
        filter_.set_image(name, image)
    filter_.set_image("output", result)
    filter_.input_scale = exposure(bound["color"]) if scale is None else scale
    filter_.execute()
    return result

"""Pixels that are not finite: set to zero, and counted, so that whoever writes or shows the picture can say so."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


def masked(image: np.ndarray) -> tuple[np.ndarray, int]:
    """``image`` [H, W, C] with 0 in the pixels that hold a NaN or an infinity, and how many those are."""
    fine = np.isfinite(image).all(axis=-1, keepdims=True)
    lost = int(fine.size - np.count_nonzero(fine))
    return (np.where(fine, image, 0).astype(image.dtype) if lost else image), lost


def masked_channels(channels: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], int]:
    """The same of channels [H, W]: a pixel that is not finite in one of them becomes 0 in all.

    Nearly always there is nothing to do, and then it costs one addition a value: a sum is finite where its terms are.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        sums = [float(values.sum()) for values in channels.values()]
    if np.isfinite(sums).all():
        return dict(channels), 0
    bad = ~np.logical_and.reduce([np.isfinite(values) for values in channels.values()])
    return {name: np.where(bad, values.dtype.type(0), values) for name, values in channels.items()}, int(bad.sum())

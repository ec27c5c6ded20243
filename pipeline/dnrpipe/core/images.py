"""Display-space pictures: write them, compare them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dnrtrain.atomic import atomic_path
from dnrtrain.exr import read_exr

if TYPE_CHECKING:
    from dnrtrain.display import DisplayTransform


def flip_error(truth: np.ndarray, prediction: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean LDR-FLIP and its heat map [H, W, 3] (magma) of two display-space images [H, W, 3] in [0, 1].

    NVIDIA's flip-evaluator at its default 67 pixels per degree.
    """
    import flip_evaluator

    heat, mean, _ = flip_evaluator.evaluate(
        np.ascontiguousarray(truth, np.float32), np.ascontiguousarray(prediction, np.float32), "LDR"
    )
    return float(mean), np.asarray(heat)


def mean_known(values: Iterable[float | None]) -> float | None:
    """The mean of the figures that are known; None where none is."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def rgba(channels: Mapping[str, np.ndarray], prefix: str = "") -> np.ndarray:
    """The channels ``prefix`` + R, G, B, A, each [H, W], as [H, W, 4]."""
    return np.stack([channels[prefix + c] for c in "RGBA"], axis=-1)


def read_rgba(path: Path) -> np.ndarray:
    """`rgba` of an EXR, linear premultiplied, float32 [H, W, 4]. Raises DamagedFile."""
    return rgba(read_exr(path)[0])


def over_white(display: DisplayTransform, image: np.ndarray) -> Any:
    """Premultiplied linear RGBA [H, W, 4] -> display RGB over white, torch [1, 3, H, W]."""
    import torch

    planes = torch.from_numpy(np.ascontiguousarray(image, dtype=np.float32)).permute(2, 0, 1)[None]
    return display.over_white(planes[:, :3], planes[:, 3:])


def picture_of(tensor: Any) -> np.ndarray:
    """Display-space RGB, torch [3, H, W], as float32 [H, W, 3] in [0, 1]."""
    return tensor.float().clamp(0, 1).permute(1, 2, 0).cpu().numpy()


def eight_bit(image: np.ndarray) -> np.ndarray:
    """Values, clipped to [0, 1], as uint8 of the same shape: 1 is 255."""
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write display-space [H, W, 3] in [0, 1] as 8-bit PNG, atomically."""
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(eight_bit(image)).save(temporary, compress_level=3)  # a third of the time, a tenth more bytes

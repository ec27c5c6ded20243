"""References: many samples per pixel in two halves, kept on disk, so that their own noise is known.

A half's noise is independent of the other's: rms((A - B) / 2) estimates the RMSE of the mean. Where that alone would
cap what can be measured (caustics, light through openings), the halves are denoised with clean auxiliary images, each
by itself; what is left of the noise is estimated in the same way. The denoiser's own bias stays, and favours the
baselines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.core.images import rgba
from dnrpipe.core.workspace import digest
from dnrpipe.raytrace.denoise import denoise
from dnrpipe.stages.raytrace import view_seed
from dnrpipe.studies.frames.scene import BenchScene
from dnrtrain.contract import View
from dnrtrain.exr import read_exr, read_metadata, write_exr

AUXILIARY_RAYS = 64
LEAST_CEILING = 40.0
"""dB: a raw reference whose noise caps the PSNR below this is denoised (with ``auto``)."""
HALVES = ("a", "b")


@dataclass(frozen=True)
class Reference:
    """Per view. halves: RGBA linear, premultiplied [H, W, 4]; pictures: their means; noise: RMSE in display space."""

    kind: str
    spp: int
    halves: list[list[np.ndarray]]
    noise: list[float]

    @property
    def pictures(self) -> list[np.ndarray]:
        return [np.mean(pair, axis=0) for pair in self.halves]

    @property
    def ceiling(self) -> float:
        """dB that a perfect renderer would measure, mean over the views."""
        return float(np.mean([-20 * math.log10(max(value, 1e-5)) for value in self.noise]))


def make_references(
    scene: BenchScene, views: list[View], split: str, spp: int, kind: str, folder: Path, tell: Any
) -> Reference:
    """Trace what is not on disk yet. kind: raw, denoised or auto; tell: called with a line per traced view."""
    halves = []
    for view in views:
        halves.append(_halves(scene, view, split, spp, folder / f"{split}-{view.name}.exr"))
        tell(f"{scene.name}: reference of {split} view {view.name}")
    raw = Reference("raw", spp, halves, [_noise(scene, pair) for pair in halves])
    if kind == "raw" or (kind == "auto" and raw.ceiling >= LEAST_CEILING):
        return raw
    smooth = []
    for view, pair in zip(views, halves, strict=True):
        guide = scene.frames.auxiliary(view, AUXILIARY_RAYS, view_seed(1, split, view.name))
        smooth.append([denoise(half, guide.albedo, guide.normal) for half in pair])
    return Reference("denoised", spp, smooth, [_noise(scene, pair) for pair in smooth])


def _halves(scene: BenchScene, view: View, split: str, spp: int, path: Path) -> list[np.ndarray]:
    """[A, B], float32 [H, W, 4]."""
    fingerprint = digest([scene.fingerprint, view.model_dump(mode="json"), spp])
    if (read_metadata(path) or {}).get("fingerprint") != fingerprint:
        integrator, _ = scene.engine.integrator(scene.bundle, scene.integrator, scene.max_depth)
        sensor, seed = scene.engine.sensor(view), view_seed(7, split, view.name)
        channels = {}
        for number, half in enumerate(HALVES):
            image, _ = scene.engine.frame(scene.bundle, integrator, sensor, view, spp // 2, 2 * seed + number)
            finite = np.isfinite(image).all(axis=-1, keepdims=True)
            channels |= {f"{half}.{c}": np.where(finite, image, 0)[..., i] for i, c in enumerate("RGBA")}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_exr(path, channels, {"fingerprint": fingerprint, "spp": spp})
    channels, _ = read_exr(path)
    return [rgba(channels, f"{half}.") for half in HALVES]


def _noise(scene: BenchScene, pair: list[np.ndarray]) -> float:
    a, b = (scene.shown(half).numpy() for half in pair)
    return float(np.sqrt(np.mean(((a - b) / 2) ** 2)))

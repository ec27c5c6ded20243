"""The rival's ladder: path tracing at a few samples, and Open Image Denoise with what can be had for little time.

Methods
    raw            as traced
    colour[-fast]  the denoiser sees the picture alone
    cover-fast     the same, and the alpha is the coverage of 16 stratified primary rays
    same           albedo and normal from as many primary rays as there are samples
    cleanN[-q]     albedo, normal and coverage from N stratified primary rays, taken for clean; q: the network

Coverage matters: over white, silhouettes of a few random samples cost up to 2 dB that no denoiser sees. Primary rays
are a kernel of their own, far cheaper than Mitsuba's ``aov`` integrator around the path tracer, which doubles a frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from dnrtrain.contract import View

from ...raytrace.denoise import Quality, denoise
from ...raytrace.finite import masked
from .scene import BenchScene, Clock

MANY = 16
"""From so many stratified primary rays on, auxiliary images count as clean."""


@dataclass(frozen=True)
class Method:
    """rays: primary rays for auxiliary images and coverage, 0 none, -1 as many as samples."""

    rays: int = 0
    denoise: bool = True
    guided: bool = False
    quality: Quality = "high"


METHODS: dict[str, Method] = {
    "raw": Method(denoise=False),
    "colour-fast": Method(quality="fast"),
    "colour": Method(),
    "cover-fast": Method(rays=16, quality="fast"),
    "same": Method(rays=-1, guided=True),
    "clean4-fast": Method(rays=4, guided=True, quality="fast"),
    "clean4-balanced": Method(rays=4, guided=True, quality="balanced"),
    "clean16-fast": Method(rays=16, guided=True, quality="fast"),
    "clean16-balanced": Method(rays=16, guided=True, quality="balanced"),
    "clean16": Method(rays=16, guided=True),
}


@dataclass
class Rung:
    """One way of rendering: milliseconds of its parts and display pictures, view by view.

    masked: pixels of them that were not finite, and are black.
    """

    spp: int
    method: str
    parts: dict[str, list[float]] = field(default_factory=dict)
    pictures: list[Any] = field(default_factory=list)
    masked: int = 0

    @property
    def name(self) -> str:
        return f"{self.spp} spp {self.method}"

    def ms(self) -> float:
        """Median over the views of the sum of the parts."""
        return float(np.median(np.sum(list(self.parts.values()), axis=0)))


def make_rungs(samples: tuple[int, ...], methods: tuple[str, ...] = tuple(METHODS)) -> dict[str, Rung]:
    rungs = [Rung(spp, method) for spp in samples for method in methods]
    return {rung.name: rung for rung in rungs}


def climb(scene: BenchScene, view: View, seed: int, clock: Clock, rungs: dict[str, Rung]) -> None:
    """Render the view on every rung. What rungs share (paths, primary rays) is rendered once and booked on each.

    Kernels and filters must be warm: call once and forget the result. Pictures are kept as float16, display over white.
    """

    def traced(spp: int) -> tuple[np.ndarray, int]:
        return masked(scene.frames.path(view, spp, seed + spp))

    paths: dict[int, tuple[tuple[np.ndarray, int], float]] = {}
    guides: dict[int, tuple[Any, float]] = {0: (None, 0.0)}
    for rung in rungs.values():
        method = METHODS[rung.method]
        if rung.spp not in paths:
            paths[rung.spp] = clock.time(partial(traced, rung.spp))
        rays = rung.spp if method.rays < 0 else method.rays
        if rays not in guides:
            guides[rays] = clock.time(partial(scene.frames.auxiliary, view, rays, seed + 7919 * rays))
        ((image, lost), path_ms), (guide, rays_ms), denoiser_ms = paths[rung.spp], guides[rays], 0.0
        rung.masked += lost
        if method.denoise:
            image, denoiser_ms = clock.time(partial(_denoised, image, guide, method, rays))
        if guide is not None:
            image = np.concatenate([image[..., :3], guide.coverage[..., None]], axis=-1)
        for part, ms in (("path", path_ms), ("primary rays", rays_ms), ("denoiser", denoiser_ms)):
            rung.parts.setdefault(part, []).append(ms)
        rung.pictures.append(scene.shown(image).half())


def _denoised(image: np.ndarray, guide: Any, method: Method, rays: int) -> np.ndarray:
    if not method.guided:
        return denoise(image, quality=method.quality)
    clean = method.rays > 0 or rays >= MANY
    return denoise(image, guide.albedo, guide.normal, clean=clean, quality=method.quality)

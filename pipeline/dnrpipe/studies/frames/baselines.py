"""The baselines: path tracing at a few samples per pixel, and Open Image Denoise with what little time can buy.

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from dnrtrain.contract import View

from ...raytrace.denoise import Quality, denoise
from ...raytrace.engine import masked
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


@dataclass(kw_only=True)
class Ran:
    """One renderer's frames: milliseconds of the parts and display pictures, view by view."""

    parts: dict[str, list[float]] = field(default_factory=dict)
    pictures: list[Any] = field(default_factory=list)

    def ms(self) -> float:
        """Median over the views of the sum of the parts."""
        return float(np.median(np.sum(list(self.parts.values()), axis=0)))


@dataclass
class Baseline(Ran):
    """One way of path tracing. masked: pixels of its pictures that were not finite, and are black."""

    spp: int
    method: str
    masked: int = 0

    @property
    def name(self) -> str:
        return f"{self.spp} spp {self.method}"


def make_baselines(sample_counts: Sequence[int], methods: Sequence[str] = tuple(METHODS)) -> dict[str, Baseline]:
    """Every method at every number of samples, by name; nothing is rendered yet."""
    baselines = [Baseline(spp, method) for spp in sample_counts for method in methods]
    return {baseline.name: baseline for baseline in baselines}


def render_baselines(
    scene: BenchScene,
    view: View,
    seed: int,
    clock: Clock,
    baselines: Mapping[str, Baseline],
) -> None:
    """Render the view by every baseline. What they share (paths, primary rays) is rendered once and counts for each.

    Kernels and filters must be warm: call once and forget the result. Pictures are kept as float16, display over white.
    """

    def traced(spp: int) -> tuple[np.ndarray, int]:
        return masked(scene.frames.path(view, spp, seed + spp))

    paths: dict[int, tuple[tuple[np.ndarray, int], float]] = {}
    guides: dict[int, tuple[Any, float]] = {0: (None, 0.0)}
    for baseline in baselines.values():
        method = METHODS[baseline.method]
        if baseline.spp not in paths:
            paths[baseline.spp] = clock.time(partial(traced, baseline.spp))
        rays = baseline.spp if method.rays < 0 else method.rays
        if rays not in guides:
            guides[rays] = clock.time(partial(scene.frames.auxiliary, view, rays, seed + 7919 * rays))
        ((image, lost), path_ms), (guide, rays_ms), denoiser_ms = paths[baseline.spp], guides[rays], 0.0
        baseline.masked += lost
        if method.denoise:
            image, denoiser_ms = clock.time(partial(denoised, image, guide, method, rays))
        if guide is not None:
            image = np.concatenate([image[..., :3], guide.coverage[..., None]], axis=-1)
        for part, ms in (("path", path_ms), ("primary rays", rays_ms), ("denoiser", denoiser_ms)):
            baseline.parts.setdefault(part, []).append(ms)
        baseline.pictures.append(scene.shown(image).half())


def denoised(image: np.ndarray, guide: Any, method: Method, rays: int) -> np.ndarray:
    """The picture [H, W, 4] as the method denoises it. guide: auxiliary images of so many primary rays."""
    if not method.guided:
        return denoise(image, quality=method.quality)
    clean = method.rays > 0 or rays >= MANY
    return denoise(image, guide.albedo, guide.normal, clean=clean, quality=method.quality)

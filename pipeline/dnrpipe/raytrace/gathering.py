"""Final gathering: light maps whose rays end after one bounce, at a coarser light map.

Notation
    E_0, S_0   a coarse light map, path-traced and denoised (see `lightmap`)
    D          what of E comes from emitters
    I          the rest: what cosine-distributed rays from the texel meet, each answered by E_0 and S_0
    E          D + I, each with samples of its own and denoised by itself;   S = S_0, enlarged: it is smooth

One bounce is shorter than a path, and a map that is denoised already answers with far less noise (Reichert, "A Two-Pass
Radiosity Method Driven by Lights and Viewer Position", 1992; Jensen, "Realistic Image Synthesis Using Photon Mapping",
2001, section 9.3.4). What is wrong with the coarse map, the bounce blurs. Mirrors, glass and glossy lobes that a ray
meets first are followed as a view follows them (`specular_paths`), so caustics are in; faint ones end by chance.

The samples of a texel are spread: their pairs of numbers for place, emitter and direction come from shifted R2
sequences (Roberts 2018), the shifts being each texel's own.

BSDFs that do not split into lobes count as diffuse where rays meet them, as in base images. What media scatter the map
does not know: scenes that have any are path-traced (`can_gather`).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .lightmap import LEAST_RHO, LightBaker, light_texture
from .lobes import media_of
from .sequence import GOLDEN, fraction

COARSE, COARSE_PATHS = 256, 1 << 22
"""Least side of the coarse map, and its paths: 64 per texel of that side."""
FINER = 8
"""Sides of the light map per side of the coarse one, at most."""
DIRECT = 2
"""Samples of emitters per gathered ray: one costs a quarter of it, and half the noise is theirs."""


def can_gather(scene: Any) -> bool:
    """Whether a light map says what a ray of the scene meets."""
    return not media_of(scene)


class GatheringBaker(LightBaker):
    """Bakes E and S of one scene by final gathering.

    Args:
        integrator, gloss: of the coarse map, as `LightBaker`'s, but one bounce less: gathering adds it.
        pixels: of the fine map; all of the coarse one lights it.
        caustics: False: light that comes from mirror-like lobes is left out.
    """

    def __init__(
        self,
        mi: Any,
        scene: Any,
        integrator: Any,
        groups: Sequence[tuple[Path, np.ndarray]] = (),
        *,
        gloss: bool = True,
        caustics: bool,
        pixels: np.ndarray | None = None,
    ) -> None:
        super().__init__(mi, scene, integrator, groups, gloss=gloss)
        self.fine_pixels, self.caustics, self.gathers = pixels, caustics, False

    def bake(self, size: int, spp: int, seed: int) -> np.ndarray:
        """As `LightBaker.bake`. spp: gathered rays per texel."""
        side = min(size, max(COARSE, size // FINER))
        coarse = super().bake(side, max(1, COARSE_PATHS // side**2), 2 * seed)
        traced, lost = self.integrator, self.lost
        self.integrator, self.pixels, self.gathers = self._gathered(coarse), self.fine_pixels, True
        try:
            emitters = functools.partial(self._light, indirect=False)
            surfaces = functools.partial(self._light, direct=False)
            light = self._map(surfaces, size, spp, 8 * seed + 4, LEAST_RHO)
            light += self._map(emitters, size, DIRECT * spp, 8 * seed + 6, LEAST_RHO)
        finally:
            self.integrator, self.pixels, self.gathers = traced, None, False
        self.lost += lost
        return np.stack([light, [enlarged(image, size) for image in coarse[1]]])

    def _gathered(self, coarse: np.ndarray) -> Gathered:
        return Gathered(self.mi, self.scene, coarse, gloss=self.glossy, caustics=self.caustics)

    def _numbers(self, sampler: Any, texel: Any, index: Any, count: Any, seed: Any) -> Any:
        return SpreadNumbers(self.mi, sampler, texel, index, count, seed) if self.gathers else sampler


class Gathered:
    """Stands for the integrator of a `LightBaker` whose numbers are `SpreadNumbers`.

    Args:
        light: E and S of the front and of the back, float32 [2, 2, size, size, 3], row 0 at V = 0.
        gloss: rays end at rough lobes, where S says what these see. caustics: False: rays end at mirror-like lobes.
    """

    ends_at_emitters = True
    """Its paths end at emitters that they meet first: `LightBaker` need not look for these."""

    def __init__(self, mi: Any, scene: Any, light: np.ndarray, *, gloss: bool, caustics: bool) -> None:
        from .specular_paths import SpecularPaths  # imports Mitsuba

        self.mi = mi
        self.paths = SpecularPaths(scene, camera=False, gloss=gloss, caustics=caustics)
        self.light = light_texture(mi, light, gloss=self.paths.ends_at_rough)

    def sample(self, scene: Any, numbers: Any, ray: Any, medium: Any, active: Any) -> tuple[Any, Any, list[Any]]:
        """As `mi.SamplingIntegrator.sample` with emitters hidden. medium: None."""
        import drjit as dr

        mi = self.mi
        forward, number, order = mi.Vector3f(ray.d), dr.select(active, mi.Float(0), -1), mi.Float(0)
        values = self.paths.trace(
            scene, self.light, self.paths.steps, mi.Ray3f(ray), forward, number, order, sampler=numbers.sampler
        )
        return mi.Spectrum(*values[1:4]), active, []


class SpreadNumbers:
    """Random numbers of a texel's samples; pairs are spread over the square.

    Args:
        sampler: of single numbers, and of what loops draw.
        texel: of each sample.
        index: of the samples within their texels.
        count: of their texels' samples.
        seed: mi.UInt32.
    """

    def __init__(self, mi: Any, sampler: Any, texel: Any, index: Any, count: Any, seed: Any) -> None:
        self.mi, self.sampler, self.texel, self.index = mi, sampler, texel, index
        self.last = count - 1
        for bits in (1, 2, 4, 8, 16):
            self.last = self.last | (self.last >> bits)  # the next power of two, less one
        self.seed, self.drawn = seed << 8, 0

    def next_1d(self) -> Any:
        return self.sampler.next_1d()

    def next_2d(self) -> Any:
        """Of the sequence's first places, in an order of the texel's own: pairs do not depend on each other."""
        mi = self.mi
        self.drawn += 1
        shifts = mi.sample_tea_32(self.texel, self.seed + self.drawn)
        start, step = mi.sample_tea_32(self.texel, ~(self.seed + self.drawn))
        place = mi.Float((start + self.index * (step | 1)) & self.last)  # an odd step comes by all places of 2^n
        pair = (fraction(mi.Float(s >> 8) * 2**-24 + place * each) for s, each in zip(shifts, GOLDEN, strict=True))
        return mi.Point2f(*pair)


def enlarged(image: np.ndarray, size: int) -> np.ndarray:
    """[n, n, C] -> [size, size, C], bilinear between the middles of texels."""
    at = ((np.arange(size, dtype=np.float32) + 0.5) * (len(image) / size) - 0.5).clip(0, len(image) - 1)
    low = at.astype(int)
    high, t = (low + 1).clip(max=len(image) - 1), at - low
    rows = image[low] + (image[high] - image[low]) * t[:, None, None]
    return rows[:, low] + (rows[:, high] - rows[:, low]) * t[:, None]

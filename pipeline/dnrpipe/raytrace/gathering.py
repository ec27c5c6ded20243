"""Final gathering: what a ray from a diffuse surface meets, by a light map instead of a path.

A coarse light map, path-traced and denoised, answers each ray of the fine one after a single bounce (Reichert, "A
Two-Pass Radiosity Method Driven by Lights and Viewer Position", 1992; Jensen, "Realistic Image Synthesis Using Photon
Mapping", 2001, section 9.3.4): shorter paths, and much less noise. Mirrors, glass and glossy lobes on the way are
followed as a view follows them (`specular_paths`), which is how caustics come in.

The map's errors are blurred by the bounce: its texels may be large. What a view's base image leaves out of the scene is
left out of gathered light as well: lobes of BSDFs that do not split count as diffuse. Media scatter what it does not
know of: scenes that have any are path-traced.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .lightmap import LEAST_RHO, LightBaker
from .lobes import media_of
from .sequence import GOLDEN

COARSE, HALF = 8, 2
BOUNCES = 6

def can_gather(scene: Any) -> bool:
    """Whether a light map says what a ray of the scene meets."""
    return not media_of(scene)


class Gathered:
    """Stands for the integrator of a `LightBaker`.

    Args:
        light: E and S of the front and of the back, float32 [2, 2, size, size, 3], row 0 at V = 0.
        caustics: False: light that came by mirror-like lobes after a diffuse one is left out.
    """

    def __init__(self, mi: Any, scene: Any, light: np.ndarray, *, caustics: bool) -> None:
        from .specular_paths import SpecularPaths, light_textures  # imports Mitsuba

        self.mi = mi
        self.light = light_textures(light)
        self.paths = SpecularPaths(scene, camera=False, caustics=caustics)

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any, active: Any) -> tuple[Any, Any, list[Any]]:
        """As `mi.SamplingIntegrator.sample`, emitters hidden; ``medium``: None."""
        import drjit as dr

        mi = self.mi
        number = dr.select(active, mi.Float(0), -1)
        forward, order = mi.Vector3f(ray.d), sampler.next_1d()
        values = self.paths.trace(
            scene, self.light, self.paths.steps, mi.Ray3f(ray), forward, number, order, getattr(sampler, 'inner', sampler)
        )
        return mi.Spectrum(*values[1:4]), active, []


class GatheringBaker(LightBaker):
    def __init__(self, mi, scene, groups=(), caustics=True):
        super().__init__(mi, scene, None, groups)
        self.caustics = caustics
        self.spread = True

    def bake(self, size, spp, seed, gather=8, bounces=BOUNCES, coarse=COARSE, half=HALF, gloss=4):
        import functools, time
        self.lost = 0
        t = [time.process_time()]
        told = []
        def tick(name):
            t.append(time.process_time()); told.append((name, round(t[-1]-t[-2], 1)))
        lit = functools.partial(self._light, indirect=False)
        by_surfaces = functools.partial(self._light, direct=False)
        small = max(size // coarse, 16)
        direct = self._map(lit, small, 16, 8 * seed, LEAST_RHO)
        tick('direct small')
        light = np.stack([direct, 0 * direct])
        for bounce in range(bounces):
            self.integrator = Gathered(self.mi, self.scene, light, caustics=self.caustics)
            light[0] = direct + self._map(by_surfaces, small, 4, 4096*bounce+8 * seed, LEAST_RHO)
            if self.glossy:
                light[1] = self._map(self._gloss, small, 4, 4096*bounce+8 * seed + 2)
            tick('bounce %.4f %.4f' % ((light[0]-direct).mean(), light[1].mean()))
        self.integrator = Gathered(self.mi, self.scene, light, caustics=self.caustics)
        found = self._map(by_surfaces, size // half, gather, 8 * seed+2, LEAST_RHO)
        tick('gather')
        found = np.stack([resized(x, size) for x in found])
        tick('resize')
        found += self._map(lit, size, spp, 8 * seed+4, LEAST_RHO)
        tick('direct')
        s = 0 * found
        if self.glossy:
            s = self._map(self._gloss, size // half, gloss, 8 * seed + 6)
            s = np.stack([resized(x, size) for x in s])
        tick('gloss')
        print(told)
        return np.stack([found, s])


def resized(image, size):
    if image.shape[0] == size:
        return image
    at = (np.arange(size) + 0.5) * image.shape[0] / size - 0.5
    low = np.floor(at).astype(int)
    t = (at - low).astype(np.float32)
    a, b = low.clip(0, image.shape[0] - 1), (low + 1).clip(0, image.shape[0] - 1)
    rows = image[a] + (image[b] - image[a]) * t[:, None, None]
    return rows[:, a] + (rows[:, b] - rows[:, a]) * t[:, None]


class Spread:
    """Numbers of a texel's samples: pairs drawn before the path's loop are spread over the square."""
    def __init__(self, mi, inner, texel, index, seed):
        self.mi, self.inner, self.texel, self.index, self.seed, self.pairs = mi, inner, texel, index, seed, 0
    def next_1d(self, active=True):
        return self.inner.next_1d(active)
    def next_2d(self, active=True):
        import drjit as dr
        mi = self.mi
        self.pairs += 1
        a, b = mi.sample_tea_32(self.texel, self.seed + self.pairs)
        shift = mi.Point2f(mi.Float(a >> 8), mi.Float(b >> 8)) * 2**-24
        place = shift + mi.Point2f(mi.Float(self.index) * GOLDEN[0], mi.Float(self.index) * GOLDEN[1])
        return place - dr.floor(place)

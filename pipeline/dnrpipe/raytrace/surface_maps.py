"""What the scene's surfaces are, over the atlas: diffuse reflectance, emission, opacity, geometric normal.

A worker (see `dnrpipe.workers.processes`). Together with the light map this is all that a rasteriser needs to show
the scene's diffuse light: radiance = albedo · light + emission (`base_renderer` says the same of rays).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dnrtrain.atomic import atomic_path

from .denoise import filled_map
from .engine import BundleWorker
from .lightmap import LightBaker
from .lobes import diffuse_context, mean_of, reflectance
from .tasks import SurfaceAnswer, SurfaceTask
from .texels import grouped_meshes


class Worker(BundleWorker):
    """Evaluates surfaces. common: a `BundleCommon`, task: a `SurfaceTask`.

    The file is an ``npz``, row 0 at V = 0, gaps between charts filled: ``albedo`` and ``emission`` float32
    [2, n, n, 3] (front, back; linear Rec.709), ``opacity`` [n, n], ``normal`` [n, n, 3] (the triangles', world space),
    ``thin`` bool: whether any surface's back can be seen. Samples that are not finite are left out of their texel's
    mean.
    """

    compiled_for = "surface maps need"

    def __call__(self, task: dict[str, Any]) -> SurfaceAnswer:
        asked = SurfaceTask.model_validate(task)
        mapper = SurfaceMapper(self.engine.mi, self.engine.scenes[str(self.bundle)], None, grouped_meshes(self.bundle))
        maps = mapper.maps(asked.size, asked.samples, asked.seed)
        with atomic_path(asked.output) as temporary, temporary.open("wb") as file:
            np.savez(file, **maps)  # pyright: ignore[reportArgumentType]
        return {"texels": asked.size**2, "lost": mapper.lost}


class SurfaceMapper(LightBaker):
    """Maps of one scene's surfaces; finds its points as the light's baker does."""

    def maps(self, size: int, samples: int, seed: int) -> dict[str, np.ndarray]:
        """The maps that `Worker` writes. samples: points per texel."""
        self.lost = 0
        found = {
            "albedo": np.zeros((2, size, size, 3), np.float32),
            "emission": np.zeros((2, size, size, 3), np.float32),
            "opacity": np.ones((size, size), np.float32),
            "normal": np.zeros((size, size, 3), np.float32),
            "thin": np.array(False),
        }
        if not self.surface.count:
            return found
        texels, _, normal, sides, _ = self.occupied(size)
        thin = sides[:, 1]
        found["normal"] = filled_map(normal, texels, size)
        found["thin"] = np.array(bool(thin.any()))
        for number, side in enumerate((1, -1)):
            chosen = texels if side > 0 else texels[thin]
            if not len(chosen):
                continue
            sums = self._traced(self._properties, chosen, size, samples, seed * 4 + number, side)
            count = sums[:, 7:8]
            self.lost += round(float(sums[:, 8].sum(dtype=np.float64)))
            mean = np.divide(sums[:, :7], count, out=np.zeros_like(sums[:, :7]), where=count > 0)
            met = count[:, 0] > 0
            if not met.any():
                continue
            whole = filled_map(mean[met], chosen[met], size)
            found["albedo"][number], found["emission"][number] = whole[..., :3], whole[..., 3:6]
            if side > 0:
                found["opacity"] = whole[..., 6]
        return found

    def _properties(self, sampler: Any, uv: Any, side: int) -> list[Any]:
        """Reflectance, emission, opacity at each (U, V), 1 where there is a surface, 1 where it is not finite."""
        import drjit as dr

        mi = self.mi
        si, found = self._surface(sampler, uv, side)
        bsdf = si.bsdf()
        rho = reflectance(mi, bsdf, diffuse_context(mi), si, found)
        emitter = si.emitter(self.scene)
        emission = dr.select(found, emitter.eval(si, found), 0)
        opacity = mi.Float(1.0)
        if self.lets_through:
            opacity = 1 - mean_of(bsdf.eval_null_transmission(si, found))
        fine = found & dr.all(dr.isfinite(rho)) & dr.all(dr.isfinite(emission)) & dr.isfinite(opacity)
        one = mi.Float(1.0)
        return [*(dr.select(fine, value, 0) for value in (*rho, *emission, opacity, one)), self._one(found & ~fine)]

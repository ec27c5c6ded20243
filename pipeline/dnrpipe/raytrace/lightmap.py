"""Baked light: the diffusely reflected light of every atlas texel, path-traced once for all views.

Notation
    x        a point of the surface; n its geometric normal; side +1 or -1: lit and seen from n's side or the other
    f_d      diffuse part of the BSDF, both of reflection and transmission
    rho      pi (f_d(n, n) + f_d(n, -n)): the diffuse reflectance, transmittance included
    B        ∫ f_d(n, w) L(x, w) |cos w| dw: what the surface sends back diffusely, view-independent
    E        B / rho, the light map: W sr^-1 m^-2, linear Rec.709

At a view, B is E times the reflectance of that very point (:mod:`.base`), so that the map holds light alone, which is
smooth, and textures stay as sharp as they are. Direct light is sampled at the emitters; the rest of the path is the
plan's own integrator, from the first bounce on, with all its effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .denoise import denoise, filled
from .frames_rays import lets_through
from .lobes import diffuse_context, reflectance
from .texels import AtlasSurface

MAX_SAMPLES = 4_000_000
LIFT = 2e-4
"""Of the scene's size: how far above a surface the ray starts that finds it again."""
LEAST_RHO = 1e-3
"""Texels that reflect less hold no light worth knowing."""
MAX_LAYERS = 16
"""Surfaces that a shadow ray passes at most."""


class LightBaker:
    """Bakes E of one scene.

    integrator: continues paths from their first bounce on; emitters that it meets first must be hidden. None: direct
    light alone. groups: see :class:`.texels.AtlasSurface`.
    """

    def __init__(self, mi: Any, scene: Any, integrator: Any, groups: Sequence[tuple[Path, np.ndarray]] = ()) -> None:
        self.mi, self.scene, self.integrator = mi, scene, integrator
        self.surface = AtlasSurface(mi, scene, groups)
        self.lift = float(LIFT * scene.bbox().bounding_sphere().radius)
        self.passing = lets_through(mi, scene)
        inner = [shape.interior_medium() for shape in scene.shapes() if shape.is_medium_transition()]
        self.media = list({id(medium): medium for medium in inner if medium is not None}.values())

    def bake(self, size: int, spp: int, seed: int) -> np.ndarray:
        """E of the front and of the back, float32 [2, size, size, 3], row 0 at V = 0; denoised, gaps filled.

        The denoiser is shown where in space each texel lies and where it faces, so that charts that are neighbours in
        the atlas alone stay apart. The back is traced where it can be seen: of surfaces with a rim.
        """
        whole = np.zeros((2, size, size, 3), np.float32)
        if not self.surface.count:
            return whole
        texels, position, normal, thin = self.occupied(size)
        if not len(texels):
            return whole
        low, high = position.min(axis=0), position.max(axis=0)
        place = (position - low) / np.maximum(high - low, 1e-12)
        for number, side in enumerate((1, -1)):
            wanted = np.ones(len(texels), bool) if side > 0 else thin
            if not wanted.any():
                continue
            sums = self._traced(texels[wanted], size, spp, seed * 2 + number, side)
            light, rho = sums[:, :3], sums[:, 3:]
            found = rho.max(axis=1) > LEAST_RHO * spp
            if not found.any():
                continue
            chosen = texels[wanted][found]
            rows = [
                np.divide(light[found], rho[found], out=np.zeros_like(light[found]), where=rho[found] > 1e-6 * spp),
                place[wanted][found],
                normal[wanted][found] * side,
            ]
            valid = np.zeros(size * size, bool)
            valid[chosen] = True
            images = []
            for values in rows:
                image = np.zeros((size * size, 3), np.float32)
                image[chosen] = values
                images.append(filled(image.reshape(size, size, 3), valid.reshape(size, size)))
            whole[number] = denoise(images[0], images[1], images[2], threads=1)
        return whole

    def _traced(self, texels: np.ndarray, size: int, spp: int, seed: int, side: int) -> np.ndarray:
        """[T, 6]: B and rho, summed over ``spp`` samples of each texel."""
        sums = np.zeros((len(texels), 6))
        chunk = max(1, MAX_SAMPLES // spp)
        for number, start in enumerate(range(0, len(texels), chunk)):
            part = slice(start, start + chunk)
            sums[part] = self._part(texels[part], size, spp, seed * 4096 + number, side)
        return sums

    def occupied(self, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Texels that a chart touches, on a grid three times as fine: (numbers, positions, normals, have two sides)."""
        import drjit as dr

        mi, fine = self.mi, 3 * size
        rows, bands = max(1, MAX_SAMPLES // (9 * size)), []
        for start in range(0, size, rows):
            count = min(rows, size - start)
            index = dr.arange(mi.UInt32, 3 * count * fine) + dr.opaque(mi.UInt32, 3 * start * fine)
            uv = mi.Point2f(mi.Float(index % fine) + 0.5, mi.Float(index // fine) + 0.5) / fine
            hits = np.array(self.surface.points(uv)[2]).reshape(count, 3, size, 3)
            bands.append(hits.transpose(0, 2, 1, 3).reshape(-1, 9))
        found = np.concatenate(bands)
        texels = np.flatnonzero(found.any(axis=1))
        # The middle of the nine where it lies on a chart, else the first that does.
        pick = np.where(found[texels, 4], 4, found[texels].argmax(axis=1))
        column = (texels % size) * 3 + pick % 3
        row = (texels // size) * 3 + pick // 3
        place = mi.Point2f(mi.Float((column + 0.5).astype(np.float32)), mi.Float((row + 0.5).astype(np.float32))) / fine
        position, normal, _ = self.surface.points(place)
        return texels, np.array(position).T, np.array(normal).T, np.array(self.surface.thin(place))

    def _part(self, texels: np.ndarray, size: int, spp: int, seed: int, side: int) -> np.ndarray:
        """As :meth:`_traced`, of texels that fit in memory."""
        import drjit as dr

        mi = self.mi
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, seed), len(texels) * spp)  # as data: the kernel is the same for all seeds
        texel = dr.repeat(mi.UInt32(texels.astype(np.uint32)), spp)
        jitter = sampler.next_2d()
        uv = mi.Point2f(mi.Float(texel % size) + jitter.x, mi.Float(texel // size) + jitter.y) / size
        channels = [*(channel for colour in self._light(sampler, uv, side) for channel in colour)]
        dr.eval(channels)  # together: block_sum would run the whole kernel for each channel
        return np.stack([np.array(dr.block_sum(channel, spp)) for channel in channels], axis=1)

    def _light(self, sampler: Any, uv: Any, side: int) -> tuple[Any, Any]:
        """One sample of (B, rho) at each (U, V)."""
        import drjit as dr

        mi, scene = self.mi, self.scene
        place, normal, found = self.surface.points(uv, sampler.next_1d())
        up = normal * float(side)
        ray = mi.Ray3f(place + up * self.lift, -up)
        ray.maxt = mi.Float(3 * self.lift)
        si = scene.ray_intersect(ray, found)
        found &= si.is_valid() & (dr.norm(si.p - place) < 2 * self.lift)
        context, bsdf = diffuse_context(mi), si.bsdf()
        rho = reflectance(mi, bsdf, context, si, found)
        found &= dr.all(dr.isfinite(rho))

        toward, arriving = scene.sample_emitter_direction(si, sampler.next_2d(), not self.passing, found)
        lit = found & (toward.pdf > 0)
        wo = si.to_local(toward.d)
        value = bsdf.eval(context, si, wo, lit)
        if self.passing:
            arriving *= self._transmittance(si, toward, lit & (dr.max(value) > 0))
        b = dr.select(lit, value * arriving, 0)
        if self.integrator is not None:
            b += self._bounced(sampler, si, bsdf, context, found)
        fine = found & dr.all(dr.isfinite(b))
        return dr.select(fine, b, 0), dr.select(fine, rho, 0)

    def _bounced(self, sampler: Any, si: Any, bsdf: Any, context: Any, active: Any) -> Any:
        """One sample of what comes by way of other surfaces."""
        import drjit as dr

        mi, scene = self.mi, self.scene
        # Not bsdf.sample: Mitsuba's mask gives nothing when it is asked for the diffuse lobes alone.
        wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        across = (sampler.next_1d() < 0.5) & mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseTransmission)
        density = wo.z * dr.inv_pi * dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseTransmission), 0.5, 1)
        wo.z = dr.select((si.wi.z < 0) ^ across, -wo.z, wo.z)
        weight = bsdf.eval(context, si, wo, active) / density
        going = active & (density > 0) & (dr.max(weight) > 0)
        onwards = si.spawn_ray(si.to_world(wo))
        # What glows is counted by the emitter sample; the integrator would look through it instead of stopping there.
        behind = scene.ray_intersect_preliminary(onwards, going)
        going &= ~(behind.is_valid() & behind.shape.is_emitter())
        light = mi.Spectrum(0.0)
        for medium, starts in self._around(onwards, going):
            found, _, _ = self.integrator.sample(scene, sampler, mi.RayDifferential3f(onwards), medium, starts)
            light = dr.select(starts, found, light)
        return dr.select(going, weight * light, 0)

    def _around(self, ray: Any, active: Any) -> list[tuple[Any, Any]]:
        """Media (None: empty space) with the rays that start in them: those that would leave a medium at the first
        surface that they hit. What starts in a medium and hits something else in it counts as outside.
        """
        import drjit as dr

        if not self.media:
            return [(None, active)]
        mi = self.mi
        hit = self.scene.ray_intersect(ray, active)
        leaves = active & hit.is_valid() & hit.is_medium_transition() & (dr.dot(hit.n, ray.d) > 0)
        around = dr.select(leaves, hit.shape.interior_medium(), dr.zeros(mi.MediumPtr))
        members = [(medium, active & (around == mi.MediumPtr(medium))) for medium in self.media]
        return [(None, active & (around == dr.zeros(mi.MediumPtr))), *members]

    def _transmittance(self, si: Any, toward: Any, active: Any) -> Any:
        """Product of what the surfaces between ``si`` and the emitter's point let straight through."""
        import drjit as dr

        mi, scene = self.mi, self.scene
        ray = si.spawn_ray_to(toward.p)

        def step(ray: Any, total: Any, left: Any, active: Any) -> tuple[Any, ...]:
            hit = scene.ray_intersect(ray, active)
            met = active & hit.is_valid()
            total = dr.select(met, total * hit.bsdf().eval_null_transmission(hit, met), total)
            onwards = hit.spawn_ray_to(toward.p)
            ray = dr.select(met, onwards, ray)
            return ray, total, left - 1, met & (dr.max(total) > 0) & (left > 0)

        state = (ray, mi.Spectrum(1.0), mi.UInt32(MAX_LAYERS), mi.Mask(active))
        return dr.while_loop(state, lambda ray, total, left, active: active, step)[1]

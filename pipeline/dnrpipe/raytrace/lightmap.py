"""Baked light: the light that every atlas texel sends back, path-traced once for all views.

Notation
    x        a point of the surface; n its geometric normal; side +1 or -1: lit and seen from n's side or the other
    f_d      diffuse part of the BSDF, both of reflection and transmission
    rho      pi (f_d(n, n) + f_d(n, -n)): the diffuse reflectance, transmittance included
    B        ∫ f_d(n, w) L(x, w) |cos w| dw: what the surface sends back diffusely, view-independent
    E        B / rho, the light map: W sr^-1 m^-2, linear Rec.709
    S        the light that comes from surfaces, not from emitters, in the mean over what a rough glossy lobe sees, for
             cosine-weighted directions of view: W sr^-1 m^-2

At a view, B is E times the reflectance of that very point (see `base_renderer`): the map holds light alone, which is
smooth, and textures stay as sharp as they are. In the same way S is multiplied by what the lobe reflects at that view:
a lobe so wide sees about the same from everywhere. Direct light is sampled at the emitters; the plan's own integrator
follows the rest of the path, from the first bounce on, with all its effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .denoise import denoise, filled_map
from .lobes import (
    bsdfs_of,
    diffuse_context,
    ignores_context,
    is_among,
    is_rough,
    lets_through,
    media_of,
    reflectance,
    specular_context,
)
from .paths import transmittance
from .texels import ATTRIBUTE, LIFT, AtlasSurface

MAX_SAMPLES = 4_000_000
PROBES = 16
"""Rays that find out whether a texel is buried."""
MOST_BURIED = 0.5
"""Share of the sides that can be seen above which none counts as buried."""
LEAST_RHO = 1e-3
"""Texels that reflect less hold no light worth knowing."""
FIRST = 8
"""A texel's samples over those that it has before others go where they are needed (`_further`)."""
TOGETHER = 16
"""Side of the cells of texels whose noise is told together: one texel's few samples do not tell its own."""
FAINT = 0.05
"""Of the mean light: what is darker than that counts as if it was so bright, for a picture has blacks."""
UNSEEN = 1 / 64
"""Pixels of a texel that no view sees, over the mean."""
SPREAD = 1 / 8, 4.0
"""Least and most of a texel's samples over the mean."""


def light_texture(mi: Any, light: np.ndarray, *, gloss: bool) -> tuple[Any, Any, Any]:
    """E and S of the front and of the back, float32 [2, 2, size, size, 3] -> texture for `look_up_light`, and where in
    it V = 1 of the front and V = 0 of the back are, as data.

    gloss: with S, six channels; else three. Front and back lie one above the other, a row of each repeated between
    them, so that neither takes light of the other.
    """
    import drjit as dr

    front, back = (np.concatenate(light[: 1 + gloss, side], axis=-1) for side in range(2))
    rows = np.concatenate([front, front[-1:], back[:1], back])
    texture = mi.Texture2f(mi.TensorXf(rows), wrap_mode=dr.WrapMode.Clamp)
    top, start = len(front) / len(rows), (len(front) + 2) / len(rows)
    return texture, dr.opaque(mi.Float, top), dr.opaque(mi.Float, start)


def look_up_light(mi: Any, light: tuple[Any, Any, Any], uv: Any, back: Any, active: Any) -> list[Any]:
    """Channels of a `light_texture` at atlas coordinates. back: of the back, else of the front."""
    import drjit as dr

    texture, top, start = light
    return texture.eval(mi.Point2f(uv.x, uv.y * top + dr.select(back, start, 0)), active)


def _powers(wanted: np.ndarray) -> np.ndarray:
    """Each the power of two above or below, 0 below 1, by chance so that the mean stays; the same ones every time."""
    low = np.where(wanted < 1, 0, 1 << np.log2(np.maximum(wanted, 1)).astype(int))
    step = np.maximum(low, 1)
    return low + step * (np.random.default_rng(0).random(len(wanted)) < (wanted - low) / step)


class LightBaker:
    """Bakes E and S of one scene.

    Args:
        mi: the mitsuba module, a jit variant set.
        integrator: continues paths from their first bounce on; emitters that it meets first must be hidden. None:
            direct light alone.
        groups: see `texels.AtlasSurface`.
        gloss: S is wanted; otherwise it is 0.
        pixels: of views, by cells of the atlas [n, n] (`seen_texels.pixels_of_cells`): where there are many, texels get
            more samples. None: all texels count as much.

    ``lost`` counts the samples of the last bake that were not finite; each is left out of its texel's mean.
    """

    def __init__(
        self,
        mi: Any,
        scene: Any,
        integrator: Any,
        groups: Sequence[tuple[Path, np.ndarray]] = (),
        *,
        gloss: bool = True,
        pixels: np.ndarray | None = None,
    ) -> None:
        self.mi, self.scene, self.integrator, self.pixels = mi, scene, integrator, pixels
        self.surface = AtlasSurface(mi, scene, groups)
        self.lift = float(LIFT * scene.bbox().bounding_sphere().radius)
        self.lets_through = lets_through(mi, scene)
        bsdfs = bsdfs_of(scene)
        self.unsplit = [b for b in bsdfs if ignores_context(b)]
        self.glossy = gloss and any(mi.has_flag(b.flags(), mi.BSDFFlags.Glossy) for b in bsdfs)
        self.media = media_of(scene)
        self.lost = 0
        self._known: dict[int, Any] = {}

    def bake(self, size: int, spp: int, seed: int) -> np.ndarray:
        """E and S of the front and of the back, float32 [2, 2, size, size, 3], row 0 at V = 0; no noise, no gaps.

        spp: samples per texel, in the mean over all.
        The denoiser is shown where in space each texel lies and where it faces, so that charts that are neighbours in
        the atlas alone stay apart. Of closed meshes one side is traced: the other cannot be seen.
        """
        self.lost = 0
        light = self._map(self._light, size, spp, seed * 4, LEAST_RHO)
        return np.stack([light, self._map(self._gloss, size, spp, seed * 4 + 2) if self.glossy else 0 * light])

    def _map(self, sample: Any, size: int, spp: int, seed: int, least: float = 0) -> np.ndarray:
        """[2, size, size, 3], front and back: what ``sample`` says of each texel, mean of ``spp`` samples, denoised.

        least: mean denominator of a texel that says anything.
        """
        whole = np.zeros((2, size, size, 3), np.float32)
        texels, place, normal, sides, closed, buried = self._texels(size)
        for number, side in enumerate((1, -1)):
            wanted = sides[:, number] & ~buried[:, number]
            if not wanted.any():
                continue
            guides = place[wanted], normal[wanted] * side
            total, weight = self._means(sample, texels[wanted], size, spp, seed + number, side)
            found = weight.max(axis=1) > least
            whole[number] = self._smooth(total, weight, 1e-3 * least, texels[wanted], found, guides, size)
            whole[number].reshape(-1, 3)[texels[closed[:, number]]] = 0
        return whole

    def _texels(self, size: int) -> tuple[np.ndarray, ...]:
        """`occupied`, with positions in [0, 1] of the scene's extent; and whether front and back are buried in a closed
        opaque mesh, bool [T, 2]: nobody sees them, and they take the light of those beside them, which are looked up
        together with them."""
        if size not in self._known:
            if self.surface.count:
                texels, position, normal, sides, closed = self.occupied(size)
            else:
                shapes = (0, (0, 3), (0, 3), (0, 2), (0, 2))
                texels, position, normal, sides, closed = (np.zeros(shape, int) for shape in shapes)
            sides, closed = sides.astype(bool), closed.astype(bool)
            buried = np.zeros_like(sides)
            for number, side in enumerate((1, -1)):
                seen = sides[:, number]
                buried[seen, number] = self._buried(position[seen], normal[seen] * side)
            if buried.sum() > MOST_BURIED * sides.sum():  # what they are in is where the camera is
                buried[:] = closed[:] = False
            low, high = (position.min(axis=0), position.max(axis=0)) if len(texels) else (0, 1)
            self._known[size] = texels, (position - low) / np.maximum(high - low, 1e-12), normal, sides, closed, buried
        return self._known[size]

    def _buried(self, position: np.ndarray, up: np.ndarray) -> np.ndarray:
        """Whether most rays from points [T, 3] into the half-space of ``up`` meet the inside of a closed mesh that lets
        no light through, bool."""
        import drjit as dr

        mi, parts = self.mi, [np.zeros(0, bool)]
        for start in range(0, len(position), MAX_SAMPLES // PROBES):
            part = slice(start, start + MAX_SAMPLES // PROBES)
            count = len(position[part])
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(dr.opaque(mi.UInt32, start), count * PROBES)
            index = dr.arange(mi.UInt32, count * PROBES) // PROBES
            columns = (mi.Float(np.ascontiguousarray(values[part].T.ravel(), np.float32)) for values in (position, up))
            place, normal = (
                kind(*(dr.gather(mi.Float, values, index + axis * count) for axis in range(3)))
                for kind, values in zip((mi.Point3f, mi.Normal3f), columns, strict=True)
            )
            towards = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
            hit = self.scene.ray_intersect(mi.Ray3f(place + normal * self.lift, towards))
            found = hit.is_valid()
            found &= hit.shape.has_attribute(ATTRIBUTE, found)
            uv = hit.shape.eval_attribute_3(ATTRIBUTE, hit, found)
            front, back = self.surface.sides(mi.Point2f(uv.x, uv.y), closed=True)
            inside = found & dr.select(dr.dot(hit.n, towards) < 0, front, back)
            share = dr.block_sum(dr.select(inside, mi.Float(1), 0), PROBES) / PROBES
            parts.append(np.array(share) > 0.5)
        return np.concatenate(parts)

    def _means(
        self, sample: Any, texels: np.ndarray, size: int, spp: int, seed: int, side: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Numerator and denominator, [T, 3] each, means of each texel's samples; counts what was lost."""
        half = spp // (2 * FIRST)
        first = [half, half] if half else [spp]
        parts = [self._traced(sample, texels, size, n, 3 * seed + turn, side) for turn, n in enumerate(first)]
        sums, counts = np.sum(parts, axis=0), np.full(len(texels), sum(first))
        if half:
            one, other = (part[:, :3] / half for part in parts)
            further = self._further(texels, size, (one + other) / 2, one - other, spp - 2 * half)
            which = further > 0
            sums[which] += self._traced(sample, texels[which], size, further[which], 3 * seed + 2, side)
            counts += further
        self.lost += round(float(sums[:, 6].sum(dtype=np.float64)))
        means = (sums[:, :6] / counts[:, None]).astype(np.float32)
        return means[:, :3], means[:, 3:]

    def _further(self, texels: np.ndarray, size: int, light: np.ndarray, change: np.ndarray, spp: int) -> np.ndarray:
        """How many samples more each texel gets [T]: a power of two, which is spread best, or none. In all they are
        about as many as if each had ``spp``.

        light, change: mean of two estimates of what the texels send back, and their difference [T, 3].
        A texel of n samples whose variance is v adds pixels v / n to the error of the views' pictures; as they are
        displayed, about as the square root of light, pixels v / (n light). The sum is least where n goes as the square
        root of that without n (Neyman 1934). Noise counts by its own square root once more, for the map is denoised,
        which takes most of it where it is large (measured: docs/experiments.md). Cells of many texels say it, so that a
        texel's own luck hardly decides on its samples, which would bias its mean.
        """
        rows, columns = texels // size, texels % size
        cell = rows // TOGETHER * size + columns // TOGETHER
        number = np.maximum(np.bincount(cell), 1)
        noise, level = (np.bincount(cell, values.mean(axis=1)) / number for values in (change**2, light))
        worth = np.sqrt(noise / np.maximum(level, max(FAINT * float(light.mean()), 1e-12)))[cell]
        if self.pixels is not None:
            side = len(self.pixels)
            seen = self.pixels[rows * side // size, columns * side // size]
            worth = worth * np.maximum(seen, UNSEEN * max(float(seen.mean()), 1e-12))
        share = np.sqrt(worth)
        share = share / share.mean() if share.any() else np.ones(len(share))
        share = share.clip(*SPREAD)
        return _powers(share * (spp / share.mean()))

    @staticmethod
    def _smooth(
        total: np.ndarray,
        weight: np.ndarray,
        least: float,
        texels: np.ndarray,
        found: np.ndarray,
        guides: tuple[np.ndarray, np.ndarray],
        size: int,
    ) -> np.ndarray:
        """[size, size, 3]: total / weight, [T, 3] each, of the texels ``found``, denoised, the rest filled."""
        if not found.any():
            return np.zeros((size, size, 3), np.float32)
        mean = np.divide(total[found], weight[found], out=np.zeros_like(total[found]), where=weight[found] > least)
        images = [filled_map(values, texels[found], size) for values in (mean, *(guide[found] for guide in guides))]
        # Measured: within 0.03 dB of the larger network for clean guides, in less than half its time.
        return denoise(images[0], images[1], images[2], clean=False, quality="balanced")

    def _traced(
        self, sample: Any, texels: np.ndarray, size: int, spp: int | np.ndarray, seed: int, side: int
    ) -> np.ndarray:
        """[T, channels]: what ``sample`` (`_light` or `_gloss`) gives, summed over ``spp`` samples, of all or of each.

        Different numbers of them are traced together: to describe a launch to Dr.Jit takes a third of a second.
        """
        counts = np.broadcast_to(spp, len(texels))
        full = np.flatnonzero(np.diff(np.cumsum(counts) // MAX_SAMPLES)) + 1
        parts = zip(np.split(texels, full), np.split(counts, full), strict=True)
        sums = [self._part(sample, *part, size, seed * 4096 + number, side) for number, part in enumerate(parts)]
        return np.concatenate(sums)

    def occupied(self, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Texels that a chart touches, on a grid three times as fine: (numbers, positions, normals, whether front and
        back can be seen, whether they are the inside of a closed opaque mesh, bool [T, 2] each)."""
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
        sides, closed = (
            np.stack([np.array(side) for side in self.surface.sides(place, closed=inside)], axis=1)
            for inside in (False, True)
        )
        return texels, np.array(position).T, np.array(normal).T, sides, closed

    def _part(self, sample: Any, texels: np.ndarray, counts: np.ndarray, size: int, seed: int, side: int) -> np.ndarray:
        """As `_traced`, of texels that fit in memory."""
        import drjit as dr

        mi = self.mi
        sampler = mi.load_dict({"type": "independent"})
        # As data: the kernel is the same for all seeds and sides.
        number, width = (dr.opaque(mi.UInt32, value) for value in (seed, size))
        firsts, total = np.cumsum(counts) - counts, int(counts.sum())
        sampler.seed(number, total)
        row = mi.UInt32(np.repeat(np.arange(len(texels), dtype=np.uint32), counts))
        columns = (mi.UInt32(values.astype(np.uint32)) for values in (texels, firsts, counts))
        texel, first, count = (dr.gather(mi.UInt32, values, row) for values in columns)
        numbers = self._numbers(sampler, texel, dr.arange(mi.UInt32, total) - first, count, number)
        jitter = numbers.next_2d()
        uv = mi.Point2f(mi.Float(texel % width) + jitter.x, mi.Float(texel // width) + jitter.y) / mi.Float(width)
        channels = sample(numbers, uv, side)
        dr.eval(channels)  # together: each alone would run the whole kernel
        return np.stack([np.add.reduceat(np.array(channel), firsts) for channel in channels], axis=1)

    def _numbers(self, sampler: Any, texel: Any, index: Any, count: Any, seed: Any) -> Any:
        """What samples draw their random numbers from. index: of the samples within their texels, of ``count``."""
        del texel, index, count, seed
        return sampler

    def _surface(self, sampler: Any, uv: Any, side: int) -> tuple[Any, Any]:
        """(surface interaction at each (U, V), seen straight on, whether there is a surface)."""
        import drjit as dr

        mi = self.mi
        place, normal, found = self.surface.points(uv, sampler.next_1d())
        up = normal * dr.opaque(mi.Float, float(side))  # as data: the kernel is the same for both sides
        ray = mi.Ray3f(place + up * self.lift, -up)
        ray.maxt = mi.Float(3 * self.lift)
        si = self.scene.ray_intersect(ray, found)
        return si, found & si.is_valid() & (dr.norm(si.p - place) < 2 * self.lift)

    def _gloss(self, sampler: Any, uv: Any, side: int) -> list[Any]:
        """One sample of S's numerator and of its denominator at each (U, V), and 1 where it is not finite."""
        import drjit as dr

        mi = self.mi
        si, found = self._surface(sampler, uv, side)
        bsdf, context = si.bsdf(), specular_context(mi)
        found &= ~is_among(mi, bsdf, self.unsplit) & is_rough(mi, bsdf, context, si, found)
        seen = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        seen.z = dr.select(si.wi.z < 0, -seen.z, seen.z)
        si.wi = seen
        bounce, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), found)
        found &= bounce.pdf > 0
        wanted = mi.Mask(found)
        found &= dr.all(dr.isfinite(weight))
        onwards = si.spawn_ray(si.to_world(bounce.wo))
        light = mi.Spectrum(0.0)
        if self.integrator is not None:
            light = self._arriving(sampler, onwards, found)
        found &= dr.all(dr.isfinite(light))
        return [*dr.select(found, weight * light, 0), *dr.select(found, weight, 0), self._one(wanted & ~found)]

    def _light(self, sampler: Any, uv: Any, side: int, direct: bool = True, indirect: bool = True) -> list[Any]:
        """One sample of B, or of a part of it, and of rho at each (U, V), and 1 where it is not finite."""
        import drjit as dr

        mi = self.mi
        si, found = self._surface(sampler, uv, side)
        context, bsdf = diffuse_context(mi), si.bsdf()
        rho = reflectance(mi, bsdf, context, si, found)
        wanted = mi.Mask(found)
        found &= dr.all(dr.isfinite(rho))
        b = self._direct(sampler, si, bsdf, context, found) if direct else mi.Spectrum(0.0)
        if indirect and self.integrator is not None:
            b += self._bounced(sampler, si, bsdf, context, found)
        fine = found & dr.all(dr.isfinite(b))
        return [*dr.select(fine, b, 0), *dr.select(fine, rho, 0), self._one(wanted & ~fine)]

    def _direct(self, sampler: Any, si: Any, bsdf: Any, context: Any, active: Any) -> Any:
        """One sample of what comes from emitters."""
        import drjit as dr

        mi, scene = self.mi, self.scene
        toward, arriving = scene.sample_emitter_direction(si, sampler.next_2d(), not self.lets_through, active)
        lit = active & (toward.pdf > 0)
        value = bsdf.eval(context, si, si.to_local(toward.d), lit)
        if self.lets_through:
            arriving *= transmittance(mi, scene, si, toward.p, lit & (dr.max(value) > 0))
        return dr.select(lit, value * arriving, 0)

    def _one(self, where: Any) -> Any:
        import drjit as dr

        return dr.select(where, self.mi.Float(1), 0)

    def _bounced(self, sampler: Any, si: Any, bsdf: Any, context: Any, active: Any) -> Any:
        """One sample of what comes by way of other surfaces."""
        import drjit as dr

        mi = self.mi
        # Not bsdf.sample: Mitsuba's mask gives nothing when it is asked for the diffuse lobes alone.
        wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        transmits = mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseTransmission)
        across = (sampler.next_1d() < 0.5) & transmits
        density = wo.z * dr.inv_pi * dr.select(transmits, 0.5, 1)
        wo.z = dr.select((si.wi.z < 0) ^ across, -wo.z, wo.z)
        weight = bsdf.eval(context, si, wo, active) / density
        going = active & (density > 0) & (dr.max(weight) > 0)
        onwards = si.spawn_ray(si.to_world(wo))
        return dr.select(going, weight * self._arriving(sampler, onwards, going), 0)

    def _arriving(self, sampler: Any, ray: Any, active: Any) -> Any:
        """One sample of the light that comes along the ray from surfaces."""
        import drjit as dr

        mi, light = self.mi, self.mi.Spectrum(0.0)
        if not getattr(self.integrator, "ends_at_emitters", False):
            # What glows is counted where emitters are; others would look through it instead of stopping there.
            behind = self.scene.ray_intersect_preliminary(ray, active)
            active = active & ~(behind.is_valid() & behind.shape.is_emitter())  # &= would change the caller's mask
        for medium, starts in self._around(ray, active):
            found, _, _ = self.integrator.sample(self.scene, sampler, mi.RayDifferential3f(ray), medium, starts)
            light = dr.select(starts, found, light)
        return light

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

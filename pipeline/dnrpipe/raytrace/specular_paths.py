"""Paths of base images: camera rays that follow mirrors, glass, glossy lobes and cut-outs, without noise.

For the notation see `base_renderer`. What a scene has none of (media, glass, rough metal, ...) leaves no code in its
kernel. Imports Mitsuba at the top: import this module where a variant is set.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .lightmap import look_up_light
from .lobes import (
    bsdfs_of,
    context_of,
    diffuse_context,
    ignores_context,
    is_among,
    is_rough,
    lets_through,
    mean_of,
    mirrors_and_refracts,
    reflectance,
    specular_context,
)
from .paths import is_sharp, power_heuristic
from .sequence import fraction, steps
from .texels import ATTRIBUTE
from .visibility import LAMP_PREFIX, UNSEEN_PREFIX, is_one_of

MAX_VERTICES = 16
"""Liquid in a glass is six surfaces from side to side: eight vertices were 1.7 dB less there, 0.1 less on jewels."""
NUMBERS = 5
"""Random numbers per vertex: two for the direction, one for the lobe, two for the emitter."""
MIRRORED = 0.25
"""Share of the samples that the first glass reflects. By Fresnel's share, a lamp in the water would be a few specks."""
LEAST_THROUGHPUT, LEAST_BY_CHANCE = 1e-2, 1e-3
"""Fainter paths end, such as those that two polished floors mirror one after the other: with 1e-3 the kernel took
1.4 times as long for 0.03 dB behind the corrector (`drums`: 0.2 dB). The second is of paths from surfaces, which chance
ends anyway."""
FAINT = 0.1
"""Throughput behind the first surface below which a few samples do, which weigh the more. Most coats reflect less."""
LEAST_SHARE = 1e-3
"""Of a path's light: what a lobe shows of an emitter counts from it on. Most narrow lobes show less, for which no ray
is cast to see what is in between: a tenth of the kernel's time."""
LEAST_RHO = 0.05
"""Diffuse reflectance from which a surface ends a chain, and a path behind a wide lobe."""
COAT = 0.04
"""Reflectance of a dielectric's surface seen straight on (index 1.5)."""
NARROW = 1000.0
"""Density of a direction from which a lobe shows a sharp picture of what it reflects: GGX of roughness 0.1."""
FAR = 1e6
"""Length of a chain's segment that meets no surface."""


class SpecularPaths:
    """Follows the specular paths of one scene.

    Args:
        scene: a scene of the current variant (jit variants only).
        camera: the rays are a camera's: they pass lamps and unseen shapes, and what glows is seen. False: a surface's,
            where emitters were sampled: rays end at them, before the first mirror, glass or glossy lobe.
        gloss: paths end at rough lobes, where S says what these see. False: they are followed like the others.
        caustics: False: rays end at sharp lobes (`paths.is_sharp`).
    """

    def __init__(self, scene: Any, *, gloss: bool, camera: bool = True, caustics: bool = True) -> None:
        self.camera, self.caustics = camera, caustics
        self.steps = mi.Float(steps(NUMBERS * (MAX_VERTICES + 1)))
        unseen = (LAMP_PREFIX, UNSEEN_PREFIX)
        self.hidden = [s for s in scene.shapes() if camera and s.id().startswith(unseen)]
        self.has_emitters = bool(scene.emitters())
        self.has_media = any(shape.is_medium_transition() for shape in scene.shapes())
        self.lets_through = lets_through(mi, scene)
        bsdfs = bsdfs_of(scene)
        flags = [bsdf.flags() for bsdf in bsdfs]
        self.unsplit = [bsdf for bsdf in bsdfs if ignores_context(bsdf)]
        self.translucent = bool(self.unsplit) or any(mi.has_flag(f, mi.BSDFFlags.DiffuseTransmission) for f in flags)
        self.ends_at_rough = gloss and any(mi.has_flag(f, mi.BSDFFlags.GlossyReflection) for f in flags)
        self.has_glass = camera and any(mirrors_and_refracts(mi, f) for f in flags)

        kinds = mi.BSDFFlags
        self.diffuse = diffuse_context(mi)
        self.not_diffuse = context_of(mi, int(kinds.All) & ~int(kinds.Diffuse))
        self.specular = specular_context(mi)
        self.glossy = context_of(mi, kinds.Glossy)
        self.null = context_of(mi, kinds.Null)
        self.mirrored = context_of(mi, kinds.DeltaReflection, kinds.GlossyReflection)
        self.refracted = context_of(mi, kinds.DeltaTransmission, kinds.GlossyTransmission)

    @dr.syntax
    def trace(
        self,
        scene: Any,
        light: Any,
        steps: Any,
        ray: Any,
        forward: Any,
        number: Any,
        order: Any,
        faint: Any = None,
        sampler: Any = None,
    ) -> list[Any]:
        """One sample along each ray -> the values that `base_renderer` names by LOST, MEANS and CENTRES, in that order.

        Args:
            light: E and, where paths end at rough lobes, S (`lightmap.light_texture`).
            steps: of the random numbers, ``self.steps``.
            forward: where the camera looks, in world space.
            number: the samples' places in the sequences; negative: there is no ray.
            order: their places among those of a tile, in [0, 1): which of them the first glass reflects.
            faint: what paths weigh that the first surface reflects or lets through faintly; 0: they end. None: 1.
            sampler: numbers come from it instead of the sequences, and faint chains end by chance (Russian roulette).
        """
        origin = mi.Point3f(ray.o)
        every = number >= 0
        least = LEAST_THROUGHPUT if self.camera else LEAST_BY_CHANCE

        # ------------------------------ The path ------------------------------
        active = mi.Bool(every)
        ray = mi.Ray3f(ray)
        throughput = mi.Spectrum(1.0)
        medium = dr.zeros(mi.MediumPtr, dr.width(number))
        vertex = mi.UInt32(0)
        straight = mi.Bool(every)  # nothing has turned the ray yet
        unforked = mi.Bool(every)  # no glass yet
        prev_rough = mi.Bool(False)  # S said what the lobe before sees of surfaces: only emitters count

        # ------------------- Multiple importance sampling ---------------------
        prev_si = dr.zeros(mi.SurfaceInteraction3f)
        prev_pdf = mi.Float(1.0)
        prev_sampled = mi.Bool(False)  # emitters were sampled from prev_si
        emitters_sampled = mi.Bool(False)  # they were at any vertex

        # ------------------------------ The sample ----------------------------
        radiance, diffuse, albedo = mi.Spectrum(0.0), mi.Spectrum(0.0), mi.Spectrum(0.0)
        opacity, lost = mi.Float(0.0), mi.Bool(False)
        shown, facing = mi.Spectrum(0.0), mi.Vector3f(0.0)
        guided = mi.Bool(every)  # nothing so far but mirrors, smooth glass and holes
        normal, uv, depth, covered = mi.Vector3f(0.0), mi.Point3f(0.0), mi.Float(0.0), mi.Bool(False)
        chain_uv, chain_weight, chain_ended = mi.Point2f(0.0), mi.Float(0.0), mi.Bool(False)
        chain_length, chain_place = mi.Float(0.0), mi.Point3f(0.0)
        mirrored = mi.Bool(every)  # no lobe so far has blurred what is seen

        while dr.hint(active, label="Specular paths"):
            si = scene.ray_intersect(ray, mi.RayFlags.All, (vertex == 0) & self.camera, active)
            bsdf = si.bsdf()
            if dr.hint(sampler is None, mode="scalar"):
                u = self._random_numbers(steps, number, vertex)
            else:
                u = [*sampler.next_2d(), sampler.next_1d(), *sampler.next_2d()]
            passed = active & straight & self._is_hidden(si)
            going = active & ~passed
            if dr.hint(not self.camera, mode="scalar"):
                going &= ~(straight & si.is_valid() & si.shape.is_emitter())
            throughput *= self._transmittance(medium, ray, si, going)

            # ------------------------ Light that is hit -----------------------
            shows = going & (~straight | (si.is_valid() & self.camera))
            emission, mis = self._emission(scene, si, prev_si, prev_pdf, prev_sampled, shows)
            here = dr.select(shows, throughput * mis * emission, 0)

            # ---------------------- The surface by itself ---------------------
            # What a wide lobe shows of a coat is about what it would show of as much diffuse reflectance: measured,
            # the same picture within 0.1 dB, for 4 to 11 % less time.
            met = going & ~prev_rough & si.is_valid()
            rho, opaque, coat, colour = dr.dispatch(bsdf, self._looks, si, met)
            ended = mi.Bool(False)
            if dr.hint(self.camera, mode="scalar"):
                ended = met & ~mirrored & (coat >= 0) & (opaque == 1) & (mean_of(rho) > LEAST_RHO)
            rho = dr.select(ended, rho + coat, rho)
            further = met & ~ended

            # ----------------------- Towards an emitter -----------------------
            # Once a path: measured, further vertices cost more than they bring.
            splits = further & ~is_among(mi, bsdf, self.unsplit)
            rough = self._is_rough(bsdf, si, splits)
            glossy = splits & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy) & (~emitters_sampled | rough)
            source, emitted = self._towards_emitter(scene, si, u, glossy)
            value, bsdf_pdf = dr.dispatch(bsdf, self._lit, si, si.to_local(source.d), glossy)

            # ---------------------- What the surface does ---------------------
            found = dr.dispatch(bsdf, self._scattered, si, u, order, unforked, further)
            (bsdf_sample, bsdf_weight), onwards, forked = found

            # --------------------------- Baked light --------------------------
            baked, around, place = self._baked(light, si, met)
            here += dr.select(met, throughput * rho * baked, 0)
            radiance += here

            # ------------------- What the camera sees first -------------------
            first = straight & met
            diffuse += dr.select(straight, here, 0)
            albedo += dr.select(first, throughput * rho, 0)
            opacity += dr.select(first, opaque, 0)
            towards = mi.Vector3f(dr.select(si.wi.z < 0, -si.sh_frame.n, si.sh_frame.n))
            normal = dr.select(first, towards, normal)
            uv = dr.select(first, place, uv)
            depth = dr.select(first, dr.dot(si.p - origin, forward), depth)

            # -------------- What is neither mirror, glass nor hole ------------
            scatters = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)  # it has other lobes than those
            guides = guided & met & scatters
            shown += dr.select(guides, throughput * colour, 0)
            shown += dr.select(guided & going & ~straight & ~si.is_valid(), throughput, 0)
            facing = dr.select(guides, towards, facing)

            # ---------------------- Where the chain ends ----------------------
            behind = going & ~straight & ~chain_ended & mirrored
            chain_length += dr.select(behind, dr.minimum(si.t, FAR), 0)
            chain_place = dr.select(behind, ray(dr.minimum(si.t, FAR)), chain_place)
            ends = met & ~straight & ~chain_ended & (mean_of(rho) > LEAST_RHO)
            chain_uv = dr.select(ends, mi.Point2f(place.x, place.y), chain_uv)
            chain_weight = dr.select(ends, mean_of(throughput), chain_weight)
            chain_ended |= ends

            # ------------------ Emitters through glossy lobes -----------------
            mis = dr.select(source.delta, 1, power_heuristic(source.pdf, bsdf_pdf))
            direct = dr.select(glossy & (source.pdf > 0), throughput * value * emitted * mis, 0)
            fine = dr.all(dr.isfinite(direct))
            lost |= ~fine
            counts = fine & (dr.max(direct) > LEAST_SHARE * dr.max(radiance))
            radiance += dr.select(counts & ~self._is_blocked(scene, si, source, counts), direct, 0)

            # ---------------------- The mirror-like rest ----------------------
            null = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Null)
            delta = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
            throughput = dr.select(onwards, throughput * bsdf_weight, throughput)
            fine = dr.all(dr.isfinite(throughput))
            throughput = dr.select(fine, throughput, 0)
            lost |= ~fine & (bsdf_sample.pdf > 0)
            radiance += dr.select(rough, throughput * around, 0)

            # ------------------------- The next vertex ------------------------
            if dr.hint(faint is not None, mode="scalar"):
                is_faint = straight & onwards & ~null & (dr.max(throughput) < FAINT)
                throughput *= dr.select(is_faint, faint, 1)
            alive = onwards & (bsdf_sample.pdf > 0) & (dr.max(throughput) > least)
            if dr.hint(not self.caustics, mode="scalar"):
                alive &= null | ~is_sharp(mi, bsdf_sample)
            if dr.hint(sampler is not None, mode="scalar"):
                kept = dr.minimum(dr.max(throughput), 1)
                alive &= sampler.next_1d() < kept
                throughput /= dr.maximum(kept, least)
            covered |= met & ~(null & alive)
            next_ray = si.spawn_ray(dr.select(passed, ray.d, si.to_world(bsdf_sample.wo)))
            medium = self._next_medium(medium, si, bsdf_sample, next_ray, onwards)
            ray = dr.select(passed | onwards, next_ray, ray)
            prev_si = dr.select(onwards & ~null, si, prev_si)
            prev_pdf = dr.select(null, prev_pdf, bsdf_sample.pdf)
            prev_sampled = dr.select(null, prev_sampled, glossy & ~delta)
            emitters_sampled |= glossy & ~null
            prev_rough = rough
            straight &= passed | (null & onwards)
            guided &= passed | (onwards & (null | ~scatters))
            unforked &= ~forked
            mirrored &= ~onwards | null | delta | (bsdf_sample.pdf > NARROW)
            active = passed | (alive & (vertex < MAX_VERTICES))
            vertex += 1

        lost, chain_ended, covered = (dr.select(where, mi.Float(1), 0) for where in (lost, chain_ended, covered))
        means = [*radiance, opacity, *diffuse, *albedo, *dr.clip(shown, 0, 1), *facing]
        return [
            lost,
            *means,
            *chain_uv,
            chain_ended,
            chain_weight,
            chain_length,
            *chain_place,
            *normal,
            *uv,
            depth,
            covered,
        ]

    def _random_numbers(self, steps: Any, number: Any, vertex: Any) -> list[Any]:
        rows = [dr.gather(mi.Float, steps, vertex * NUMBERS + dimension) for dimension in range(NUMBERS)]
        return [fraction(0.5 + number * step) for step in rows]

    def _is_hidden(self, si: Any) -> Any:
        """Whether the camera looks through what is hit: lamps and unseen shapes."""
        return is_one_of(mi, si, self.hidden) if self.hidden else mi.Bool(False)

    def _transmittance(self, medium: Any, ray: Any, si: Any, active: Any) -> Any:
        """What ``medium`` lets through of the light along the ray's segment; what it scatters counts as passed."""
        if not self.has_media:
            return mi.Spectrum(1.0)
        inside = active & si.is_valid() & (medium != dr.zeros(mi.MediumPtr))
        middle = dr.zeros(mi.MediumInteraction3f)
        middle.p = ray(0.5 * si.t)
        scattered, _, extinction = medium.get_scattering_coefficients(middle, inside)
        return dr.select(inside, dr.exp((scattered - extinction) * si.t), 1)

    def _next_medium(self, medium: Any, si: Any, bsdf_sample: Any, next_ray: Any, active: Any) -> Any:
        """The medium behind the surface where the path crosses it."""
        if not self.has_media:
            return medium
        crossed = active & si.is_medium_transition() & (si.wi.z * bsdf_sample.wo.z < 0)
        return dr.select(crossed, si.target_medium(next_ray.d), medium)

    def _emission(self, scene: Any, si: Any, prev_si: Any, prev_pdf: Any, sampled: Any, active: Any) -> tuple[Any, Any]:
        """(light of the emitter that is hit, its weight). sampled: emitters were sampled at the vertex before, too."""
        if not self.has_emitters:
            return mi.Spectrum(0.0), mi.Float(1.0)
        source = mi.DirectionSample3f(scene, si, prev_si)
        emitter_pdf = scene.pdf_emitter_direction(prev_si, source, active & sampled)
        mis = dr.select(sampled, power_heuristic(prev_pdf, emitter_pdf), 1)
        return source.emitter.eval(si, active), mis

    def _baked(self, light: Any, si: Any, active: Any) -> tuple[Any, Any, Any]:
        """(E, S, atlas coordinates and the object's number) at the surface point, on the side that is seen."""
        place = dr.dispatch(si.shape, _atlas_place, si, active)
        back = dr.dot(si.n, si.to_world(si.wi)) < 0
        found = look_up_light(mi, light, mi.Point2f(place.x, place.y), back, active)
        around = mi.Spectrum(*found[3:]) if self.ends_at_rough else mi.Spectrum(0.0)
        return mi.Spectrum(*found[:3]), around, place

    def _is_rough(self, bsdf: Any, si: Any, active: Any) -> Any:
        """Whether the lobe is so wide that S says what it sees."""
        return is_rough(mi, bsdf, self.specular, si, active) if self.ends_at_rough else mi.Bool(False)

    def _towards_emitter(self, scene: Any, si: Any, u: list[Any], active: Any) -> tuple[Any, Any]:
        """(a place on an emitter, the light that comes from there over its density, whatever is in between)."""
        if not self.has_emitters:
            return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0.0)
        return scene.sample_emitter_direction(si, mi.Point2f(u[3], u[4]), False, active)

    def _is_blocked(self, scene: Any, si: Any, source: Any, active: Any) -> Any:
        """Whether something is between the surface and the place on an emitter."""
        return scene.ray_test(si.spawn_ray_to(source.p), active) if self.has_emitters else mi.Bool(False)

    def _looks(self, bsdf: Any, si: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        """(rho, the share of light that does not pass straight on, what a coat adds to rho for a wide lobe that sees
        the surface; negative: it lets light through, and a path goes on; its colour for SHOWN)."""
        flags, kinds = bsdf.flags(), mi.BSDFFlags
        rho = reflectance(mi, bsdf, self.diffuse, si, active, self.translucent)
        passes = mi.has_flag(flags, kinds.Null)
        opaque = 1 - mean_of(bsdf.eval_null_transmission(si, active)) if passes else mi.Float(1)
        is_diffuse = mi.has_flag(flags, kinds.Diffuse)
        colour = dr.clip(bsdf.eval_diffuse_reflectance(si, active), 0, 1) if is_diffuse else mi.Spectrum(1.0)
        if mi.has_flag(flags, kinds.DeltaTransmission) or mi.has_flag(flags, kinds.GlossyTransmission):
            return rho, opaque, mi.Float(-1), colour
        coated = mi.has_flag(flags, kinds.GlossyReflection) or mi.has_flag(flags, kinds.DeltaReflection)
        grazing = 1 - dr.abs(si.wi.z)
        schlick = COAT + (1 - COAT) * dr.square(dr.square(grazing)) * grazing
        return rho, opaque, schlick if coated else mi.Float(0), colour

    def _lit(self, bsdf: Any, si: Any, towards: Any, active: Any) -> tuple[Any, Any]:
        """(value, density) of the glossy lobes for the direction ``towards`` an emitter, local."""
        if not self.has_emitters or not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy):
            return mi.Spectrum(0.0), mi.Float(0)
        return bsdf.eval_pdf(self.glossy, si, towards, active)

    def _scattered(self, bsdf: Any, si: Any, u: list[Any], place: Any, unforked: Any, active: Any) -> tuple[Any, ...]:
        """Where paths go on at one BSDF.

        Args:
            place: the samples' places in the sequence, in [0, 1).
            unforked: paths that have met no glass yet.

        Returns:
            (where paths go on, its weight), which go on, which were split by glass.
        """
        flags, number, direction = bsdf.flags(), u[2], mi.Point2f(u[0], u[1])
        on, weight, onwards, forked = dr.zeros(mi.BSDFSample3f), mi.Spectrum(0.0), mi.Bool(False), mi.Bool(False)
        if not any(bsdf is other for other in self.unsplit):
            on, weight = bsdf.sample(self.not_diffuse, si, number, direction, active)
            onwards = mi.Bool(active)
            if self.has_glass and mirrors_and_refracts(mi, flags):
                forked = active & unforked
                mirrored, mirrored_weight = bsdf.sample(self.mirrored, si, number, direction, forked)
                refracted, refracted_weight = bsdf.sample(self.refracted, si, number, direction, forked)
                mirrors = place >= 1 - MIRRORED
                side = dr.select(mirrors, mirrored, refracted)
                split = dr.select(mirrors, mirrored_weight / MIRRORED, refracted_weight / (1 - MIRRORED))
                on, weight = dr.select(forked, side, on), dr.select(forked, split, weight)
        elif mi.has_flag(flags, mi.BSDFFlags.Null):
            on, share = bsdf.sample(self.null, si, number, direction, active)
            onwards, weight = active & (u[3] < dr.max(share)), mi.Spectrum(1.0)
        return (on, weight), onwards, forked


def _atlas_place(shape: Any, si: Any, active: Any) -> Any:
    """Atlas coordinates of a shape's point, and the object's number; 0 where the shape is not in the atlas."""
    return mi.Point3f(shape.eval_attribute_3(ATTRIBUTE, si, active & shape.has_attribute(ATTRIBUTE, active)))

"""Integrator ``dnr_path``: path tracing whose depth is data, not code, that sees lamps through holes and can leave
caustics out.

Mitsuba's ``path`` compiles a kernel for every depth; here all depths share one, which the depth pilot lives on. Where
surfaces let light straight through, Mitsuba 3.9.1's drops the light of lamps with the probability of passing (a surface
of opacity 0.25 shows a quarter of what it should), its shadow rays stop there, and it counts them as bounces. Here
shadow rays go on, weighted by what they cross; passing is no bounce, as in Cycles; and what starts at the last
scattering, sampled by BSDF or towards a lamp, is weighted as if nothing were in between.

A caustic reaches the eye by way of a diffuse surface, from a mirror-like one: eye ... diffuse, sharp ... light.
Without caustics, paths end where a mirror-like lobe is sampled after a diffuse one; it is what Cycles does, but for
soft glossy lobes, which stay. What the eye sees in mirrors and through glass itself stays too.
"""

from __future__ import annotations

from typing import Any

from .lobes import lets_through
from .visibility import first_visible_of

SHARP_DENSITY = 5.0
"""A glossy sample of at least this density, 1/sr, counts as mirror-like: the peak of GGX at roughness 0.35."""
MAX_KEPT = 0.95  # roulette: the largest probability of going on
MAX_LAYERS = 64
"""Surfaces that a ray passes straight through before it ends."""


def power_heuristic(a: Any, b: Any) -> Any:
    """a² / (a² + b²), 0 where both are 0 (Veach 1997, section 9.2.2)."""
    import drjit as dr

    squares = dr.square(a)
    total = squares + dr.square(b)
    return dr.select(total > 0, squares / total, 0)


def is_sharp(mi: Any, bounce: Any) -> Any:
    """Whether a BSDF sample is of a mirror-like lobe."""
    glossy = mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Glossy) & (bounce.pdf > SHARP_DENSITY)
    return mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Delta) | glossy


def transmittance(mi: Any, scene: Any, si: Any, point: Any, active: Any) -> Any:
    """Product, per colour, of what the surfaces between ``si`` and ``point`` let straight through."""
    import drjit as dr

    ray = si.spawn_ray_to(point)

    def step(ray: Any, total: Any, left: Any, active: Any) -> tuple[Any, ...]:
        hit = scene.ray_intersect(ray, active)
        met = active & hit.is_valid()
        total = dr.select(met, total * hit.bsdf().eval_null_transmission(hit, met), total)
        ray = dr.select(met, hit.spawn_ray_to(point), ray)
        return ray, total, left - 1, met & (dr.max(total) > 0) & (left > 0)

    state = (ray, mi.Spectrum(1.0), mi.UInt32(MAX_LAYERS), mi.Mask(active))
    return dr.while_loop(state, lambda ray, total, left, active: active, step)[1]


def register(mi: Any) -> None:
    """``dnr_path`` for the current variant (jit variants only)."""
    import drjit as dr

    class Path(mi.SamplingIntegrator):
        """Path tracing with next event estimation, both weighted by the power heuristic.

        ``max_depth``, ``rr_depth``, ``hide_emitters``: as of Mitsuba's ``path``; with ``shows_glow``, surfaces of the
        scene that glow are not hidden, lamps and the environment alone are. ``caustics``: true by default;
        ``after_diffuse``: the rays come from a diffuse surface instead of the eye, which matters for caustics.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.max_depth = dr.opaque(mi.UInt32, int(props.get("max_depth", 8)))
            self.caustics = bool(props.get("caustics", True))
            self.after_diffuse = bool(props.get("after_diffuse", False))
            self.shows_glow = bool(props.get("shows_glow", False))
            self.rr_depth = int(props.get("rr_depth", 5))

        def _past_lamps(self, scene: Any, ray: Any, si: Any, active: Any) -> Any:
            """``si``, or what lies behind it where it is hidden."""
            if self.shows_glow:
                return dr.select(active, first_visible_of(mi, scene)(scene, ray, active)[1], si)
            lamp = active & si.is_valid() & si.shape.is_emitter()
            onwards = si.spawn_ray(ray.d)
            after = self.skip_area_emitters(scene, onwards, True, lamp)
            return dr.select(lamp, after.compute_surface_interaction(onwards, mi.RayFlags.All, lamp), si)

        @dr.syntax
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            import drjit as dr  # dr.syntax compiles this function anew, without the names around it
            import mitsuba as mi

            context, holes = mi.BSDFContext(), lets_through(mi, scene)
            ray = mi.Ray3f(ray)
            active = mi.Bool(active)
            radiance, throughput = mi.Spectrum(0), mi.Spectrum(1)
            eta, depth, layers = mi.Float(1), mi.UInt32(0), mi.UInt32(0)
            valid, diffused, was_delta = mi.Bool(False), mi.Bool(self.after_diffuse), mi.Bool(True)
            # The last scattering, with the density of the direction in which the path left it.
            before, density = dr.zeros(mi.SurfaceInteraction3f), mi.Float(1)
            si = scene.ray_intersect(ray, mi.RayFlags.All, not self.after_diffuse, active)
            if dr.hint(self.hide_emitters, mode="scalar"):
                si = self._past_lamps(scene, ray, si, active)
            while active:
                # ---- Light that the path meets; the eye's own is hidden until something scatters ----
                shows = active & (valid | (not self.hide_emitters) | (self.shows_glow & si.is_valid()))
                light = mi.DirectionSample3f(scene, si, before)
                chance = scene.pdf_emitter_direction(before, light, shows & ~was_delta)
                weight = power_heuristic(density, dr.select(was_delta, 0, chance))
                radiance += dr.select(shows, throughput * weight * light.emitter.eval(si, shows), 0)

                # ---- Light of a lamp ----
                going = active & si.is_valid() & (depth + 1 < self.max_depth)
                bsdf = si.bsdf(ray)
                lit = going & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
                toward, arriving = scene.sample_emitter_direction(si, sampler.next_2d(), not holes, lit)
                lit &= toward.pdf != 0
                value, other = bsdf.eval_pdf(context, si, si.to_local(toward.d), lit)
                if dr.hint(holes, mode="scalar"):
                    arriving *= transmittance(mi, scene, si, toward.p, lit & (dr.max(value) > 0))
                share = dr.select(toward.delta, 1, power_heuristic(toward.pdf, other))
                radiance += dr.select(lit, throughput * value * arriving * share, 0)

                # ---- Onwards ----
                bounce, factor = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), going)
                passed = mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Null)
                valid |= active & si.is_valid() & ~passed
                delta = mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Delta) & ~passed
                sharp = is_sharp(mi, bounce) & ~passed
                if dr.hint(not self.caustics, mode="scalar"):
                    going &= ~(sharp & diffused)
                    diffused |= going & ~sharp & ~passed

                throughput *= factor
                eta *= bounce.eta
                ray = si.spawn_ray(si.to_world(bounce.wo))
                brightest = dr.max(throughput)
                kept = dr.minimum(brightest * dr.square(eta), MAX_KEPT)
                roulette = depth >= self.rr_depth
                survives = sampler.next_1d() < kept
                throughput = dr.select(roulette, throughput / dr.maximum(kept, 1e-8), throughput)
                going &= (brightest > 0) & (~roulette | survives)
                if dr.hint(holes, mode="scalar"):
                    density = dr.select(passed, density, bounce.pdf)
                    was_delta = dr.select(passed, was_delta, delta)
                    before = dr.select(passed, before, si)
                    depth += dr.select(si.is_valid() & ~passed, 1, 0)
                    layers += dr.select(passed, 1, 0)
                    going &= layers < MAX_LAYERS
                else:
                    density = mi.Float(bounce.pdf)
                    was_delta = mi.Bool(delta)
                    before = mi.SurfaceInteraction3f(si)
                    depth += dr.select(si.is_valid(), 1, 0)
                active = mi.Bool(going)
                si = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
                if dr.hint(holes and self.hide_emitters, mode="scalar"):
                    si = self._past_lamps(scene, ray, si, active & ~valid)
            return radiance, valid, []

    mi.register_integrator("dnr_path", Path)

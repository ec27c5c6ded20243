"""Integrator ``dnr_path``: path tracing whose depth is data, not code, and which can leave caustics out.

Mitsuba's ``path`` compiles a kernel for every depth; here all depths share one, which the depth pilot lives on.

A caustic reaches the eye by way of a diffuse surface, from a mirror-like one: eye ... diffuse, sharp ... light.
Without caustics, paths end where a mirror-like lobe is sampled after a diffuse one; it is what Cycles does, but for
soft glossy lobes, which stay. What the eye sees in mirrors and through glass itself stays too.
"""

from __future__ import annotations

from typing import Any

SHARP_DENSITY = 5.0
"""A glossy sample of at least this density, 1/sr, counts as mirror-like: the peak of GGX at roughness 0.35."""
MAX_KEPT = 0.95  # roulette: the largest probability of going on


def power_heuristic(a: Any, b: Any) -> Any:
    """a² / (a² + b²), 0 where both are 0 (Veach 1997, section 9.2.2)."""
    import drjit as dr

    squares = dr.square(a)
    total = squares + dr.square(b)
    return dr.select(total > 0, squares / total, 0)


def register(mi: Any) -> None:
    """``dnr_path`` for the current variant (jit variants only)."""
    import drjit as dr

    class Path(mi.SamplingIntegrator):
        """Path tracing with next event estimation, both weighted by the power heuristic.

        ``max_depth``, ``rr_depth``, ``hide_emitters``: as of Mitsuba's ``path``. ``caustics``: true by default;
        ``after_diffuse``: the rays come from a diffuse surface instead of the eye, which matters for caustics.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.max_depth = dr.opaque(mi.UInt32, int(props.get("max_depth", 8)))
            self.caustics = bool(props.get("caustics", True))
            self.after_diffuse = bool(props.get("after_diffuse", False))
            self.rr_depth = int(props.get("rr_depth", 5))

        @dr.syntax
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            import drjit as dr  # dr.syntax compiles this function anew, without the names around it
            import mitsuba as mi

            context = mi.BSDFContext()
            ray = mi.Ray3f(ray)
            active = mi.Bool(active)
            radiance, throughput = mi.Spectrum(0), mi.Spectrum(1)
            eta, depth = mi.Float(1), mi.UInt32(0)
            valid, diffused, was_delta = mi.Bool(False), mi.Bool(self.after_diffuse), mi.Bool(True)
            before, density = dr.zeros(mi.SurfaceInteraction3f), mi.Float(1)
            si = scene.ray_intersect(ray, mi.RayFlags.All, True, active)
            if dr.hint(self.hide_emitters, mode="scalar"):
                lamp = active & si.is_valid() & si.shape.is_emitter()
                after = self.skip_area_emitters(scene, si.spawn_ray(ray.d), True, lamp)
                behind = after.compute_surface_interaction(si.spawn_ray(ray.d), mi.RayFlags.All, lamp)
                si = dr.select(lamp, behind, si)
            while active:
                hidden = self.hide_emitters & (depth == 0)
                shows = active & ~hidden
                light = mi.DirectionSample3f(scene, si, before)
                chance = scene.pdf_emitter_direction(before, light, shows & ~was_delta)
                weight = power_heuristic(density, dr.select(was_delta, 0, chance))
                radiance += dr.select(shows, throughput * weight * light.emitter.eval(si, shows), 0)

                going = active & si.is_valid() & (depth + 1 < self.max_depth)
                bsdf = si.bsdf(ray)
                lit = going & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
                toward, arriving = scene.sample_emitter_direction(si, sampler.next_2d(), True, lit)
                lit &= toward.pdf != 0
                value, other = bsdf.eval_pdf(context, si, si.to_local(toward.d), lit)
                share = dr.select(toward.delta, 1, power_heuristic(toward.pdf, other))
                radiance += dr.select(lit, throughput * value * arriving * share, 0)

                bounce, factor = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), going)
                passed = mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Null)
                valid |= active & si.is_valid() & ~passed
                delta = mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Delta) & ~passed
                glossy = mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Glossy) & (bounce.pdf > SHARP_DENSITY)
                sharp = delta | glossy
                if dr.hint(not self.caustics, mode="scalar"):
                    going &= ~(sharp & diffused)
                    diffused |= going & ~sharp & ~passed

                throughput *= factor
                eta *= bounce.eta
                density = mi.Float(bounce.pdf)
                was_delta = mi.Bool(delta | passed)
                before = mi.SurfaceInteraction3f(si)
                ray = si.spawn_ray(si.to_world(bounce.wo))
                brightest = dr.max(throughput)
                kept = dr.minimum(brightest * dr.square(eta), MAX_KEPT)
                roulette = depth >= self.rr_depth
                survives = sampler.next_1d() < kept
                throughput = dr.select(roulette, throughput / dr.maximum(kept, 1e-8), throughput)
                going &= (brightest > 0) & (~roulette | survives)
                depth += dr.select(si.is_valid(), 1, 0)
                active = mi.Bool(going)
                si = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
            return radiance, valid, []

    mi.register_integrator("dnr_path", Path)

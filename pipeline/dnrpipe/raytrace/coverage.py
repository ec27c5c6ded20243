"""Alpha behind coloured transparency, as Cycles counts it: 1 - mean over the colours of what passes straight on.

Mitsuba's integrators say of each path whether it met anything, and count a tinted null interaction as nothing met.
"""

from __future__ import annotations

from typing import Any

TINTED = "dnr_transparent"


def has_tinted(scene: Any) -> bool:
    """Whether a surface of the scene passes light straight on and colours it."""
    return any(str(shape.bsdf()).startswith(TINTED) for shape in scene.shapes() if shape.bsdf() is not None)


def with_tinted_alpha(mi: Any, inner: Any, first_visible: Any) -> Any:
    """``inner`` with the alpha of camera rays that a surface lets pass redrawn from their transmittance T.

    first_visible: (scene, ray, active) -> (ray that starts behind what the camera does not see, its first hit).
    T is the product along the straight ray, per colour, so two panes of different colours can hide everything; a
    sample counts as covered with probability 1 - mean(T). Rays into a medium keep the integrator's own answer.
    """
    import drjit as dr

    def passes(hit: Any, active: Any) -> Any:
        if not dr.is_jit_v(mi.Float) and not (active and hit.is_valid()):
            return False
        found = active & hit.is_valid()
        null = mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.Null)
        return found & null & dr.select(hit.is_medium_transition(), False, True)

    def transmittance(scene: Any, ray: Any, hit: Any, passing: Any) -> Any:
        """Per colour, from ``hit`` on, which passes light."""

        def onwards(hit: Any, total: Any, passing: Any) -> tuple[Any, Any, Any]:
            total = total * dr.select(passing, hit.bsdf().eval_null_transmission(hit, passing), 1)
            _, hit = first_visible(scene, hit.spawn_ray(ray.d), passing)
            opaque = passing & hit.is_valid() & dr.select(passes(hit, passing), False, True)
            total = dr.select(opaque, 0, total)
            return hit, total, passing & passes(hit, passing) & (dr.max(total) > 0)

        state = (hit, mi.Spectrum(1.0), passing)
        return dr.while_loop(state, lambda hit, total, passing: passing, onwards)[1]

    class TintedAlpha(mi.SamplingIntegrator):
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            # Drawn first: paths of any depth then go on with the same random numbers.
            chance = sampler.next_1d(active)
            colour, met, aovs = inner.sample(scene, sampler, ray, medium, active)
            seen, hit = first_visible(scene, ray, active)
            redrawn = passes(hit, active)
            total = transmittance(scene, seen, hit, redrawn)
            return colour, dr.select(redrawn, chance >= dr.mean(total), met), aovs

    return TintedAlpha(mi.Properties("tinted_alpha"))

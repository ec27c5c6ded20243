"""Auxiliary images for the denoiser: what a pixel shows first that is not a mirror, smooth glass or a hole.

Open Image Denoise keeps the edges and textures that its auxiliary images show. Of the water in a basin the first
surface shows nothing, and the sand below would be blurred away; so mirror-like surfaces are followed, as its
documentation advises (https://www.openimagedenoise.org/documentation.html, "Albedos"):

    albedo    throughput of the mirror-like path times the diffuse reflectance where it ends; 1 in place of the
              reflectance on what has no diffuse lobe, and where the path leaves the scene; 0 where nothing is
    normal    world-space shading normal of the surface where it ends
"""

from __future__ import annotations

from typing import Any

from .lobes import bsdfs_of, lets_through, mean_of
from .visibility import first_visible_of

MAX_BOUNCES = 6


def shown_first(mi: Any, scene: Any) -> Any:
    """Function (scene, ray, sampler, active) -> (albedo, normal, whether any surface is met).

    Lamps are passed. Which lobe of a mirror-like surface is followed, and whether a surface that lets light straight
    through is passed, is drawn from ``sampler``, which is not touched where the scene has neither.
    """
    import drjit as dr

    visible = first_visible_of(mi, scene)
    mirrors = any(not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) for bsdf in bsdfs_of(scene))
    holes = lets_through(mi, scene)

    def reflectance(hit: Any, active: Any) -> tuple[Any, Any]:
        """(albedo, normal) where a path ends."""
        bsdf = hit.bsdf()
        found = active & hit.is_valid()
        albedo = dr.clip(mi.Color3f(bsdf.eval_diffuse_reflectance(hit, found)), 0, 1)
        albedo = dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse), albedo, 1)
        return dr.select(found, albedo, 0), dr.select(found, hit.sh_frame.n, 0)

    def shown(scene: Any, ray: Any, sampler: Any, active: Any) -> tuple[Any, Any, Any]:
        ray, hit = visible(scene, ray, active)
        if not (mirrors or holes):
            return *reflectance(hit, active), active & hit.is_valid()

        def step(
            hit: Any, direction: Any, sampler: Any, going: Any, left: Any, share: Any, straight: Any, any_: Any
        ) -> tuple[Any, ...]:
            bsdf = hit.bsdf()
            through = mean_of(bsdf.eval_null_transmission(hit, going))
            passed = going & (sampler.next_1d(going) < through)
            bounced = going & ~passed & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            pair = sampler.next_1d(going), sampler.next_2d(going)
            found, weight = bsdf.sample(mi.BSDFContext(), hit, *pair, bounced)
            bounced &= found.pdf > 0
            # Radiance grows by eta² on the way into glass (Veach 1997, section 5.2); a reflectance does not.
            share = dr.select(bounced, share * mi.Color3f(weight) * dr.square(found.eta), share)
            direction = dr.select(bounced, hit.to_world(found.wo), direction)
            onwards = passed | bounced
            any_ |= going & ~passed
            straight &= passed | ~going
            # Lamps that a mirror shows are not passed: they are in the picture.
            hit = dr.select(onwards, scene.ray_intersect(hit.spawn_ray(direction), onwards), hit)
            return hit, direction, sampler, onwards & hit.is_valid() & (left > 0), left - 1, share, straight, any_

        state = (
            *(hit, mi.Vector3f(ray.d), sampler, active & hit.is_valid(), mi.UInt32(MAX_BOUNCES)),
            *(mi.Color3f(1.0), mi.Bool(True), mi.Bool(False)),
        )
        hit, _, _, _, _, share, straight, met = dr.while_loop(state, lambda *state: state[3], step)
        albedo, normal = reflectance(hit, active)
        albedo = dr.select(~hit.is_valid() & ~straight & active, 1, albedo)
        return dr.clip(albedo * share, 0, 1), normal, active & met

    return shown


def auxiliary_integrator(mi: Any, scene: Any) -> Any:
    """Integrator whose extra channels are albedo (3) and normal (3); its radiance is 0."""
    shown = shown_first(mi, scene)

    class Auxiliary(mi.SamplingIntegrator):
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            del medium
            albedo, normal, met = shown(scene, ray, sampler, mi.Bool(active))
            return mi.Spectrum(0.0), met, [*albedo, *normal]

        def aov_names(self) -> list[str]:
            return [f"albedo.{c}" for c in "RGB"] + [f"normal.{c}" for c in "XYZ"]

    return Auxiliary(mi.Properties("auxiliary"))

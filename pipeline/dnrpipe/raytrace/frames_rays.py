"""Camera rays whose camera is data, and what they show first: parts of the kernels of `frames`."""

from __future__ import annotations

from typing import Any

from .lobes import bsdfs_of
from .visibility import first_visible_of


def pinhole(mi: Any, camera: list[Any], pixel: Any, offset: Any, width: int) -> Any:
    """Rays through places (0..1, 0..1) of pixels, numbered row by row.

    camera: c2w's first three rows, focal length, principal point (x, y), lengths of the latter in pixels.
    """
    import drjit as dr

    x = (mi.Float(pixel % width) + offset.x - camera[13]) / camera[12]
    y = (mi.Float(pixel // width) + offset.y - camera[14]) / camera[12]
    # Camera axes are OpenGL's: y up, looking along -z.
    world = [camera[4 * row] * x - camera[4 * row + 1] * y - camera[4 * row + 2] for row in range(3)]
    return mi.Ray3f(mi.Point3f(camera[3], camera[7], camera[11]), dr.normalize(mi.Vector3f(*world)))


def lets_through(mi: Any, scene: Any) -> bool:
    """Whether a surface of the scene passes light straight on."""
    return any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs_of(scene))


def seen_first(mi: Any, scene: Any) -> Any:
    """Function (scene, ray, sampler) -> what the pixel shows there first.

    Lamps are passed, and what surfaces let straight through is passed with its probability; where there are no such
    surfaces, the sampler may be None.
    """
    import drjit as dr

    visible, transparent = first_visible_of(mi, scene), lets_through(mi, scene)

    def seen(scene: Any, ray: Any, sampler: Any) -> Any:
        ray, hit = visible(scene, ray, mi.Bool(True))
        if not transparent:
            return hit

        def passes(hit: Any, sampler: Any, active: Any) -> Any:
            bsdf = hit.bsdf()
            null = active & hit.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
            share = dr.mean(bsdf.eval_null_transmission(hit, null))
            return null & (sampler.next_1d(active) < share)

        def onwards(hit: Any, direction: Any, sampler: Any, active: Any) -> tuple[Any, ...]:
            _, next_hit = visible(scene, hit.spawn_ray(direction), active)
            hit = dr.select(active, next_hit, hit)
            return hit, direction, sampler, passes(hit, sampler, active)

        state = (hit, mi.Vector3f(ray.d), sampler, passes(hit, sampler, mi.Bool(True)))
        return dr.while_loop(state, lambda hit, direction, sampler, active: active, onwards)[0]

    return seen

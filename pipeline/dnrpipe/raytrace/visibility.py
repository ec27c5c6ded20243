"""What the camera sees of the light sources, as in Blender: glowing surfaces yes, lamps and the world no.

Mitsuba's ``hide_emitters`` hides *all* emitters from the camera, glowing surfaces of the scene included;
without it, lamps and the environment are in the picture. Lamps are the shapes named ``light-*`` in the bundle.
"""

from __future__ import annotations

from typing import Any

from .lobes import lets_through, mean_of

LAMP_PREFIX = "light-"
TINTED = "dnr_transparent"
UNSEEN_PREFIX = "unseen-"
"""Shapes that are invisible to camera rays only."""
ROULETTE_DEPTH = 5
OWN: dict[str, dict[str, Any]] = {
    "path-without-caustics": {"type": "dnr_path", "caustics": False},
    "path-of-any-depth": {"type": "dnr_path"},
}
"""Integrators of `paths`."""


def integrator_settings(mi: Any, scene: Any, kind: str) -> dict[str, Any]:
    """The plugin that stands for ``kind``: Mitsuba's ``direct``, ``path`` or ``volpath``, or one of ``OWN``.

    Where surfaces let light straight through, ours takes the place of ``path``, which is wrong there (see `paths`);
    under a scalar variant, ``volpath`` does.
    """
    import drjit as dr

    if kind == "path" and lets_through(mi, scene):
        return {"type": "dnr_path" if dr.is_jit_v(mi.Float) else "volpath"}
    return dict(OWN.get(kind, {"type": kind}))


def camera_integrator(mi: Any, scene: Any, max_depth: int, kind: str) -> tuple[Any, str]:
    """(integrator, its name for the file's metadata): ``kind``, or ``kind+glow`` where surfaces glow.

    kind: see `integrator_settings`. Roulette starts at a fixed depth: with the same seed, a path cut at one depth is
    then the beginning of the path cut at a larger one, which the depth pilot relies on.
    """
    settings = integrator_settings(mi, scene, kind)
    if kind == "direct":
        settings |= {"emitter_samples": 1, "bsdf_samples": 1}
    else:
        settings |= {"max_depth": max_depth, "rr_depth": ROULETTE_DEPTH}
    glow = {"shows_glow": True} if settings["type"] == "dnr_path" and lets_through(mi, scene) else {}
    hidden = mi.load_dict({**settings, **glow, "hide_emitters": True})
    first_visible, found, name = first_visible_of(mi, scene), hidden, kind
    shapes = scene.shapes()
    glowing = any(shape.is_emitter() and not shape.id().startswith(LAMP_PREFIX) for shape in shapes)
    if glowing or any(shape.id().startswith(UNSEEN_PREFIX) for shape in shapes):
        shown = mi.load_dict({**settings, "hide_emitters": False})
        found, name = _camera_view(mi, scene, hidden, shown, first_visible), f"{kind}+glow"
    if any(str(shape.bsdf()).startswith(TINTED) for shape in shapes):  # light passes straight on, and is coloured
        found = with_tinted_alpha(mi, found, first_visible)
    return found, name


def is_one_of(mi: Any, hit: Any, shapes: list[Any]) -> Any:
    """Whether ``hit`` is on one of the shapes."""
    import drjit as dr

    if not dr.is_jit_v(mi.Float):  # scalar variants: one ray at a time, no shape where nothing is hit
        return hit.is_valid() and any(hit.shape is shape or hit.instance is shape for shape in shapes)
    found = mi.Mask(False)
    for shape in shapes:  # pointers compare element by element
        found |= (hit.shape == mi.ShapePtr(shape)) | (hit.instance == mi.ShapePtr(shape))
    return found & hit.is_valid()


def first_visible_of(mi: Any, scene: Any) -> Any:
    """Function (scene, ray, active) -> (ray that starts behind lamps and unseen shapes, its first hit)."""
    import drjit as dr

    apart = [shape for shape in scene.shapes() if shape.id().startswith((LAMP_PREFIX, UNSEEN_PREFIX))]

    def first_visible(scene: Any, ray: Any, active: Any) -> tuple[Any, Any]:
        ray = mi.Ray3f(ray)
        hit = scene.ray_intersect(ray, active)
        if not apart:
            return ray, hit

        def onwards(ray: Any, hit: Any, passing: Any) -> tuple[Any, Any, Any]:
            ray = hit.spawn_ray(ray.d)
            hit = scene.ray_intersect(ray, passing)
            return ray, hit, passing & is_one_of(mi, hit, apart)

        state = (ray, hit, active & is_one_of(mi, hit, apart))
        ray, hit, _ = dr.while_loop(state, lambda ray, hit, passing: passing, onwards)
        return ray, hit

    return first_visible


def _camera_view(mi: Any, scene: Any, hidden: Any, shown: Any, first_visible: Any) -> Any:
    """Integrator that treats what camera rays meet first, and leaves the rest to Mitsuba's own.

    Lamps and unseen shapes are passed. Where a glowing surface comes next, its emission is added; it passes the ray on
    (alpha), or scatters it into ``shown``, in which all emitters are visible. Anything else is for ``hidden``.
    """
    import drjit as dr

    lamps = [shape for shape in scene.shapes() if shape.id().startswith(LAMP_PREFIX)]
    jit = dr.is_jit_v(mi.Float)

    def glows(hit: Any) -> Any:
        if not jit:
            return hit.is_valid() and hit.shape.is_emitter() and not is_one_of(mi, hit, lamps)
        return hit.is_valid() & hit.shape.is_emitter() & ~is_one_of(mi, hit, lamps)

    def glowing_layers(scene: Any, sampler: Any, ray: Any, hit: Any, glow: Any) -> tuple[Any, Any, Any, Any]:
        """Walk through the glowing surfaces in front.

        Returns (their emission, weight of the rest, ray to it, whether that starts from a scattering at the last one).
        """

        def onwards(
            sampler: Any, ray: Any, hit: Any, glow: Any, radiance: Any, weight: Any, bounced: Any
        ) -> tuple[Any, ...]:
            radiance = radiance + weight * hit.emitter(scene, glow).eval(hit, glow)
            pair = sampler.next_1d(glow), sampler.next_2d(glow)
            found, passed = hit.bsdf().sample(mi.BSDFContext(), hit, *pair, glow)
            weight = weight * passed
            ray = hit.spawn_ray(hit.to_world(found.wo))
            null = mi.has_flag(found.sampled_type, mi.BSDFFlags.Null)
            hit = scene.ray_intersect(ray, glow)
            glow = glow & null & glows(hit) & (dr.max(weight) > 0)
            return sampler, ray, hit, glow, radiance, weight, dr.select(null, mi.Bool(False), mi.Bool(True))

        state = (sampler, ray, hit, glow, mi.Spectrum(0.0), mi.Spectrum(1.0), mi.Bool(False))
        found = dr.while_loop(state, lambda *state: state[3], onwards)
        _, ray, _, _, radiance, weight, bounced = found
        return radiance, weight, ray, bounced

    class CameraView(mi.SamplingIntegrator):
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            seen, hit = first_visible(scene, ray, active)
            front = active & glows(hit)
            radiance, weight, seen, bounced = glowing_layers(scene, sampler, seen, hit, front)
            rest = active & (dr.max(weight) > 0)
            rest_ray = mi.RayDifferential3f(seen)
            lit, _, _ = shown.sample(scene, sampler, rest_ray, medium, rest & bounced)
            rest = rest & dr.select(bounced, False, True)
            dark, found, _ = hidden.sample(scene, sampler, rest_ray, medium, rest)
            total = radiance + weight * (dr.select(bounced, lit, 0) + dr.select(rest, dark, 0))
            return total, (front & bounced) | (rest & found), []

    return CameraView(mi.Properties("camera_view"))


def with_tinted_alpha(mi: Any, inner: Any, first_visible: Any) -> Any:
    """``inner`` with the alpha of camera rays that a surface lets pass redrawn from their transmittance T (Cycles).

    Mitsuba's integrators say whether a path met anything, and count a tinted null interaction as nothing met.
    first_visible: (scene, ray, active) -> (ray that starts behind what the camera does not see, its first hit).
    A sample counts as covered with probability 1 - mean(T). Rays into a medium keep the integrator's own answer.
    """
    import drjit as dr

    passes, transmittance = straight_on(mi, first_visible)

    class TintedAlpha(mi.SamplingIntegrator):
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            # Drawn first: paths of any depth then go on with the same random numbers.
            chance = sampler.next_1d(active)
            colour, met, aovs = inner.sample(scene, sampler, ray, medium, active)
            seen, hit = first_visible(scene, ray, active)
            redrawn = passes(hit, active)
            total = transmittance(scene, seen, hit, redrawn)
            return colour, dr.select(redrawn, chance >= mean_of(total), met), aovs

    return TintedAlpha(mi.Properties("tinted_alpha"))


def straight_on(mi: Any, first_visible: Any) -> tuple[Any, Any]:
    """Two functions: (hit, active) -> whether light passes straight through there, not into a medium; and (scene, ray,
    hit, passing) -> what is left of it, T per colour, where nothing opaque stands behind.

    T is the product along the straight ray, per colour, so two panes of different colours can hide everything.
    first_visible: see `with_tinted_alpha`.
    """
    import drjit as dr

    def passes(hit: Any, active: Any) -> Any:
        if not dr.is_jit_v(mi.Float) and not (active and hit.is_valid()):
            return False
        found = active & hit.is_valid()
        null = mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.Null)
        return found & null & dr.select(hit.is_medium_transition(), False, True)

    def transmittance(scene: Any, ray: Any, hit: Any, passing: Any) -> Any:
        def onwards(hit: Any, total: Any, passing: Any) -> tuple[Any, Any, Any]:
            total = total * dr.select(passing, hit.bsdf().eval_null_transmission(hit, passing), 1)
            _, hit = first_visible(scene, hit.spawn_ray(ray.d), passing)
            opaque = passing & hit.is_valid() & dr.select(passes(hit, passing), False, True)
            total = dr.select(opaque, 0, total)
            return hit, total, passing & passes(hit, passing) & (dr.max(total) > 0)

        state = (hit, mi.Spectrum(1.0), passing)
        return dr.while_loop(state, lambda hit, total, passing: passing, onwards)[1]

    return passes, transmittance

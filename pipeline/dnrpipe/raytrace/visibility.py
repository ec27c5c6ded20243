"""What the camera sees of the light sources, as in Blender: glowing surfaces yes, lamps and the world no.

Mitsuba's ``hide_emitters`` hides *all* emitters from the camera, glowing surfaces of the scene included;
without it, lamps and the environment are in the picture. Lamps are the shapes named ``light-*`` in the bundle.
"""

from __future__ import annotations

from typing import Any

LAMP_PREFIX = "light-"


def glowing_shapes(scene: Any) -> list[Any]:
    """Shapes of the scene that emit and are not lamps."""
    return [shape for shape in scene.shapes() if shape.is_emitter() and not shape.id().startswith(LAMP_PREFIX)]


def camera_integrator(mi: Any, scene: Any, max_depth: int) -> tuple[Any, str]:
    """(integrator, its name for the file's metadata): ``path``, or ``path+glow`` where surfaces glow."""
    settings = {"type": "path", "max_depth": max_depth, "rr_depth": max(5, max_depth // 2)}
    hidden = mi.load_dict({**settings, "hide_emitters": True})
    if not glowing_shapes(scene):
        return hidden, "path"
    return _glow_integrator(mi, scene, hidden, mi.load_dict({**settings, "hide_emitters": False})), "path+glow"


def _glow_integrator(mi: Any, scene: Any, hidden: Any, shown: Any) -> Any:
    """Path tracing that shows a glowing surface to the camera where it is the first thing hit.

    Both parts are Mitsuba's own ``path``: the one that shows emitters for camera rays that first hit a glowing
    surface, the one that hides them for all others. A lamp in front of a glowing surface hides it too.
    """
    import drjit as dr

    class PathWithGlow(mi.SamplingIntegrator):
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            hit = scene.ray_intersect(ray, active)
            glows = active & hit.is_valid() & _is_glowing(hit)
            dark, valid, _ = hidden.sample(scene, sampler, ray, medium, dr.select(glows, False, active))
            bright, _, _ = shown.sample(scene, sampler, ray, medium, active & glows)
            return dr.select(glows, bright, dark), valid | glows, []

    lamps = [shape for shape in scene.shapes() if shape.id().startswith(LAMP_PREFIX)]

    def _is_glowing(hit: Any) -> Any:
        if not dr.is_jit_v(mi.Float):  # scalar variants: one ray at a time, no shape where nothing is hit
            return hit.shape is not None and hit.shape.is_emitter() and not hit.shape.id().startswith(LAMP_PREFIX)
        glows = hit.shape.is_emitter()
        for lamp in lamps:  # pointers compare element by element
            glows &= hit.shape != mi.ShapePtr(lamp)
        return glows

    return PathWithGlow(mi.Properties("path_with_glow"))

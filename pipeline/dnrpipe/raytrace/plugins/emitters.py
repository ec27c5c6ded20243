"""Emitters of surfaces: ``dnr_area`` glows on both sides, ``dnr_lamp`` in a beam, as Blender's do."""

from __future__ import annotations

from typing import Any

from .nesting import parameter


def register(mi: Any) -> None:
    """``dnr_area`` and ``dnr_lamp`` for the current variant."""
    import drjit as dr

    class TwoSidedArea(mi.Emitter):
        """Mitsuba's ``area`` without the test for the side. ``radiance``: texture. Nested in a shape.

        Mitsuba's ``area`` shines along the normal only, which is enough for closed surfaces.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.radiance = props.get_emissive_texture("radiance", 1.0)
            self.m_flags = int(mi.EmitterFlags.Surface)
            if self.radiance.is_spatially_varying():
                self.m_flags |= int(mi.EmitterFlags.SpatiallyVarying)

        def eval(self, si: Any, active: Any = True) -> Any:
            return self.radiance.eval(si, active)

        def _towards(self, it: Any, ds: Any, active: Any) -> Any:
            si = mi.SurfaceInteraction3f(ds, it.wavelengths)
            si.wi = mi.Frame3f(ds.n).to_local(-ds.d)
            return self.radiance.eval(si, active)

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
            ds = self.get_shape().sample_direction(it, sample, active)
            usable = active & (ds.pdf > 0)
            radiance = self._towards(it, ds, usable)
            return ds, dr.select(usable, radiance / dr.select(usable, ds.pdf, 1), 0)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return self.get_shape().pdf_direction(it, ds, active)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return self._towards(it, ds, active)

        def bbox(self) -> Any:
            return self.get_shape().bbox()

        def traverse(self, callback: Any) -> None:
            callback.put("radiance", self.radiance, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "dnr_area[]"

    class Lamp(TwoSidedArea):
        """``area`` whose radiance depends on the direction: ``radiance`` times the profile named ``profile``.

        ``point``: 1. ``spot``: smoothstep((c - ``cutoff``) / ``span``), c the cosine to the beam's ``axis`` (vector,
        world space). ``spread``: max(``tangent`` - tan t, 0) ``scale``, t the angle to the surface's normal: what the
        slats of a soft box's grid let pass.
        ``soft``: radius r of a sphere that is to light a point at distance d from its centre as a disc facing it would
        (Cycles' soft falloff): times d^2 / (d^2 + r^2). 0: no such factor.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.profile = props["profile"]
            self.is_soft = float(props.get("soft", 0.0)) > 0
            self.soft = parameter(mi, float(props.get("soft", 0.0)))
            if self.profile == "spot":
                self.axis = mi.Vector3f(props["axis"])
                if dr.is_jit_v(mi.Float):
                    dr.make_opaque(self.axis)
                self.cutoff, self.span = parameter(mi, float(props["cutoff"])), parameter(mi, float(props["span"]))
            elif self.profile == "spread":
                self.tangent, self.scale = parameter(mi, float(props["tangent"])), parameter(mi, float(props["scale"]))
            elif self.profile != "point":
                raise RuntimeError(f"dnr_lamp: no profile '{self.profile}'")

        def _beam(self, cosine: Any, direction: Any, normal: Any, distance: Any) -> Any:
            """Profile for light that leaves along ``direction`` (world), at ``cosine`` to the surface's normal."""
            beam = mi.Float(1.0)
            if self.profile == "spot":
                t = dr.clip((dr.dot(direction, self.axis) - self.cutoff) / self.span, 0, 1)
                beam = t * t * (3 - 2 * t)
            elif self.profile == "spread":
                tangent = dr.sqrt(dr.maximum(1 - cosine * cosine, 0)) / dr.maximum(cosine, 1e-6)
                beam = dr.maximum(self.tangent - tangent, 0) * self.scale
            if self.is_soft:
                d2 = dr.squared_norm(direction * distance + normal * self.soft)
                beam = beam * d2 / (d2 + self.soft**2)
            return dr.select(cosine > 0, beam, 0)

        def eval(self, si: Any, active: Any = True) -> Any:
            return super().eval(si, active) * self._beam(mi.Frame3f.cos_theta(si.wi), si.to_world(si.wi), si.n, si.t)

        def _towards(self, it: Any, ds: Any, active: Any) -> Any:
            return super()._towards(it, ds, active) * self._beam(-dr.dot(ds.d, ds.n), -ds.d, ds.n, ds.dist)

        def to_string(self) -> str:
            return f"dnr_lamp[{self.profile}]"

    mi.register_emitter("dnr_area", TwoSidedArea)
    mi.register_emitter("dnr_lamp", Lamp)

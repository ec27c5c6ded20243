"""BSDFs ``dnr_transparent``: tinted straight-through transmission beside another BSDF (Blender's Transparent BSDF), and
``dnr_translucent``: diffuse transmission through a thin sheet (its Translucent BSDF).
"""

from __future__ import annotations

from typing import Any

from .nesting import evaluated_once, nested


def register(mi: Any) -> None:
    """``dnr_transparent`` and ``dnr_translucent`` for the current variant."""
    import drjit as dr

    class Transparent(evaluated_once(mi)):
        """Mitsuba's ``mask`` with a colour: opacity a, tint c, nested f: ``a f + (1 - a) c`` straight on.

        ``transmittance``: texture c (default 1). ``opacity``: texture a in [0, 1] (default 0). A nested BSDF, to be
        two-sided itself, or none: then what is not transmitted is absorbed.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.transmittance = props.get_texture("transmittance", 1.0)
            self.opacity = props.get_texture("opacity", 0.0)
            parts = nested(props, mi.BSDF)
            if len(parts) > 1:
                raise RuntimeError(f"dnr_transparent: at most one nested BSDF, found {len(parts)}")
            self.nested = parts[0] if parts else None
            own = [self.nested.flags(i) for i in range(self.nested.component_count())] if self.nested else []
            null = int(mi.BSDFFlags.Null | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide)
            self.m_components = [*own, null]
            self.m_flags = null | (self.nested.flags() if self.nested else 0)

        def _opacity(self, si: Any, active: Any) -> Any:
            if self.nested is None:
                return mi.Float(0.0)
            return dr.clip(self.opacity.eval_1(si, active), 0, 1)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            opacity = self._opacity(si, active)
            through = sample1 >= opacity
            straight = dr.zeros(mi.BSDFSample3f)
            straight.wo = -si.wi
            straight.eta = 1.0
            straight.pdf = 1.0 - opacity
            straight.sampled_type = mi.UInt32(int(mi.BSDFFlags.Null))
            straight.sampled_component = mi.UInt32(len(self.m_components) - 1)
            tint = self.transmittance.eval(si, active & through)
            if self.nested is None:
                return straight, tint
            if not ctx.is_enabled(mi.BSDFFlags.Null, len(self.m_components) - 1):
                found, weight = self.nested.sample(ctx, si, sample1, sample2, active)
                return found, weight * opacity
            rescaled = dr.minimum(sample1 / dr.maximum(opacity, 1e-6), 1)
            found, weight = self.nested.sample(ctx, si, rescaled, sample2, active & (sample1 < opacity))
            found.pdf *= opacity
            return dr.select(through, straight, found), dr.select(through, tint, weight)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            if self.nested is None:
                return mi.Spectrum(0.0), mi.Float(0.0)
            value, density = self.nested.eval_pdf(ctx, si, wo, active)
            opacity = self._opacity(si, active)
            return value * opacity, density * opacity

        def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
            opacity = self._opacity(si, active)
            straight = self.transmittance.eval(si, active) * (1 - opacity)
            if self.nested is None:
                return straight
            return straight + self.nested.eval_null_transmission(si, active) * opacity

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            if self.nested is None:
                return mi.Spectrum(0.0)
            return self.nested.eval_diffuse_reflectance(si, active) * self._opacity(si, active)

        def traverse(self, callback: Any) -> None:
            callback.put("transmittance", self.transmittance, mi.ParamFlags.Differentiable)
            callback.put("opacity", self.opacity, mi.ParamFlags.Differentiable)
            if self.nested is not None:
                callback.put("nested_bsdf", self.nested, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "dnr_transparent[]"

    mi.register_bsdf("dnr_transparent", Transparent)

    class Translucent(evaluated_once(mi)):
        """Lambertian, but to the other side: ``color`` / π for wo across the surface from wi, 0 elsewhere.

        ``color``: texture in [0, 1], the share that comes through. Both sides are alike.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.color = props.get_texture("color", 0.5)
            kind = mi.BSDFFlags.DiffuseTransmission | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [int(kind)]
            self.m_flags = int(kind)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            del sample1  # one lobe
            found = dr.zeros(mi.BSDFSample3f)
            if not ctx.is_enabled(mi.BSDFFlags.DiffuseTransmission, 0):
                return found, mi.Spectrum(0.0)
            wo = mi.warp.square_to_cosine_hemisphere(sample2)
            good = active & (si.wi.z != 0) & (wo.z > 0)
            found.pdf = dr.select(good, wo.z * dr.inv_pi, 0)
            wo.z = dr.select(si.wi.z > 0, -wo.z, wo.z)
            found.wo, found.eta = wo, 1.0
            found.sampled_type = mi.UInt32(int(mi.BSDFFlags.DiffuseTransmission))
            return found, dr.select(good, self._color(si, good), 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            if not ctx.is_enabled(mi.BSDFFlags.DiffuseTransmission, 0):
                return mi.Spectrum(0.0), mi.Float(0.0)
            across = active & (si.wi.z * wo.z < 0)
            density = dr.select(across, dr.abs(wo.z) * dr.inv_pi, 0)
            return self._color(si, across) * density, density

        def _color(self, si: Any, active: Any) -> Any:
            return dr.clip(self.color.eval(si, active), 0, 1)

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            return self._color(si, active)

        def traverse(self, callback: Any) -> None:
            callback.put("color", self.color, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "dnr_translucent[]"

    mi.register_bsdf("dnr_translucent", Translucent)

"""BSDF ``dnr_translucent``: diffuse transmission through a thin sheet (Blender's Translucent BSDF)."""

from __future__ import annotations

from typing import Any


def register(mi: Any) -> None:
    """``dnr_translucent`` for the current variant."""
    import drjit as dr

    class Translucent(mi.BSDF):
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

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

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

"""BSDF ``dnr_add``: the sum of two BSDFs (Blender's Add Shader)."""

from __future__ import annotations

from typing import Any

from .nesting import evaluated_once, nested


def register(mi: Any) -> None:
    """``dnr_add`` for the current variant."""
    import drjit as dr

    class Sum(evaluated_once(mi)):
        """Two nested BSDFs f and g: f + g, sampled by one of them at even odds. It may reflect more than it gets."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            parts = nested(props, mi.BSDF)
            if len(parts) != 2:
                raise RuntimeError(f"dnr_add: needs exactly two nested BSDFs, found {len(parts)}")
            self.f, self.g = parts
            self.m_components = [part.flags(i) for part in parts for i in range(part.component_count())]
            self.m_flags = self.f.flags() | self.g.flags()

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            first, second = sample1 < 0.5, sample1 >= 0.5  # scalar variants have Python's bool: no ~
            rescaled = dr.select(second, sample1 * 2 - 1, sample1 * 2)
            from_f, weight_f = self.f.sample(ctx, si, rescaled, sample2, active & first)
            from_g, weight_g = self.g.sample(ctx, si, rescaled, sample2, active & second)
            from_g.sampled_component += self.f.component_count()
            found = dr.select(second, from_g, from_f)
            weight = dr.select(second, weight_g, weight_f)
            delta = mi.has_flag(found.sampled_type, mi.BSDFFlags.Delta)
            # A direction of a smooth lobe could have come from either part; one of a delta lobe could not.
            value, density = self.eval_pdf(ctx, si, found.wo, active & dr.select(delta, False, True))
            usable = active & (found.pdf > 0) & (delta | (density > 0))
            found.pdf = dr.select(delta, found.pdf * 0.5, density)
            weight = dr.select(delta, weight * 2, value / dr.maximum(density, 1e-30))
            found.pdf = dr.select(usable, found.pdf, 0)
            return found, dr.select(usable, weight, 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            value_f, pdf_f = self.f.eval_pdf(ctx, si, wo, active)
            value_g, pdf_g = self.g.eval_pdf(ctx, si, wo, active)
            return value_f + value_g, 0.5 * (pdf_f + pdf_g)

        def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
            return self.f.eval_null_transmission(si, active) + self.g.eval_null_transmission(si, active)

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            return self.f.eval_diffuse_reflectance(si, active) + self.g.eval_diffuse_reflectance(si, active)

        def traverse(self, callback: Any) -> None:
            callback.put("bsdf_0", self.f, mi.ParamFlags.Differentiable)
            callback.put("bsdf_1", self.g, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "dnr_add[]"

    mi.register_bsdf("dnr_add", Sum)

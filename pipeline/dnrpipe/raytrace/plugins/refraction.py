"""BSDFs ``dnr_refraction``: what an interface transmits, nothing lost to Fresnel (Blender's Refraction BSDF), and
``dnr_interface``: a rough dielectric that loses no energy (its Glass BSDF, Multiscatter GGX).
"""

from __future__ import annotations

from typing import Any

from . import energy
from .energy import look_up, row_of, table_of
from .nesting import evaluated_once, only, parameter


def register(mi: Any) -> None:
    """``dnr_refraction`` and ``dnr_interface`` for the current variant."""
    import drjit as dr

    class Scaled(evaluated_once(mi)):
        """A nested BSDF times `_gain`."""

        def _nest(self, props: Any, name: str) -> None:
            self.nested = only(props, mi.BSDF, name)
            self.m_components = [self.nested.flags(i) for i in range(self.nested.component_count())]
            self.m_flags = self.nested.flags()

        def _context(self, ctx: Any) -> Any:
            return ctx

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            found, weight = self.nested.sample(self._context(ctx), si, sample1, sample2, active)
            return found, weight * self._gain(si, found.wo, active)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            value, density = self.nested.eval_pdf(self._context(ctx), si, wo, active)
            return value * self._gain(si, wo, active), density

        def traverse(self, callback: Any) -> None:
            callback.put("nested_bsdf", self.nested, mi.ParamFlags.Differentiable)

    class Refraction(Scaled):
        """Nested ``dielectric`` or ``roughdielectric`` of relative index ``eta``, its transmission divided by 1 - F.

        F is the dielectric Fresnel term at the microfacet that refracts wi into wo, ``m ~ wi + eta wo``
        (Walter et al. 2007, equation 16). Total internal reflection gives nothing, as in Cycles.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.eta = parameter(mi, float(props["eta"]))
            self._nest(props, "dnr_refraction")
            lobes = enumerate(self.m_components)
            wanted = int(mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.DeltaTransmission)
            self.lobe = next(i for i, flags in lobes if int(flags) & wanted)

        def _context(self, ctx: Any) -> Any:
            """Only transmission."""
            ctx = mi.BSDFContext()
            ctx.component = self.lobe
            return ctx

        def _gain(self, si: Any, wo: Any, active: Any) -> Any:
            del active
            cosine = mi.Frame3f.cos_theta(si.wi)
            eta = dr.select(cosine >= 0, self.eta, 1 / self.eta)
            m = dr.normalize(si.wi + wo * eta)
            m = dr.select(mi.Frame3f.cos_theta(m) * cosine >= 0, m, -m)
            reflected = mi.fresnel(dr.dot(si.wi, m) * dr.sign(cosine), self.eta)[0]
            return dr.select(cosine * mi.Frame3f.cos_theta(wo) < 0, 1 / dr.maximum(1 - reflected, 1e-3), 0)

        def _asked(self, ctx: Any) -> bool:
            return ctx.is_enabled(mi.BSDFFlags(int(self.m_components[self.lobe]) & int(mi.BSDFFlags.All)), self.lobe)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            active = active & self._asked(ctx)
            found, weight = super().sample(ctx, si, sample1, sample2, active)
            return found, dr.select(active, weight, 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            active = active & self._asked(ctx)
            value, density = super().eval_pdf(ctx, si, wo, active)
            return dr.select(active, value, 0), dr.select(active, density, 0)

        def to_string(self) -> str:
            return "dnr_refraction[]"

    mi.register_bsdf("dnr_refraction", Refraction)

    class Interface(Scaled):
        """Nested ``roughdielectric`` (GGX) of relative index ``eta`` and texture ``roughness``, over its albedo.

        Single scattering loses what hits the microfacets twice. As in Cycles, both lobes are divided by the albedo
        that they have together at this cosine and roughness, on the side that is seen.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            eta = float(props["eta"])
            self.roughness = props.get_texture("roughness")
            self._nest(props, "dnr_interface")
            outside, inside = energy.interface_table(eta), energy.interface_table(1 / eta)
            self.table = table_of(mi, [outside, inside, inside])

        def _gain(self, si: Any, wo: Any, active: Any) -> Any:
            del wo
            cosine = mi.Frame3f.cos_theta(si.wi)
            row = row_of(dr.clip(self.roughness.eval_1(si, active), 0, 1))
            found = look_up(mi, self.table, si, dr.abs(cosine), row, active)
            return 1 / dr.maximum(dr.select(cosine >= 0, found[0], found[1]), 0.05)

        def traverse(self, callback: Any) -> None:
            callback.put("roughness", self.roughness, mi.ParamFlags.Differentiable)
            super().traverse(callback)

        def to_string(self) -> str:
            return "dnr_interface[]"

    mi.register_bsdf("dnr_interface", Interface)

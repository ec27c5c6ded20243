"""BSDF ``dnr_normal``: shading by a baked world-space normal."""

from __future__ import annotations

from typing import Any

from .nesting import only

LEAST_FACING = 0.02
"""Least cosine between a bent normal and the direction to the viewer."""


def register(mi: Any) -> None:
    """``dnr_normal`` for the current variant."""
    import drjit as dr

    class WorldNormal(mi.BSDF):
        """``normal``: texture of world-space unit normals, n * 0.5 + 0.5 (raw). One nested BSDF.

        The nested BSDF sees a shading frame about that normal, as below Mitsuba's ``normalmap``. Directions that
        the true surface would not reflect (or transmit) to are dropped. The normal is taken for the front; the
        nested BSDF is the one to be two-sided, so that seen from behind it is turned as a whole, as in Cycles.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.normal = only(props, mi.Texture, "dnr_normal")
            self.nested = only(props, mi.BSDF, "dnr_normal")
            self.m_components = [self.nested.flags(i) for i in range(self.nested.component_count())]
            self.m_flags = self.nested.flags()

        def _perturbed(self, si: Any, active: Any) -> Any:
            normal = mi.Normal3f(self.normal.eval_3(si, active)) * 2 - 1
            # An unbaked texel decodes to a vector of no use: the surface keeps its own normal there.
            usable = dr.squared_norm(normal) > 0.01
            normal = dr.normalize(dr.select(usable, normal, si.sh_frame.n))
            # A normal that faces away from the viewer would show the BSDF's back: it is turned until it just faces
            # the viewer (to the same end as Cycles' ensure_valid_specular_reflection).
            view = si.to_world(si.wi) * dr.select(si.wi.z < 0, -1.0, 1.0)
            normal = dr.normalize(normal + view * dr.maximum(LEAST_FACING - dr.dot(normal, view), 0))
            tangent = dr.normalize(si.sh_frame.s - normal * dr.dot(normal, si.sh_frame.s))
            bent = mi.SurfaceInteraction3f(si)
            bent.sh_frame = mi.Frame3f(tangent, dr.cross(normal, tangent), normal)
            bent.wi = bent.to_local(si.to_world(si.wi))
            return bent

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            bent = self._perturbed(si, active)
            found, weight = self.nested.sample(ctx, bent, sample1, sample2, active)
            outgoing = si.to_local(bent.to_world(found.wo))
            good = active & (mi.Frame3f.cos_theta(found.wo) * mi.Frame3f.cos_theta(outgoing) > 0)
            found.pdf = dr.select(good, found.pdf, 0)
            found.wo = outgoing
            return found, dr.select(good, weight * self._softened(si.sh_frame.n, bent, found.wo, outgoing), 0)

        def _softened(self, own: Any, bent: Any, turned: Any, wo: Any) -> Any:
            """Cycles' bump shadowing term: light that comes close to the true surface's horizon fades softly.

            With the surface's normal g, the bent one n and the light w: t = (g.w) / ((n.w) (g.n)); t + t^2 - t^3
            below 1 (Chiang et al. 2019, "Taming the shadow terminator"). Cycles applies it to diffuse lobes; here it
            goes over the whole BSDF where that has one.
            """
            if not mi.has_flag(self.m_flags, mi.BSDFFlags.Diffuse):
                return 1.0
            tilt = dr.abs(dr.dot(bent.sh_frame.n, own))
            t = dr.abs(wo.z) / dr.maximum(dr.abs(turned.z) * tilt, 1e-6)
            t = dr.minimum(t, 1.0)
            return t + t * t - t * t * t

        def _bent(self, si: Any, wo: Any, active: Any) -> tuple[Any, Any, Any]:
            bent = self._perturbed(si, active)
            turned = bent.to_local(si.to_world(wo))
            good = active & (mi.Frame3f.cos_theta(wo) * mi.Frame3f.cos_theta(turned) > 0)
            return bent, turned, good

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            bent, turned, good = self._bent(si, wo, active)
            return dr.select(
                good, self.nested.eval(ctx, bent, turned, good) * self._softened(si.sh_frame.n, bent, turned, wo), 0
            )

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            bent, turned, good = self._bent(si, wo, active)
            return dr.select(good, self.nested.pdf(ctx, bent, turned, good), 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            bent, turned, good = self._bent(si, wo, active)
            value, density = self.nested.eval_pdf(ctx, bent, turned, good)
            return dr.select(good, value * self._softened(si.sh_frame.n, bent, turned, wo), 0), dr.select(
                good, density, 0
            )

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            return self.nested.eval_diffuse_reflectance(si, active)

        def traverse(self, callback: Any) -> None:
            callback.put("normal", self.normal, mi.ParamFlags.Differentiable)
            callback.put("nested_bsdf", self.nested, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "dnr_normal[]"

    mi.register_bsdf("dnr_normal", WorldNormal)

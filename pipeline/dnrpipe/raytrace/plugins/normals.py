"""BSDF ``dnr_normal``: shading by a baked world-space normal, or by one of a normal map."""

from __future__ import annotations

from typing import Any

from .nesting import evaluated_once, only

LEAST_FACING = 0.01
"""Least cosine between a diffuse lobe's bent normal and the direction to the viewer."""
LEAST_HEIGHT = 0.01
"""Least cosine between the geometric normal and where a bent one mirrors the viewer to."""


def register(mi: Any) -> None:
    """``dnr_normal`` for the current variant."""
    import drjit as dr

    class BentNormal(evaluated_once(mi)):
        """``normal``: texture of unit normals, n * 0.5 + 0.5 (raw), in ``space`` world (default) or tangent. One
        nested BSDF.

        Tangent space: x along the shape's dp/du, z the shading normal, y = z x x, turned towards dp/dv: where UVs are
        mirrored Mitsuba's own ``normalmap`` turns y the other way.

        The nested BSDF sees a shading frame about that normal, as below Mitsuba's ``normalmap``. Directions that
        the true surface would not reflect (or transmit) to are dropped. The normal is taken for the front; the
        nested BSDF is the one to be two-sided, so that seen from behind it is turned as a whole, as in Cycles.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.normal = only(props, mi.Texture, "dnr_normal")
            self.nested = only(props, mi.BSDF, "dnr_normal")
            space = str(props.get("space", "world"))
            if space not in ("world", "tangent"):
                raise RuntimeError(f"dnr_normal: no space {space!r}; world or tangent")
            self.tangent = space == "tangent"
            self.m_components = [self.nested.flags(i) for i in range(self.nested.component_count())]
            self.m_flags = self.nested.flags()
            self.glossy = any(mi.has_flag(self.m_flags, kind) for kind in (mi.BSDFFlags.Glossy, mi.BSDFFlags.Delta))

        def _perturbed(self, si: Any, active: Any) -> Any:
            normal = mi.Normal3f(self.normal.eval_3(si, active)) * 2 - 1
            # An unbaked texel decodes to a vector of no use: the surface keeps its own normal there.
            usable = dr.squared_norm(normal) > 0.01
            if self.tangent:
                s, t, n = si.sh_frame.s, si.sh_frame.t, si.sh_frame.n
                across = t * dr.select(dr.dot(t, si.dp_dv) < 0, -1.0, 1.0)
                normal = mi.Normal3f(s * normal.x + across * normal.y + n * normal.z)
            normal = dr.normalize(dr.select(usable, normal, si.sh_frame.n))
            if self.glossy:
                normal = self._reflecting(si, normal)
            tangent = dr.normalize(si.sh_frame.s - normal * dr.dot(normal, si.sh_frame.s))
            bent = mi.SurfaceInteraction3f(si)
            bent.sh_frame = mi.Frame3f(tangent, dr.cross(normal, tangent), normal)
            bent.wi = bent.to_local(si.to_world(si.wi))
            if not self.glossy:  # a diffuse lobe knows no direction of view, but its two-sidedness does
                bent.wi.z = dr.select(si.wi.z < 0, -1.0, 1.0) * dr.maximum(dr.abs(bent.wi.z), LEAST_FACING)
            return bent

        def _reflecting(self, si: Any, normal: Any) -> Any:
            """``normal``, turned towards the geometric one until it mirrors the viewer above the surface.

            In the plane of both, at angle a from the geometric normal g, the view v (v_x, v_z) is mirrored to the
            height v_x sin 2a + v_z cos 2a = |v| cos(2a - atan2(v_x, v_z)): solved for Cycles' least height, which is
            min(0.9 v_z, 0.01). Without this, normals that face away would show the BSDF's back.
            """
            view = si.to_world(si.wi)
            side = dr.select(si.wi.z < 0, -1.0, 1.0)
            bent = normal * side
            up = si.n * dr.select(dr.dot(si.n, view) < 0, -1.0, 1.0)
            along = bent - up * dr.dot(bent, up)
            along = dr.normalize(dr.select(dr.squared_norm(along) > 1e-10, along, si.sh_frame.s))
            x, z = dr.dot(view, along), dr.dot(view, up)
            least = dr.minimum(0.9 * z, LEAST_HEIGHT)
            height = 2 * dr.dot(bent, view) * dr.dot(bent, up) - z
            length = dr.sqrt(x * x + z * z)
            angle = 0.5 * (dr.atan2(x, z) + dr.acos(dr.clip(least / dr.maximum(length, 1e-6), -1, 1)))
            turned = along * dr.sin(angle) + up * dr.cos(angle)
            return dr.select(height < least, turned, bent) * side

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

    mi.register_bsdf("dnr_normal", BentNormal)

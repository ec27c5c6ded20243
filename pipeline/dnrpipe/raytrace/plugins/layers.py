"""BSDF ``dnr_principled``: the reflecting layers of Blender's Principled BSDF, with Cycles' energy bookkeeping.

Notation
    wi, wo   directions of view and light, local; h their half vector; m = cos(wi)
    r        roughness, alpha = r^2 (GGX, height-correlated Smith term)
    E, S     albedo tables of `energy`, at (m, r); Eavg cosine-weighted mean of E over m
    Fss      cosine-weighted mean of a lobe's Fresnel term

Each lobe is scaled by 1 + Fms (1 - E) / E with Fms = Fss Eavg / (1 - Fss (1 - Eavg)): what single scattering loses
(Kulla and Conty 2017; Turquin 2019). Each layer leaves 1 - its albedo to what is below. Fresnel terms: dielectric,
f0 + (1 - f0) s(h) with f0 = F0 tint; metal, F82 (Kutz et al. 2021) of base colour and tint.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..lobes import mean_of
from . import energy
from .energy import look_up, row_of, table_of
from .nesting import evaluated_once, parameter

SHEEN_ROUGHNESS = (0.1, 0.3, 0.5, 0.7, 1.0)
SHEEN_COSINES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
SHEEN_ALBEDO = np.array(
    [
        [0.0900, 0.0042, 0.0002, 0.0001, 0.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.0000],
        [0.4500, 0.2451, 0.1166, 0.0513, 0.0221, 0.0097, 0.0047, 0.0024, 0.0013, 0.0009],
        [0.5300, 0.4286, 0.3172, 0.2254, 0.1552, 0.1042, 0.0697, 0.0457, 0.0296, 0.0201],
        [0.6000, 0.5333, 0.4539, 0.3787, 0.3115, 0.2535, 0.2061, 0.1660, 0.1323, 0.1081],
        [0.7000, 0.6466, 0.5949, 0.5452, 0.4995, 0.4586, 0.4234, 0.3927, 0.3659, 0.3452],
    ]
)
"""Albedo of Cycles' microfiber sheen by roughness and cosine, measured in a white furnace (Blender 5.0.1).

The first column, a sphere's last pixel, is extrapolated.
"""
EDGE = 1 / 7  # cosine of F82's second colour
MIN_ALPHA = energy.MIN_ALPHA


def sheen_albedo(roughness: float, cosine: np.ndarray) -> np.ndarray:
    """Albedo of microfiber sheen at ``cosine``, interpolated from the measured table."""
    row = np.array([np.interp(roughness, SHEEN_ROUGHNESS, column) for column in SHEEN_ALBEDO.T])
    return np.interp(cosine, SHEEN_COSINES, row)


def register(mi: Any) -> None:
    """``dnr_principled`` for the current variant."""
    import drjit as dr

    def albedo_tables(eta: float) -> Any:
        whole, share = energy.tables(eta)
        cosine = (np.arange(energy.COSINES) + 0.5) / energy.COSINES
        mean = (whole * cosine).sum(1, keepdims=True) / cosine.sum()
        return table_of(mi, [whole, share, np.broadcast_to(mean, whole.shape)])

    def ggx(alpha: Any, h: Any, wi: Any, wo: Any) -> tuple[Any, Any]:
        """(D G2 / (4 cos wi), density of wo when h is drawn from the visible normals); cos wo is included."""
        a2 = alpha * alpha
        d = a2 / (dr.pi * dr.square(dr.square(h.z) * (a2 - 1) + 1))
        lambda_i, lambda_o = smith(wi.z, a2), smith(wo.z, a2)
        whole = d / (4 * dr.maximum(wi.z, 1e-6))
        return whole / (1 + lambda_i + lambda_o), whole / (1 + lambda_i)

    def smith(cosine: Any, a2: Any) -> Any:
        c2 = dr.maximum(dr.square(cosine), 1e-12)
        return 0.5 * (dr.sqrt(1 + a2 * dr.maximum(1 - c2, 0) / c2) - 1)

    def visible_normal(wi: Any, alpha: Any, u: Any) -> Any:
        """GGX normal seen from wi, by spherical caps (Dupuy and Benyoub 2023)."""
        std = dr.normalize(mi.Vector3f(wi.x * alpha, wi.y * alpha, wi.z))
        phi = 2 * dr.pi * u.x
        z = (1 - u.y) * (1 + std.z) - std.z
        flat = dr.safe_sqrt(1 - z * z)
        h = mi.Vector3f(flat * dr.cos(phi), flat * dr.sin(phi), z) + std
        return dr.normalize(mi.Vector3f(h.x * alpha, h.y * alpha, dr.maximum(h.z, 1e-9)))

    def multiple(whole: Any, mean: Any, fss: Any) -> Any:
        """1 + Fms (1 - E) / E."""
        fms = fss * mean / (1 - fss * (1 - mean))
        return 1 + fms * (1 - whole) / dr.maximum(whole, 1e-3)

    def f0_of(eta: float) -> float:
        return ((eta - 1) / (eta + 1)) ** 2

    class Principled(evaluated_once(mi)):
        """Textures ``base_color``, ``specular_tint``, ``sheen_tint``, ``coat_tint`` (colours) and ``roughness``,
        ``metallic``, ``coat``, ``sheen`` (scalars in [0, 1]); numbers ``eta``, ``coat_eta`` (>= 1),
        ``coat_roughness``, ``sheen_roughness``. One-sided, reflection only.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            # What a material has none of, it does not hold: a replayed kernel looks through all of it at each call.
            has_coat, has_sheen = "coat" in props, "sheen" in props
            defaults = {"base_color": 0.8, "specular_tint": 1.0, "roughness": 0.5, "metallic": 0.0}
            defaults |= {"coat": 0.0, "coat_tint": 1.0} if has_coat else {}
            defaults |= {"sheen": 0.0, "sheen_tint": 1.0} if has_sheen else {}
            self.textures = {name: props.get_texture(name, value) for name, value in defaults.items()}
            eta = max(float(props.get("eta", 1.5)), 1.0001)
            coat_eta = max(float(props.get("coat_eta", 1.5)), 1.0001)
            coat_roughness = float(props.get("coat_roughness", 0.03))
            sheen_roughness = float(props.get("sheen_roughness", 0.5))
            self.table = albedo_tables(eta)
            self.coat_table = albedo_tables(coat_eta) if has_coat else None
            cosine = (np.arange(64) + 0.5) / 64
            albedo = sheen_albedo(sheen_roughness, cosine)[None]
            self.sheen_table = table_of(mi, [albedo] * 3) if has_sheen else None
            f0 = f0_of(eta)
            self.f0 = parameter(mi, f0)
            self.s_mean = parameter(mi, max((energy.average_fresnel(eta) - f0) / (1 - f0), 0.0))
            self.eta = parameter(mi, eta)
            if has_coat:
                self.coat_f0 = parameter(mi, f0_of(coat_eta))
                self.coat_fss = parameter(mi, energy.average_fresnel(coat_eta))
                self.coat_eta = parameter(mi, coat_eta)
                self.coat_roughness = parameter(mi, coat_roughness)
                self.coat_alpha = parameter(mi, max(coat_roughness**2, MIN_ALPHA))
            front = mi.BSDFFlags.FrontSide
            self.m_components = [
                int(mi.BSDFFlags.DiffuseReflection | front),
                int(mi.BSDFFlags.GlossyReflection | front),
            ]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def _layers(self, si: Any, active: Any) -> dict[str, Any]:
            """What depends on wi only: colours of the lobes and the odds of sampling them."""
            m = dr.clip(mi.Frame3f.cos_theta(si.wi), 1e-4, 1)
            base = dr.clip(self.textures["base_color"].eval(si, active), 0, 1)
            r = dr.clip(self.textures["roughness"].eval_1(si, active), 0, 1)
            metal = dr.clip(self.textures["metallic"].eval_1(si, active), 0, 1)
            tint = self.textures["specular_tint"].eval(si, active)
            found = look_up(mi, self.table, si, m, row_of(r), active)
            whole, share, mean = found[0], found[1], found[2]
            f0 = dr.clip(self.f0 * tint, 0, 1)
            boost = multiple(whole, mean, f0 + (1 - f0) * self.s_mean)
            reflected = (f0 * whole + (1 - f0) * share) * boost
            edge = (base + (1 - base) * (1 - EDGE) ** 5) * (1 - dr.clip(tint, 0, 1)) / (EDGE * (1 - EDGE) ** 6)
            metal_boost = multiple(whole, mean, dr.clip(base + (1 - base) / 21 - edge / 126, 0, 1))
            below = mi.Spectrum(1.0)
            sheen = coat = mi.Spectrum(0.0)
            coat_boost: Any = 1.0
            if self.sheen_table is not None:
                amount = (
                    self.textures["sheen"].eval_1(si, active) * look_up(mi, self.sheen_table, si, m, 0.5, active)[0]
                )
                sheen = self.textures["sheen_tint"].eval(si, active) * amount
                below = below * (1 - dr.clip(dr.max(sheen), 0, 1))
            if self.coat_table is not None:
                weight = dr.clip(self.textures["coat"].eval_1(si, active), 0, 1)
                got = look_up(mi, self.coat_table, si, m, row_of(self.coat_roughness), active)
                coat_boost = multiple(got[0], got[2], self.coat_fss)
                albedo = (self.coat_f0 * got[0] + (1 - self.coat_f0) * got[1]) * coat_boost * weight
                coat = below * weight * coat_boost
                inside = dr.safe_sqrt(1 - (1 - m * m) / self.coat_eta**2)
                colour = dr.clip(self.textures["coat_tint"].eval(si, active), 1e-4, 1)
                through: Any = dr.power(colour, 1 / dr.maximum(inside, 1e-3))
                passed = 1 + (through - 1) * weight
                below = below * (1 - dr.clip(albedo, 0, 1)) * passed
                coat_odds = albedo
            else:
                coat_odds = mi.Float(0.0)
            diffuse = below * base * (1 - metal) * (1 - dr.clip(dr.max(reflected), 0, 1)) + sheen
            glossy = mean_of(below * (metal * base * whole + (1 - metal) * reflected))
            odds = [mean_of(diffuse) + 1e-4, glossy + 1e-3, coat_odds]
            total = odds[0] + odds[1] + odds[2]
            return {
                "alpha": dr.maximum(r * r, MIN_ALPHA),
                "diffuse": diffuse,
                "dielectric": below * (1 - metal) * boost,
                "f0": f0,
                "metal": below * metal * metal_boost,
                "base": base,
                "edge": edge,
                "coat": coat,
                "odds": [part / total for part in odds],
            }

        def _wanted(self, ctx: Any, layers: dict[str, Any]) -> dict[str, Any]:
            """The layers without the lobes that ``ctx`` leaves out."""
            diffuse = ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
            glossy = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1)
            if diffuse and glossy:
                return layers
            odds, none = layers["odds"], mi.Spectrum(0.0)
            if diffuse:
                return layers | {"dielectric": none, "metal": none, "coat": none, "odds": [mi.Float(1), 0.0, 0.0]}
            if glossy:
                total = odds[1] + odds[2]
                return layers | {"diffuse": none, "odds": [mi.Float(0), odds[1] / total, odds[2] / total]}
            return layers | {"diffuse": none, "dielectric": none, "metal": none, "coat": none}

        def _value(self, layers: dict[str, Any], wi: Any, wo: Any) -> tuple[Any, Any]:
            """(BSDF times cos wo, density) for directions on the front."""
            h = dr.normalize(wi + wo)
            c = dr.clip(dr.dot(wi, h), 0, 1)
            lobe, density = ggx(layers["alpha"], h, wi, wo)
            s = dr.clip((mi.fresnel(c, self.eta)[0] - self.f0) / (1 - self.f0), 0, 1)
            f0, base, away = layers["f0"], layers["base"], 1 - c
            fifth = dr.square(dr.square(away)) * away
            metal = dr.clip(base + (1 - base) * fifth - layers["edge"] * c * fifth * away, 0, 1)
            value = layers["diffuse"] * (wo.z * dr.inv_pi)
            value += (layers["dielectric"] * (f0 + (1 - f0) * s) + layers["metal"] * metal) * lobe
            odds = layers["odds"]
            pdf = odds[0] * wo.z * dr.inv_pi + odds[1] * density
            if self.coat_table is not None:
                lobe, density = ggx(self.coat_alpha, h, wi, wo)
                value += layers["coat"] * mi.fresnel(c, self.coat_eta)[0] * lobe
                pdf += odds[2] * density
            return value, pdf

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            front = active & (si.wi.z > 0) & (wo.z > 0)
            value, pdf = self._value(self._wanted(ctx, self._layers(si, front)), si.wi, wo)
            return dr.select(front, value, 0), dr.select(front, pdf, 0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            front = active & (si.wi.z > 0)
            layers = self._wanted(ctx, self._layers(si, front))
            odds = layers["odds"]
            is_diffuse = sample1 < odds[0]
            alpha = layers["alpha"]
            if self.coat_table is not None:
                alpha = dr.select(sample1 >= odds[0] + odds[1], self.coat_alpha, alpha)
            h = visible_normal(si.wi, alpha, sample2)
            mirrored = 2 * dr.dot(si.wi, h) * h - si.wi
            wo = dr.select(is_diffuse, mi.warp.square_to_cosine_hemisphere(sample2), mirrored)
            value, pdf = self._value(layers, si.wi, wo)
            good = front & (wo.z > 0) & (pdf > 0)
            found = dr.zeros(mi.BSDFSample3f)
            found.wo, found.eta, found.pdf = wo, 1.0, dr.select(good, pdf, 0)
            kinds = int(mi.BSDFFlags.DiffuseReflection), int(mi.BSDFFlags.GlossyReflection)
            found.sampled_type = dr.select(is_diffuse, mi.UInt32(kinds[0]), mi.UInt32(kinds[1]))
            found.sampled_component = dr.select(is_diffuse, mi.UInt32(0), mi.UInt32(1))
            return found, dr.select(good, value / dr.maximum(pdf, 1e-30), 0)

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            return self.textures["base_color"].eval(si, active)

        def traverse(self, callback: Any) -> None:
            for name, texture in self.textures.items():
                callback.put(name, texture, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "dnr_principled[]"

    mi.register_bsdf("dnr_principled", Principled)

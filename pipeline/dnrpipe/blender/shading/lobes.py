"""Blender's reflecting shader nodes -> Mitsuba BSDFs: diffuse, glossy, metallic, translucent, and their kin."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..bundle import xmltree
from .algebra import is_smooth, squared
from .calibration import metal_gain
from .normals import NormalShaders
from .sockets import Scope, find_input
from .surface import CYCLES_DEFAULT_GREY, Surface
from .textures import Constant, Value, constant, scale

MAX_ANISOTROPY = 0.99
EUMELANIN, PHEOMELANIN = (0.506, 0.841, 1.653), (0.343, 0.733, 1.924)  # absorption, linear RGB
NO_REFLECTION = 1.0001  # index of refraction


class LobeShaders(NormalShaders):
    """One method per node that reflects light."""

    def _diffuse(self, node: Any, scope: Scope) -> Surface:
        if self._number(node, scope, 0.0, "Roughness") > 0:
            self.note("approximated", "diffuse roughness", "Oren-Nayar is taken as Lambert")
        return self._bent(self._diffuse_element(self._colour(node, scope, "Color")), node, scope)

    def _glossy(self, node: Any, scope: Scope) -> Surface:
        """Glossy BSDF -> ``conductor`` / ``roughconductor`` (no Fresnel, alpha = roughness squared).

        Anisotropy a: alpha_u = r^2 (1 - a), alpha_v = r^2 / (1 - a); for a < 0, r^2 / (1 + a) and r^2 (1 + a).
        """
        roughness = self._scalar(node, scope, "Roughness")
        anisotropy = self._number(node, scope, 0.0, "Anisotropy")
        colour = self._colour(node, scope, "Color")
        if is_smooth(roughness):
            element = xmltree.plugin("bsdf", "conductor")
        else:
            element = xmltree.plugin("bsdf", "roughconductor")
            xmltree.text(element, "distribution", "beckmann" if node.distribution == "BECKMANN" else "ggx")
            alpha = squared(roughness)
            if abs(anisotropy) < 1e-4:
                self._put(element, "alpha", alpha)
            else:
                along, across = stretch(anisotropy)
                self._put(element, "alpha_u", scale(alpha, along))
                self._put(element, "alpha_v", scale(alpha, across))
                self._note_tangent()
            if node.distribution == "ASHIKHMIN_SHIRLEY":
                self.note("approximated", "Ashikhmin-Shirley distribution", "GGX is used")
            if node.distribution == "MULTI_GGX":
                colour = scale(colour, metal_gain(np.clip(colour.mean, 0, 1), roughness.scalar))
        xmltree.text(element, "material", "none")
        self._put_colour(element, "specular_reflectance", colour)
        return self._bent(element, node, scope)

    def _note_tangent(self) -> None:
        """Mitsuba stretches along its UV's u; Blender along the Tangent input, or around the object's Z axis."""
        self.note("approximated", "anisotropy", "stretched along the UV layer's u instead of around the object's axis")

    def _metallic(self, node: Any, scope: Scope) -> Surface:
        """Metallic BSDF -> ``roughconductor`` of the node's own index and extinction (Physical Conductor), or
        ``dnr_principled`` of metallic 1, whose Fresnel term is F82 Tint too.
        """
        roughness = self._scalar(node, scope, "Roughness")
        if self._number(node, scope, 0.0, "Anisotropy") != 0:
            self.note("ignored", "anisotropy", "treated as isotropic")
        self._note_thin_film(node, scope)
        if getattr(node, "fresnel_type", "F82") != "PHYSICAL_CONDUCTOR":
            element = xmltree.plugin("bsdf", "dnr_principled")
            self._put_colour(element, "base_color", self._colour(node, scope, "Base Color"))
            self._put(element, "roughness", roughness)
            xmltree.number(element, "metallic", 1.0)
            self._put_colour(element, "specular_tint", self._colour(node, scope, "Edge Tint"))
            return self._bent(element, node, scope)
        smooth = is_smooth(roughness)
        element = xmltree.plugin("bsdf", "conductor" if smooth else "roughconductor")
        if not smooth:
            xmltree.text(element, "distribution", "ggx")
            self._put(element, "alpha", squared(roughness))
        index = self._colour(node, scope, "IOR").mean
        extinction = self._colour(node, scope, "Extinction").mean
        reflected = ((index - 1) ** 2 + extinction**2) / ((index + 1) ** 2 + extinction**2)
        gain = 1.0 if smooth else metal_gain(np.clip(reflected, 0, 1), roughness.scalar)
        xmltree.rgb(element, "eta", index)
        xmltree.rgb(element, "k", extinction)
        self._put_colour(element, "specular_reflectance", scale(constant(1.0), gain))
        return self._bent(element, node, scope)

    def _sheen(self, node: Any, scope: Scope) -> Surface:
        """Sheen BSDF -> ``dnr_principled`` of nothing but sheen."""
        if getattr(node, "distribution", "MICROFIBER") != "MICROFIBER":
            self.note("approximated", "Ashikhmin sheen", "the microfiber sheen of the same roughness")
        self.note("approximated", "sheen", "Cycles' albedo by angle of view, spread like diffuse light")
        element = xmltree.plugin("bsdf", "dnr_principled")
        xmltree.rgb(element, "base_color", (0.0, 0.0, 0.0))
        xmltree.number(element, "eta", NO_REFLECTION)
        xmltree.number(element, "sheen", 1.0)
        self._put_colour(element, "sheen_tint", self._colour(node, scope, "Color"))
        xmltree.number(element, "sheen_roughness", self._number(node, scope, 0.5, "Roughness", "Sigma"))
        return self._bent(element, node, scope)

    def _translucent(self, node: Any, scope: Scope) -> Surface:
        element = xmltree.plugin("bsdf", "dnr_translucent")
        self._put_colour(element, "color", self._colour(node, scope, "Color"))
        return self._bent(element, node, scope, both_sides=True)

    def _subsurface(self, node: Any, scope: Scope) -> Surface:
        self.note("approximated", "subsurface scattering", "treated as diffuse reflection of the colour")
        return self._bent(self._diffuse_element(self._colour(node, scope, "Color")), node, scope)

    def _hair(self, node: Any, scope: Scope) -> Surface:
        """Principled Hair BSDF -> ``diffuse`` of the colour that many fibres together have.

        Colour of an absorption coefficient s: exp(-sqrt(s) f), f a polynomial in the azimuthal roughness (Chiang et
        al. 2016, equation 9). Melanin m: s = -ln(1 - m) ((1 - redness) eumelanin + redness pheomelanin) (ibid.).
        """
        self.note("approximated", "Principled Hair BSDF", "diffuse reflection of the fibres' common colour")
        kind = getattr(node, "parametrization", "COLOR")
        if kind == "COLOR":
            return self._bent(self._diffuse_element(self._colour(node, scope, "Color")), node, scope)
        b = self._number(node, scope, 0.3, "Radial Roughness")
        shape = 5.969 - 0.215 * b + 2.532 * b**2 - 10.73 * b**3 + 5.574 * b**4 + 0.245 * b**5
        if kind == "MELANIN":
            amount = -math.log(max(1 - self._number(node, scope, 0.8, "Melanin"), 1e-4))
            redness = self._number(node, scope, 1.0, "Melanin Redness")
            absorption = amount * ((1 - redness) * np.array(EUMELANIN) + redness * np.array(PHEOMELANIN))
        else:
            absorption = np.asarray(self._colour(node, scope, "Absorption Coefficient").mean, dtype=np.float64)
        colour = np.exp(-np.sqrt(np.maximum(absorption, 0)) * shape)
        if kind == "MELANIN":
            colour = colour * self._colour(node, scope, "Tint").mean
        return self._bent(self._diffuse_element(constant(colour)), node, scope)

    def _holdout(self, node: Any, scope: Scope) -> Surface:
        """Holdout -> black: what it cuts from the alpha channel stays."""
        del node, scope
        self.note("approximated", "Holdout", "a black surface; it cuts no hole into alpha")
        return Surface(None)

    def _as_diffuse(self, node: Any, scope: Scope) -> Surface:
        """Any other shader: Lambert of its colour input, with a finding."""
        self.note("approximated", f"{node.bl_label} node", "treated as diffuse reflection of its colour")
        if find_input(node, "Color", "Base Color") is None:
            return Surface(self._diffuse_element(constant(CYCLES_DEFAULT_GREY)))
        return Surface(self._diffuse_element(self._colour(node, scope, "Color", "Base Color")))

    def _emission(self, node: Any, scope: Scope) -> Surface:
        """Emission -> area emitter, radiance = colour x strength, over black."""
        strength = self._scalar(node, scope, "Strength")
        return Surface(None, emission=self._radiance(self._colour(node, scope, "Color"), strength))

    def _radiance(self, colour: Value, strength: Value) -> Value | None:
        """Emission colour x strength, None when dark. An emitter knows no angle of view: averages are used."""
        colour, strength = self._flat(colour, "emission"), self._flat(strength, "emission")
        if isinstance(strength, Constant) and strength.scalar <= 0:
            return None
        if isinstance(colour, Constant) and not np.any(colour.mean > 0):
            return None
        if isinstance(strength, Constant):
            return scale(colour, strength.scalar)
        if isinstance(colour, Constant):
            return strength.map(lambda texels: texels * colour.mean)
        return self.share(colour, strength)


def stretch(anisotropy: float) -> tuple[float, float]:
    """Factors on alpha along u and v for the Glossy BSDF's anisotropy in (-1, 1)."""
    a = min(max(anisotropy, -MAX_ANISOTROPY), MAX_ANISOTROPY)
    return (1 / (1 + a), 1 + a) if a < 0 else (1 - a, 1 / (1 - a))

"""Principled BSDF -> ``dnr_principled``, or ``dielectric`` where it is nothing but clear glass."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any

import numpy as np

from ..bundle import xmltree
from .algebra import equals, is_white, square_root
from .calibration import diffuse_gain, eta_of, metal_gain, normal_reflectance
from .interfaces import MIN_ETA, InterfaceShaders
from .lobes import LobeShaders
from .sockets import Scope, find_input, resolve
from .surface import Surface
from .textures import Constant, Textured, Value, constant, scale


class PrincipledShader(LobeShaders, InterfaceShaders):
    """The Principled BSDF, and the material without nodes, which is one."""

    def _principled(self, node: Any, scope: Scope) -> Surface:
        base = self._colour(node, scope, "Base Color")
        roughness = self._scalar(node, scope, "Roughness")
        metallic = self._scalar(node, scope, "Metallic")
        transmission = self._scalar(node, scope, "Transmission Weight", "Transmission")
        ior = self._number(node, scope, 1.45, "IOR")
        level = self._number(node, scope, 0.5, "Specular IOR Level", "Specular")
        self._principled_notes(node, scope)
        f0 = normal_reflectance(ior, level)
        if equals(transmission, 0.0):
            surface = self._bent(self._opaque(node, scope, base, roughness, metallic, f0), node, scope)
        elif equals(metallic, 0.0):
            index = MIN_ETA if abs(ior - 1) < 1e-4 else ior
            element = self._interface(constant(1.0), square_root(base), index, roughness, node.distribution)
            if self._is_layered(node, scope):
                self.note("approximated", "coat or sheen on a clear material", "on its opaque part only")
            if not equals(transmission, 1.0):
                blend = xmltree.plugin("bsdf", "blendbsdf")
                self._put(blend, "weight", transmission)
                blend.append(Surface(self._opaque(node, scope, base, roughness, metallic, f0)).sided())
                blend.append(element)
                element = blend
            surface = self._bent(element, node, scope, both_sides=True)
        else:
            self.note("approximated", "metal that transmits", "Disney's mix of metal and glass")
            element = self._native(base, roughness, metallic, transmission, f0)
            xmltree.number(element, "eta", max(ior, MIN_ETA))
            surface = self._bent(element, node, scope, both_sides=True)
        opacity = self._scalar(node, scope, "Alpha")
        plain = isinstance(opacity, Constant)
        surface.opacity = constant(min(max(opacity.scalar, 0.0), 1.0)) if plain else opacity
        strength = self._scalar(node, scope, "Emission Strength")
        emission = self._radiance(self._colour(node, scope, "Emission Color", "Emission"), strength)
        surface.emission = self.share(emission, surface.opacity)
        return surface

    def _opaque(self, node: Any, scope: Scope, base: Value, roughness: Value, metallic: Value, f0: float) -> ET.Element:
        """The Principled BSDF without transmission; ``principled`` only where it is anisotropic."""
        if f0 < 1e-5 and equals(metallic, 0.0) and not self._is_layered(node, scope):
            # Cycles' diffuse lobe is Lambert's; Disney's is up to 4% off in energy and 5% at grazing angles.
            return self._diffuse_element(base)
        anisotropic = self._scalar(node, scope, "Anisotropic")
        if equals(anisotropic, 0.0):
            # Disney's diffuse lobe is 1-2% too bright, which many bounces multiply (4% in the demo scene); its metal
            # loses what scatters more than once (20% at roughness 0.6). Ours costs 4% more time.
            return self._layered(node, scope, base, roughness, metallic, f0)
        element = self._native(base, roughness, metallic, constant(0.0), f0)
        if f0 < 1e-5:
            xmltree.number(element, "specular", 0.0)
        else:
            xmltree.number(element, "eta", max(eta_of(f0), MIN_ETA))
        # Both stretch alpha by sqrt(1 - 0.9 a).
        self._put(element, "anisotropic", anisotropic)
        self._note_tangent()
        self._coat_and_sheen(element, node, scope)
        return element

    def _native(self, base: Value, roughness: Value, metallic: Value, transmission: Value, f0: float) -> ET.Element:
        """``principled`` whose base colour makes up for the energy in which it differs from Cycles, on average."""
        element = xmltree.plugin("bsdf", "principled")
        weight = metallic.scalar
        clear = (1 - weight) * transmission.scalar
        plain = (1 - weight) * (1 - transmission.scalar)
        gain = (
            weight * metal_gain(np.clip(base.mean, 0, 1), roughness.scalar)
            + clear
            + plain * diffuse_gain(f0, roughness.scalar)
        )
        self._put_colour(element, "base_color", scale(base, gain))
        self._put(element, "roughness", roughness)
        self._put_positive(element, "metallic", metallic)
        self._put_positive(element, "spec_trans", transmission)
        return element

    def _put_positive(self, element: ET.Element, name: str, value: Value) -> None:
        if not equals(value, 0.0):
            self._put(element, name, value)

    def _is_layered(self, node: Any, scope: Scope) -> bool:
        return any(
            not equals(self._scalar(node, scope, *names), 0.0)
            for names in (("Coat Weight", "Clearcoat"), ("Sheen Weight", "Sheen"))
        )

    def _principled_notes(self, node: Any, scope: Scope) -> None:
        if self._number(node, scope, 0.0, "Subsurface Weight", "Subsurface") > 0:
            self.note("approximated", "subsurface scattering", "treated as diffuse reflection of the base colour")
        if self._number(node, scope, 0.0, "Diffuse Roughness") > 0:
            self.note("approximated", "diffuse roughness", "the target's own retro-reflection is used")
        self._note_thin_film(node, scope)

    def _put_tint(self, element: ET.Element, name: str, node: Any, scope: Scope, socket_name: str) -> None:
        """Write a tint that is not white; sockets of older versions that hold a number mean none."""
        socket = find_input(node, socket_name)
        if socket is not None and socket.type == "RGBA" and not is_white(tint := self.values.colour(socket, scope)):
            self._put_colour(element, name, tint)

    def _layered(
        self, node: Any, scope: Scope, base: Value, roughness: Value, metallic: Value, f0: float
    ) -> ET.Element:
        """``dnr_principled``: sheen over coat over metal and dielectric, energies as in Cycles."""
        element = xmltree.plugin("bsdf", "dnr_principled")
        self._put_colour(element, "base_color", base)
        self._put(element, "roughness", roughness)
        self._put_positive(element, "metallic", metallic)
        xmltree.number(element, "eta", max(eta_of(f0), MIN_ETA))
        self._put_tint(element, "specular_tint", node, scope, "Specular Tint")
        coat = self._scalar(node, scope, "Coat Weight", "Clearcoat")
        if not equals(coat, 0.0):
            self._put(element, "coat", coat)
            xmltree.number(element, "coat_eta", max(self._number(node, scope, 1.5, "Coat IOR"), MIN_ETA))
            own = self._number(node, scope, 0.03, "Coat Roughness", "Clearcoat Roughness")
            xmltree.number(element, "coat_roughness", own)
            self._put_tint(element, "coat_tint", node, scope, "Coat Tint")
            normal = find_input(node, "Coat Normal", "Clearcoat Normal")
            if normal is not None and resolve(normal, scope).linked:
                self.note("approximated", "coat normal", "the coat has the normal of what it covers")
        sheen = self._scalar(node, scope, "Sheen Weight", "Sheen")
        if not equals(sheen, 0.0):
            self._put(element, "sheen", sheen)
            xmltree.number(element, "sheen_roughness", self._number(node, scope, 0.5, "Sheen Roughness"))
            self._put_tint(element, "sheen_tint", node, scope, "Sheen Tint")
            self.note("approximated", "sheen", "Cycles' albedo by angle of view, spread like diffuse light")
        return element

    def _coat_and_sheen(self, element: ET.Element, node: Any, scope: Scope) -> None:
        """Coat and sheen of an anisotropic material -> ``clearcoat``, ``sheen``, of other lobes."""
        coat = self._scalar(node, scope, "Coat Weight", "Clearcoat")
        if not equals(coat, 0.0):
            self._put(element, "clearcoat", coat)
            gloss = self._scalar(node, scope, "Coat Roughness", "Clearcoat Roughness")
            gloss = gloss.map(lambda x: 1 - x) if isinstance(gloss, Textured) else constant(1 - gloss.scalar)
            self._put(element, "clearcoat_gloss", gloss)
            self.note("approximated", "coat", "Disney clearcoat: weaker and of another lobe")
        sheen = self._scalar(node, scope, "Sheen Weight", "Sheen")
        if not equals(sheen, 0.0):
            self._put(element, "sheen", sheen)
            self.note("approximated", "sheen", "Disney sheen: roughness and tint are not converted")
        tint = find_input(node, "Specular Tint")
        if tint is not None and tint.type == "RGBA" and not is_white(self.values.colour(tint, scope)):
            self.note("ignored", "specular tint", "reflections stay untinted")

    def _viewport_material(self) -> Surface:
        """A material without nodes: Blender renders its viewport colour, roughness and metallic."""
        element = xmltree.plugin("bsdf", "dnr_principled")
        material = self.blender
        self._put_colour(element, "base_color", constant(material.diffuse_color))
        xmltree.number(element, "roughness", material.roughness)
        if material.metallic > 0:
            xmltree.number(element, "metallic", material.metallic)
        xmltree.number(element, "eta", 1.5)
        return Surface(element)

"""Blender's shader nodes -> Mitsuba BSDFs, one function per node.

Calibration: shared/FACTS.md, re-measured in :mod:`.principled`. Whatever is not converted exactly is recorded
as a finding with the material's name.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from . import xmltree
from .algebra import SMOOTH, below, complement, equals, square_root, squared, weaken
from .principled import diffuse_gain, eta_of, metal_gain, normal_reflectance
from .shader_base import ShaderBase
from .sockets import Scope, Source, find_input, resolve, surface_source
from .textures import Constant, Textured, Value, constant, scale

MIN_ETA = 1.0001
CYCLES_DEFAULT_GREY = (0.8, 0.8, 0.8)
"""Colour of a surface without material in Cycles."""


@dataclass
class Surface:
    """A shader: BSDF element (None: nothing there), emission (radiance), opacity, and whether light passes."""

    bsdf: ET.Element | None
    transmissive: bool = False
    emission: Value | None = None
    opacity: Value = field(default_factory=lambda: constant(1.0))


class ShaderWalker(ShaderBase):
    """Walks the shader tree of one material."""

    def material(self) -> Surface:
        """The whole material: surface, and notes on volume and displacement."""
        tree = self.blender.node_tree
        if tree is None:
            return self._viewport_material()
        source = surface_source(tree)
        if surface_source(tree, "Volume") is not None:
            self.note("ignored", "volume", "volumes are not converted; the inside is empty")
        if surface_source(tree, "Displacement") is not None:
            self.note("ignored", "displacement", "not converted; the surface stays as modelled")
        if source is None:
            self.note("exact", "no surface shader", "renders black, as in Cycles")
            return Surface(self._diffuse_element(constant(0.0)))
        return self.shader(source)

    # ------------------------------------------------------------ dispatch

    def shader(self, source: Source) -> Surface:
        """Convert the shader that ends in ``source``."""
        handlers = {
            "BSDF_PRINCIPLED": self._principled,
            "BSDF_DIFFUSE": self._diffuse,
            "BSDF_GLOSSY": self._glossy,
            "BSDF_ANISOTROPIC": self._glossy,
            "BSDF_METALLIC": self._metallic,
            "BSDF_GLASS": self._glass,
            "BSDF_REFRACTION": self._refraction,
            "BSDF_TRANSPARENT": self._transparent,
            "BSDF_TRANSLUCENT": self._translucent,
            "EMISSION": self._emission,
            "MIX_SHADER": self._mix,
            "ADD_SHADER": self._add,
        }
        handler = handlers.get(source.node.type)
        if handler is not None:
            return handler(source.node, source.scope)
        return self._as_diffuse(source.node, source.scope)

    def _input(self, node: Any, scope: Scope, index: int) -> Surface:
        """The shader in the ``index``-th shader socket; nothing linked is black."""
        sockets = [socket for socket in node.inputs if socket.type == "SHADER"]
        source = resolve(sockets[index], scope)
        return self.shader(source) if source.linked else Surface(self._diffuse_element(constant(0.0)))

    # ------------------------------------------------------------ leaves

    def _principled(self, node: Any, scope: Scope) -> Surface:
        """Principled BSDF -> ``principled``, or ``dielectric`` where it is nothing but clear glass."""
        base = self._colour(node, scope, "Base Color")
        roughness = self._scalar(node, scope, "Roughness")
        metallic = self._scalar(node, scope, "Metallic")
        transmission = self._scalar(node, scope, "Transmission Weight", "Transmission")
        ior = self._number(node, scope, 1.45, "IOR")
        level = self._number(node, scope, 0.5, "Specular IOR Level", "Specular")
        self._principled_notes(node, scope)
        f0 = normal_reflectance(ior, level)
        surface = Surface(None)
        if equals(transmission, 1.0) and equals(metallic, 0.0) and below(roughness, SMOOTH):
            surface = self._interface(square_root(base), ior, transmission_only=True)
        else:
            element = xmltree.plugin("bsdf", "principled")
            weight = metallic.scalar
            clear = (1 - weight) * transmission.scalar
            plain = (1 - weight) * (1 - transmission.scalar)
            gain = (
                weight * metal_gain(np.clip(base.mean, 0, 1), roughness.scalar)
                + clear
                + plain * diffuse_gain(f0, roughness.scalar)
            )
            if weight > 0.01 and roughness.scalar > 0.3:
                self.note("approximated", "rough metal", "multiple scattering is made up for in the base colour's mean")
            self._put_colour(element, "base_color", scale(base, gain))
            self._put(element, "roughness", roughness)
            if not equals(metallic, 0.0):
                self._put(element, "metallic", metallic)
            if not equals(transmission, 0.0):
                self._put(element, "spec_trans", transmission)
                xmltree.number(element, "eta", max(ior, MIN_ETA))
            elif f0 < 1e-5:
                xmltree.number(element, "specular", 0.0)
            else:
                xmltree.number(element, "eta", max(eta_of(f0), MIN_ETA))
            self._coat_and_sheen(element, node, scope)
            surface = Surface(element, transmissive=not equals(transmission, 0.0))
        surface.bsdf = self._with_normal(surface.bsdf, node, scope)
        surface.opacity = self._scalar(node, scope, "Alpha")
        strength = self._scalar(node, scope, "Emission Strength")
        emission = self._colour(node, scope, "Emission Color", "Emission")
        surface.emission = self._radiance(emission, strength)
        return surface

    def _principled_notes(self, node: Any, scope: Scope) -> None:
        subsurface = self._number(node, scope, 0.0, "Subsurface Weight", "Subsurface")
        if subsurface > 0:
            self.note("approximated", "subsurface scattering", "treated as diffuse reflection of the base colour")
        if self._number(node, scope, 0.0, "Anisotropic") != 0:
            self.note("ignored", "anisotropy", "treated as isotropic")
        if self._number(node, scope, 0.0, "Diffuse Roughness") > 0:
            self.note("approximated", "diffuse roughness", "the target's own retro-reflection is used")
        if self._number(node, scope, 0.0, "Thin Film Thickness") > 0:
            self.note("ignored", "thin film", "no interference colours")
        tint = find_input(node, "Specular Tint")
        if tint is not None and tint.type == "RGBA":
            value = self.values.colour(tint, scope)
            if not np.allclose(value.mean, 1.0, atol=1e-3):
                self.note("ignored", "specular tint", "reflections of dielectrics stay untinted")

    def _coat_and_sheen(self, element: ET.Element, node: Any, scope: Scope) -> None:
        """Coat -> clearcoat (gloss = 1 - coat roughness); sheen -> sheen. Both differ in lobe shape."""
        coat = self._scalar(node, scope, "Coat Weight", "Clearcoat")
        if not equals(coat, 0.0):
            self._put(element, "clearcoat", coat)
            gloss = self._scalar(node, scope, "Coat Roughness", "Clearcoat Roughness")
            gloss = gloss.map(lambda x: 1 - x) if isinstance(gloss, Textured) else constant(1 - gloss.scalar)
            self._put(element, "clearcoat_gloss", gloss)
            self.note("approximated", "coat", "Disney clearcoat: weaker and of another lobe (relative RMSE 0.2)")
        sheen = self._scalar(node, scope, "Sheen Weight", "Sheen")
        if not equals(sheen, 0.0):
            self._put(element, "sheen", sheen)
            self.note("approximated", "sheen", "Disney sheen: roughness and tint are not converted")

    def _diffuse(self, node: Any, scope: Scope) -> Surface:
        """Diffuse BSDF -> ``diffuse``."""
        if self._number(node, scope, 0.0, "Roughness") > 0:
            self.note("approximated", "diffuse roughness", "Oren-Nayar is taken as Lambert")
        element = self._diffuse_element(self._colour(node, scope, "Color"))
        return Surface(self._with_normal(element, node, scope))

    def _glossy(self, node: Any, scope: Scope) -> Surface:
        """Glossy BSDF -> ``conductor`` / ``roughconductor`` (no Fresnel, alpha = roughness squared)."""
        if self._number(node, scope, 0.0, "Anisotropy") != 0:
            self.note("ignored", "anisotropy", "treated as isotropic")
        roughness = self._scalar(node, scope, "Roughness")
        colour = self._colour(node, scope, "Color")
        if below(roughness, SMOOTH):
            element = xmltree.plugin("bsdf", "conductor")
        else:
            element = xmltree.plugin("bsdf", "roughconductor")
            xmltree.text(element, "distribution", "ggx")
            self._put(element, "alpha", squared(roughness))
            if node.distribution == "MULTI_GGX":
                colour = scale(colour, metal_gain(np.clip(colour.mean, 0, 1), roughness.scalar))
        xmltree.text(element, "material", "none")
        self._put_colour(element, "specular_reflectance", colour)
        return Surface(self._with_normal(element, node, scope))

    def _metallic(self, node: Any, scope: Scope) -> Surface:
        """Metallic BSDF -> ``principled`` metal of its base colour (edge tint is left out)."""
        roughness = self._scalar(node, scope, "Roughness")
        base = self._colour(node, scope, "Base Color")
        self.note("approximated", "Metallic BSDF", "Schlick Fresnel of the base colour; edge tint is left out")
        element = xmltree.plugin("bsdf", "principled")
        self._put_colour(element, "base_color", scale(base, metal_gain(np.clip(base.mean, 0, 1), roughness.scalar)))
        self._put(element, "roughness", roughness)
        xmltree.number(element, "metallic", 1.0)
        return Surface(self._with_normal(element, node, scope))

    def _glass(self, node: Any, scope: Scope) -> Surface:
        """Glass BSDF -> ``(rough)dielectric``, colour on both lobes, alpha = roughness squared."""
        colour = self._colour(node, scope, "Color")
        ior = self._number(node, scope, 1.45, "IOR")
        roughness = self._scalar(node, scope, "Roughness")
        surface = self._interface(colour, ior, roughness=roughness)
        surface.bsdf = self._with_normal(surface.bsdf, node, scope)
        return surface

    def _refraction(self, node: Any, scope: Scope) -> Surface:
        """Refraction BSDF -> dielectric without reflection."""
        self.note("approximated", "Refraction BSDF", "light that Fresnel would reflect is lost")
        colour = self._colour(node, scope, "Color")
        ior = self._number(node, scope, 1.45, "IOR")
        surface = self._interface(colour, ior, roughness=self._scalar(node, scope, "Roughness"), reflect=False)
        surface.bsdf = self._with_normal(surface.bsdf, node, scope)
        return surface

    def _interface(
        self,
        tint: Value,
        ior: float,
        *,
        roughness: Value | None = None,
        transmission_only: bool = False,
        reflect: bool = True,
    ) -> Surface:
        """Smooth or rough dielectric interface; ``tint`` on transmission and, unless told so, on reflection."""
        if abs(ior - 1) < 1e-4:
            ior = MIN_ETA
        if roughness is None or below(roughness, SMOOTH):
            element = xmltree.plugin("bsdf", "dielectric")
        else:
            element = xmltree.plugin("bsdf", "roughdielectric")
            xmltree.text(element, "distribution", "ggx")
            self._put(element, "alpha", squared(roughness))
        xmltree.number(element, "int_ior", ior)
        xmltree.number(element, "ext_ior", 1.0)
        self._put_colour(element, "specular_transmittance", tint)
        reflected: Value = constant(0.0) if not reflect else (constant(1.0) if transmission_only else tint)
        self._put_colour(element, "specular_reflectance", reflected)
        return Surface(element, transmissive=True)

    def _transparent(self, node: Any, scope: Scope) -> Surface:
        """Transparent BSDF -> opacity 0; a tint becomes partial opacity over black."""
        colour = self._colour(node, scope, "Color")
        if isinstance(colour, Constant) and np.allclose(colour.mean, 1.0, atol=1e-3):
            return Surface(None, opacity=constant(0.0))
        self.note("approximated", "tinted transparency", "passes light untinted, weakened by the tint's luminance")
        opacity = (
            colour.grey().map(lambda x: 1 - np.clip(x, 0, 1))
            if isinstance(colour, Textured)
            else constant(1 - min(max(colour.scalar, 0.0), 1.0))
        )
        return Surface(self._diffuse_element(constant(0.0)), opacity=opacity)

    def _translucent(self, node: Any, scope: Scope) -> Surface:
        """Translucent BSDF -> ``principledthin`` with all diffuse light transmitted."""
        self.note("approximated", "Translucent BSDF", "thin sheet with diffuse transmission only")
        element = xmltree.plugin("bsdf", "principledthin")
        self._put_colour(element, "base_color", self._colour(node, scope, "Color"))
        xmltree.number(element, "roughness", 1.0)
        xmltree.number(element, "eta", 1.01)
        xmltree.number(element, "diff_trans", 2.0)
        return Surface(self._with_normal(element, node, scope), transmissive=True)

    def _emission(self, node: Any, scope: Scope) -> Surface:
        """Emission -> area emitter, radiance = colour x strength, over black."""
        strength = self._scalar(node, scope, "Strength")
        radiance = self._radiance(self._colour(node, scope, "Color"), strength)
        return Surface(self._diffuse_element(constant(0.0)), emission=radiance)

    def _as_diffuse(self, node: Any, scope: Scope) -> Surface:
        """Any other shader: Lambert of its colour input, with a finding."""
        self.note("approximated", f"{node.bl_label} node", "treated as diffuse reflection of its colour")
        if find_input(node, "Color", "Base Color") is None:
            return Surface(self._diffuse_element(constant(CYCLES_DEFAULT_GREY)))
        return Surface(self._diffuse_element(self._colour(node, scope, "Color", "Base Color")))

    def _viewport_material(self) -> Surface:
        """A material without nodes: Blender renders its viewport colour, roughness and metallic."""
        element = xmltree.plugin("bsdf", "principled")
        material = self.blender
        base, roughness, metallic = constant(material.diffuse_color), material.roughness, material.metallic
        gain = metallic * metal_gain(np.clip(base.mean, 0, 1), roughness) + (1 - metallic) * diffuse_gain(
            0.04, roughness
        )
        self._put_colour(element, "base_color", scale(base, gain))
        xmltree.number(element, "roughness", roughness)
        xmltree.number(element, "metallic", metallic)
        xmltree.number(element, "eta", 1.5)
        return Surface(element)

    # ------------------------------------------------------------ combinations

    def _mix(self, node: Any, scope: Scope) -> Surface:
        """Mix Shader -> ``blendbsdf`` (weight of the second), or opacity where one side is Transparent."""
        factor = self._scalar(node, scope, "Fac", "Factor")
        if isinstance(factor, Constant):
            factor = constant(min(max(factor.scalar, 0.0), 1.0))
            if equals(factor, 0.0):
                return self._input(node, scope, 0)
            if equals(factor, 1.0):
                return self._input(node, scope, 1)
        first, second = self._input(node, scope, 0), self._input(node, scope, 1)
        other = complement(factor)
        emission = self.sum(self.share(first.emission, other), self.share(second.emission, factor))
        opacity = self.sum(self.share(first.opacity, other), self.share(second.opacity, factor))
        assert opacity is not None
        if first.bsdf is None or second.bsdf is None:
            kept = second if first.bsdf is None else first
            return replace(kept, emission=emission, opacity=opacity)
        if not (equals(first.opacity, 1.0) and equals(second.opacity, 1.0)):
            self.note("approximated", "Mix Shader of partly transparent shaders", "opacities are averaged")
        element = xmltree.plugin("bsdf", "blendbsdf")
        self._put(element, "weight", factor)
        # Inside a blend each opaque part has two sides of its own when the other lets light through.
        mixed = first.transmissive != second.transmissive
        for part in (first, second):
            assert part.bsdf is not None
            element.append(twosided(part.bsdf) if mixed and not part.transmissive else part.bsdf)
        return Surface(element, first.transmissive or second.transmissive, emission, opacity)

    def _add(self, node: Any, scope: Scope) -> Surface:
        """Add Shader: emission plus a shader exactly; two scattering shaders as an even blend."""
        first, second = self._input(node, scope, 0), self._input(node, scope, 1)
        emission = self.sum(first.emission, second.emission)
        if _is_dark(first) or _is_dark(second):
            kept = second if _is_dark(first) else first
            return replace(kept, emission=emission)
        self.note("approximated", "Add Shader", "two scattering shaders become an even blend: darker")
        element = xmltree.plugin("bsdf", "blendbsdf")
        xmltree.number(element, "weight", 0.5)
        for part in (first, second):
            assert part.bsdf is not None
            element.append(part.bsdf)
        return Surface(element, first.transmissive or second.transmissive, emission)

    def _radiance(self, colour: Value, strength: Value) -> Value | None:
        """Emission colour x strength, None when dark."""
        if equals(strength, 0.0) or (isinstance(colour, Constant) and not np.any(colour.mean > 0)):
            return None
        if isinstance(strength, Constant):
            return scale(colour, strength.scalar)
        if isinstance(colour, Constant):
            return strength.map(lambda texels: texels * colour.mean)
        return self.share(colour, strength)

    # ------------------------------------------------------------ normals

    def _with_normal(self, bsdf: ET.Element | None, node: Any, scope: Scope) -> ET.Element | None:
        """Normal Map node (tangent space) -> ``normalmap``; any other normal input is a finding."""
        socket = find_input(node, "Normal")
        if socket is None or bsdf is None:
            return bsdf
        source = resolve(socket, scope)
        if not source.linked:
            return bsdf
        if source.node.type == "BUMP":
            self.note("ignored", "Bump node", "not converted; the surface is smooth")
            source = resolve(find_input(source.node, "Normal"), source.scope)
            if not source.linked:
                return bsdf
        return self._normal_mapped(bsdf, source)

    def _normal_mapped(self, bsdf: ET.Element, source: Source) -> ET.Element:
        """Normal Map node -> ``normalmap``; anything else is a finding."""
        normal = source.node
        if normal.type != "NORMAL_MAP" or normal.space != "TANGENT":
            self.note("ignored", f"normal from {normal.bl_label} node", "not converted")
            return bsdf
        strength = self.values.number(find_input(normal, "Strength"), source.scope)
        value = self.values.colour(find_input(normal, "Color"), source.scope)
        if isinstance(value, Constant):
            return bsdf  # a flat normal
        if strength != 1.0:
            value = value.map(lambda texels: weaken(texels, strength))
        element = xmltree.plugin("bsdf", "normalmap")
        element.append(self._texture(value, "normalmap", "normal", raw=True))
        element.append(bsdf)
        return element

    def finish(self, surface: Surface) -> ET.Element:
        """Two-sided where opaque, ``mask`` where alpha is below 1, ``null`` where nothing is left."""
        if surface.bsdf is None:
            return xmltree.plugin("bsdf", "null")
        bsdf = surface.bsdf if surface.transmissive else twosided(surface.bsdf)
        if equals(surface.opacity, 1.0):
            return bsdf
        element = xmltree.plugin("bsdf", "mask")
        self._put(element, "opacity", surface.opacity)
        element.append(bsdf)
        return element


def _is_dark(surface: Surface) -> bool:
    """Only emission: no BSDF, or the black one that stands below it."""
    if surface.bsdf is None:
        return True
    reflectance = surface.bsdf.find("rgb[@name='reflectance']")
    return reflectance is not None and set(reflectance.get("value", "").split()) == {"0"}


def default_grey() -> ET.Element:
    """What Cycles shows where there is no material."""
    element = xmltree.plugin("bsdf", "diffuse")
    xmltree.rgb(element, "reflectance", CYCLES_DEFAULT_GREY)
    return element


def twosided(bsdf: ET.Element) -> ET.Element:
    """``bsdf`` on both sides of the surface, as Blender's opaque shaders are."""
    element = xmltree.plugin("bsdf", "twosided")
    element.append(bsdf)
    return element

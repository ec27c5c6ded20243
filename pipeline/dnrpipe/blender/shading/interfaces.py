"""Blender's transmitting shader nodes -> Mitsuba BSDFs: glass, refraction, transparency."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any

import numpy as np

from ..bundle import xmltree
from .algebra import is_smooth, squared
from .normals import NormalShaders
from .sockets import Scope
from .surface import Surface
from .textures import Value, constant

MIN_ETA = 1.0001


class InterfaceShaders(NormalShaders):
    """One method per node that lets light through."""

    def _glass(self, node: Any, scope: Scope) -> Surface:
        """Glass BSDF -> ``(rough)dielectric``, colour on both lobes, alpha = roughness squared."""
        colour = self._colour(node, scope, "Color")
        roughness = self._scalar(node, scope, "Roughness")
        element = self._interface(colour, colour, self._index(node, scope), roughness, node.distribution)
        self._note_thin_film(node, scope)
        return self._bent(element, node, scope, both_sides=True)

    def _refraction(self, node: Any, scope: Scope) -> Surface:
        """Refraction BSDF -> ``dnr_refraction`` over a dielectric: transmission alone, nothing lost to Fresnel."""
        colour = self._colour(node, scope, "Color")
        index = self._index(node, scope)
        roughness = self._scalar(node, scope, "Roughness")
        element = xmltree.plugin("bsdf", "dnr_refraction")
        xmltree.number(element, "eta", index)
        element.append(self._interface(constant(1.0), colour, index, roughness, node.distribution))
        return self._bent(element, node, scope, both_sides=True)

    def _index(self, node: Any, scope: Scope) -> float:
        """Index of refraction, kept away from 1, where nothing would refract."""
        ior = self._number(node, scope, 1.45, "IOR")
        return MIN_ETA if abs(ior - 1) < 1e-4 else max(ior, 1e-3)

    def _interface(
        self, reflected: Value, transmitted: Value, index: float, roughness: Value, distribution: str
    ) -> ET.Element:
        """Smooth or rough dielectric interface with a tint on each lobe.

        distribution: of the microfacets, as Blender names them; MULTI_GGX keeps what one scattering loses.
        """
        smooth = is_smooth(roughness)
        if smooth:
            element = xmltree.plugin("bsdf", "dielectric")
        else:
            element = xmltree.plugin("bsdf", "roughdielectric")
            xmltree.text(element, "distribution", "beckmann" if distribution == "BECKMANN" else "ggx")
            self._put(element, "alpha", squared(roughness))
        xmltree.number(element, "int_ior", index)
        xmltree.number(element, "ext_ior", 1.0)
        self._put_colour(element, "specular_transmittance", transmitted)
        self._put_colour(element, "specular_reflectance", reflected)
        if smooth or distribution != "MULTI_GGX":
            return element
        whole = xmltree.plugin("bsdf", "dnr_interface")
        xmltree.number(whole, "eta", index)
        self._put(whole, "roughness", roughness)
        whole.append(element)
        return whole

    def _transparent(self, node: Any, scope: Scope) -> Surface:
        """Transparent BSDF -> nothing that scatters, opacity 0; its colour tints what passes."""
        colour = self._colour(node, scope, "Color")
        if np.allclose(colour.mean, 0.0, atol=1e-4):
            return Surface(None)
        return Surface(None, opacity=constant(0.0), tint=colour)

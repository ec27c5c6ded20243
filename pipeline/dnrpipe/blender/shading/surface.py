"""A converted shader before it becomes one element of the scene file. No bpy here."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field

from ..bundle import xmltree
from .textures import Value, constant

CYCLES_DEFAULT_GREY = (0.8, 0.8, 0.8)
"""Colour of a surface without material in Cycles."""


@dataclass
class Surface:
    """A shader: light it scatters, emits, and lets pass straight on.

    A share ``opacity`` of the light meets ``bsdf``; the rest passes, times ``tint``.
    """

    bsdf: ET.Element | None
    """What scatters; None where nothing does: the opaque share is absorbed."""
    both_sides: bool = False
    """``bsdf`` acts on both sides by itself (it transmits, or is two-sided already)."""
    emission: Value | None = None
    """Radiance, linear; None when dark."""
    opacity: Value = field(default_factory=lambda: constant(1.0))
    tint: Value = field(default_factory=lambda: constant(1.0))

    def sided(self) -> ET.Element:
        """The BSDF for both sides of the surface, as all of Blender's shaders are; black where there is none."""
        if self.bsdf is None:
            return twosided(diffuse((0.0, 0.0, 0.0)))
        return self.bsdf if self.both_sides else twosided(self.bsdf)


def diffuse(colour: tuple[float, float, float]) -> ET.Element:
    """Lambertian reflection of a linear colour."""
    element = xmltree.plugin("bsdf", "diffuse")
    xmltree.rgb(element, "reflectance", colour)
    return element


def twosided(bsdf: ET.Element) -> ET.Element:
    """``bsdf`` on both sides of the surface, as Blender's opaque shaders are."""
    element = xmltree.plugin("bsdf", "twosided")
    element.append(bsdf)
    return element

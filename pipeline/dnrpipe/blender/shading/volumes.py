"""Volume shader nodes of a mesh -> one ``homogeneous`` medium inside it.

Notation (coefficients per scene unit, linear RGB)
    a, s    absorption and scattering coefficient; extinction t = a + s, albedo s / t
    g       mean cosine of the scattering angle
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..bundle import xmltree
from .base import ShaderBase
from .sockets import Scope, Source, find_input, resolve
from .textures import Textured

VARYING = {"ATTRIBUTE", "VOLUME_INFO"}
"""Nodes that read a volume grid: only a grid gives them a value."""


@dataclass(frozen=True)
class Coefficients:
    """Homogeneous medium: absorption a, scattering s, [3] each; g; emitted radiance per unit length [3]."""

    absorption: np.ndarray = field(default_factory=lambda: np.zeros(3))
    scattering: np.ndarray = field(default_factory=lambda: np.zeros(3))
    g: float = 0.0
    emission: float = 0.0
    rayleigh: bool = False


class VolumeShaders(ShaderBase):
    """One method per volume node."""

    def medium(self, source: Source | None) -> ET.Element | None:
        """``homogeneous`` medium (without id) of what is linked to the output's Volume socket; None where empty."""
        if source is None:
            return None
        found = self._volume(source)
        extinction = found.absorption + found.scattering
        if found.emission > 0:
            self.note("ignored", "volume emission", "the medium does not glow")
        if not np.any(extinction > 1e-9):
            return None
        strongest = float(extinction.max())
        element = xmltree.plugin("medium", "homogeneous")
        xmltree.rgb(element, "sigma_t", extinction / strongest)
        xmltree.number(element, "scale", strongest)
        xmltree.rgb(element, "albedo", found.scattering / np.maximum(extinction, 1e-9))
        phase = xmltree.plugin("phase", "rayleigh" if found.rayleigh else "hg")
        if not found.rayleigh:
            xmltree.number(phase, "g", min(max(found.g, -0.99), 0.99))
        element.append(phase)
        self.note("exact", "volume", "a homogeneous medium, as long as volumes do not overlap")
        return element

    def _volume(self, source: Source) -> Coefficients:
        handlers = {
            "VOLUME_ABSORPTION": self._absorption,
            "VOLUME_SCATTER": self._scatter,
            "PRINCIPLED_VOLUME": self._principled_volume,
            "VOLUME_COEFFICIENTS": self._volume_coefficients,
            "ADD_SHADER": self._add_volumes,
            "MIX_SHADER": self._mix_volumes,
        }
        handler = handlers.get(source.node.type)
        if handler is not None:
            return handler(source.node, source.scope)
        self.note("ignored", f"{source.node.bl_label} node as a volume", "the inside is empty")
        return Coefficients()

    def _density(self, node: Any, scope: Scope) -> float:
        """Density per scene unit. A texture or a grid that varies in space is a finding."""
        socket = find_input(node, "Density")
        if socket is None:
            return 1.0
        source = resolve(socket, scope)
        if source.linked and source.node.type in VARYING:
            self.note("approximated", "volume density from a grid", "a mesh has no grid: density 1")
            return 1.0
        return max(self._mean(node, scope, "Density")[0], 0.0)

    def _mean(self, node: Any, scope: Scope, *names: str) -> np.ndarray:
        """Mean of an input, [3]; a texture is a finding."""
        value = self._colour(node, scope, *names)
        if isinstance(value, Textured):
            self.note("approximated", f"volume with a textured {names[0].lower()}", "the mean is used")
        return np.maximum(np.asarray(value.mean, dtype=np.float64), 0.0)

    def _phase(self, node: Any, scope: Scope) -> tuple[float, bool]:
        """(g, Rayleigh?) of the node's phase function; forms other than these and Henyey-Greenstein are a finding."""
        phase = getattr(node, "phase", "HENYEY_GREENSTEIN")
        if phase == "RAYLEIGH":
            return 0.0, True
        if phase != "HENYEY_GREENSTEIN":
            self.note("approximated", f"{phase.replace('_', ' ').lower()} phase function", "Henyey-Greenstein")
        return self._number(node, scope, 0.0, "Anisotropy"), False

    def _absorption(self, node: Any, scope: Scope) -> Coefficients:
        """Volume Absorption: a = density (1 - colour)."""
        colour = np.minimum(self._mean(node, scope, "Color"), 1.0)
        return Coefficients(self._density(node, scope) * (1 - colour))

    def _scatter(self, node: Any, scope: Scope) -> Coefficients:
        """Volume Scatter: s = density colour; nothing is absorbed."""
        g, rayleigh = self._phase(node, scope)
        scattering = self._density(node, scope) * self._mean(node, scope, "Color")
        return Coefficients(scattering=scattering, g=g, rayleigh=rayleigh)

    def _principled_volume(self, node: Any, scope: Scope) -> Coefficients:
        """Principled Volume: s = density colour, a = density (1 - colour)(1 - sqrt(absorption colour))."""
        density = self._density(node, scope)
        colour = self._mean(node, scope, "Color")
        kept = np.sqrt(self._mean(node, scope, "Absorption Color"))
        absorption = density * np.maximum(1 - colour, 0) * np.maximum(1 - kept, 0)
        glow = ("Emission Strength", "Blackbody Intensity")
        emission = sum(self._number(node, scope, 0.0, name) for name in glow)
        return Coefficients(absorption, density * colour, self._number(node, scope, 0.0, "Anisotropy"), emission)

    def _volume_coefficients(self, node: Any, scope: Scope) -> Coefficients:
        g, rayleigh = self._phase(node, scope)
        absorption = self._mean(node, scope, "Absorption Coefficients")
        scattering = self._mean(node, scope, "Scatter Coefficients")
        emission = float(self._mean(node, scope, "Emission Coefficients").max())
        return Coefficients(absorption, scattering, g, emission, rayleigh)

    def _parts(self, node: Any, scope: Scope) -> list[Coefficients]:
        sockets = [socket for socket in node.inputs if socket.type == "SHADER"]
        sources = [resolve(socket, scope) for socket in sockets]
        return [self._volume(source) if source.linked else Coefficients() for source in sources]

    def _add_volumes(self, node: Any, scope: Scope) -> Coefficients:
        """Add Shader of volumes: coefficients add up; g is their mean, weighted by scattering."""
        return _sum(self._parts(node, scope), (1.0, 1.0))

    def _mix_volumes(self, node: Any, scope: Scope) -> Coefficients:
        factor = min(max(self._number(node, scope, 0.5, "Fac", "Factor"), 0.0), 1.0)
        return _sum(self._parts(node, scope), (1 - factor, factor))


def _sum(parts: list[Coefficients], weights: tuple[float, float]) -> Coefficients:
    shares = [weight * float(part.scattering.mean()) for part, weight in zip(parts, weights, strict=True)]
    whole = sum(shares)
    return Coefficients(
        sum((w * part.absorption for part, w in zip(parts, weights, strict=True)), np.zeros(3)),
        sum((w * part.scattering for part, w in zip(parts, weights, strict=True)), np.zeros(3)),
        sum(s * part.g for part, s in zip(parts, shares, strict=True)) / whole if whole > 0 else 0.0,
        sum(w * part.emission for part, w in zip(parts, weights, strict=True)),
        all(part.rayleigh for part, s in zip(parts, shares, strict=True) if s > 0) and whole > 0,
    )

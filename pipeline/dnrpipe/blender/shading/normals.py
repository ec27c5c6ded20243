"""Normal inputs of shader nodes: Normal Map and Bump -> ``bumpmap``, ``dnr_normal``."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import Any

import numpy as np

from ..bundle import xmltree
from .algebra import weaken
from .base import ShaderBase
from .sockets import Scope, Source, find_input, resolve
from .surface import Surface
from .textures import Constant, Textured, Value
from .view_dependent import average, is_view_dependent


class NormalShaders(ShaderBase):
    """Wraps BSDFs in what bends their shading normal."""

    def _bent(self, bsdf: ET.Element, node: Any, scope: Scope, *, both_sides: bool = False) -> Surface:
        socket = find_input(node, "Normal")
        surface = Surface(bsdf, both_sides)
        return surface if socket is None else self._by(socket, scope, surface)

    def _by(self, socket: Any, scope: Scope, surface: Surface) -> Surface:
        """``surface`` under the normal that ``socket`` receives.

        Images are used as they are, anything else is baked. The BSDF is made two-sided first: seen from behind, its
        normal turns over with it, as in Cycles.
        """
        source = resolve(socket, scope)
        if not source.linked:
            return surface
        node = source.node
        bent = None
        if node.type == "BUMP":
            bent = self._bumped(node, source.scope, surface)
        elif node.type == "NORMAL_MAP" and node.space == "TANGENT":
            bent = self._normal_mapped(node, source.scope, surface)
        return bent or self._baked(socket, scope, surface)

    def _normal_mapped(self, node: Any, scope: Scope, surface: Surface) -> Surface | None:
        """Normal Map node in tangent space -> ``dnr_normal``; strength s: n' = normalise(z + s (n - z)).

        None where its colour is no plain image.
        """
        value = self.values.plain(find_input(node, "Color"), scope)
        if value is None or is_view_dependent(value):
            return None
        if isinstance(value, Constant):
            return surface  # a flat normal
        strength = self.values.number(find_input(node, "Strength"), scope)
        if strength != 1.0:
            value = value.map(lambda texels: weaken(texels, strength))
        element = xmltree.plugin("bsdf", "dnr_normal")
        xmltree.text(element, "space", "tangent")
        element.append(self._texture(value, "normalmap", "normal", raw=True))
        element.append(surface.sided())
        return Surface(element, both_sides=True)

    def _bumped(self, node: Any, scope: Scope, surface: Surface) -> Surface | None:
        """Bump node -> ``bumpmap`` of its height image, scale = strength x distance in scene units.

        None where its height is no plain image.
        """
        socket = find_input(node, "Height")
        height = self.values.plain(socket, scope)
        if height is None or is_view_dependent(height):
            return None
        surface = self._by(find_input(node, "Normal"), scope, surface)
        strength = min(max(self.values.number(find_input(node, "Strength"), scope), 0.0), 1.0)
        distance = self.values.number(find_input(node, "Distance"), scope) * (-1 if node.invert else 1)
        if isinstance(height, Constant) or strength * distance == 0:
            return surface
        if strength < 1:
            self.note("approximated", "Bump strength", "scales the height; Cycles blends the normals")
        return replace(surface, bsdf=self._bump_element(height, strength * distance, surface), both_sides=True)

    def _bump_element(self, height: Textured, distance: float, surface: Surface) -> ET.Element:
        element = xmltree.plugin("bsdf", "bumpmap")
        element.append(self._texture(height.grey(), "texture", "bump", raw=True))
        xmltree.number(element, "scale", distance)
        element.append(surface.sided())
        return element

    def _displaced(self, source: Source | None, surface: Surface) -> Surface:
        """Displacement output: its bump (Cycles' default method) -> ``bumpmap`` over the whole surface.

        The geometry stays as modelled: displacement proper, and heights that are no plain image, are findings.
        """
        if source is None:
            return surface
        if self.blender.displacement_method != "BUMP":
            self.note("approximated", "true displacement", "shades the surface; its shape stays as modelled")
        node, scope = source.node, source.scope
        height = self.values.plain(find_input(node, "Height"), scope) if node.type == "DISPLACEMENT" else None
        if isinstance(height, Constant):
            return surface
        if height is None or is_view_dependent(height):
            self.note("ignored", "displacement", f"{node.bl_label} node: its height is no image; nothing is displaced")
            return surface
        if surface.bsdf is None:
            return surface
        distance = self.values.number(find_input(node, "Scale"), scope)
        return replace(surface, bsdf=self._bump_element(height, distance, surface), both_sides=True)

    def _baked(self, socket: Any, scope: Scope, surface: Surface) -> Surface:
        """Any other normal -> ``dnr_normal`` of its baked world-space normals."""
        baked = self.values.normal(socket, scope)
        if baked is None:
            label = resolve(socket, scope).node.bl_label
            self.note("ignored", f"{label} node", "not converted; the surface is smooth")
            return surface
        element = xmltree.plugin("bsdf", "dnr_normal")
        element.append(self._texture(baked, "normal", "normal", raw=True))
        element.append(surface.sided())
        return Surface(element, both_sides=True)

    def _flat(self, value: Value, what: str) -> Value:
        """``value`` without dependence on the angle of view, with a finding where it had one."""
        if not is_view_dependent(value):
            return value
        mean = average(value)
        self.note("approximated", f"view-dependent {what}", f"its mean {np.round(mean.mean, 3).tolist()} is used")
        return mean

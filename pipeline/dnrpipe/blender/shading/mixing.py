"""Mix Shader and Add Shader -> ``blendbsdf``, ``dnr_add``, and shares of opacity, tint and emission."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from ..bundle import xmltree
from .algebra import complement, equals, is_white
from .base import ShaderBase
from .sockets import Scope, resolve
from .surface import Surface
from .textures import Constant, Value, constant
from .view_dependent import average, is_view_dependent


class MixShaders(ShaderBase, ABC):
    """Combinations of shaders."""

    @abstractmethod
    def shader(self, source: Any) -> Surface:
        """Convert the shader that ends in ``source``; the walker says how."""

    def _input(self, node: Any, scope: Scope, index: int) -> Surface:
        """The shader in the ``index``-th shader socket; nothing linked is black."""
        sockets = [socket for socket in node.inputs if socket.type == "SHADER"]
        source = resolve(sockets[index], scope)
        return self.shader(source) if source.linked else Surface(None)

    def _mix(self, node: Any, scope: Scope) -> Surface:
        """Mix Shader, factor f -> ``blendbsdf`` of weight f.

        With opacities a, b and tints s, t of its sides: opacity (1 - f) a + f b, tint ((1 - f)(1 - a) s + f (1 - b) t)
        / (1 - opacity), and the blend's weight becomes f b / opacity.
        """
        factor = self._scalar(node, scope, "Fac", "Factor")
        if isinstance(factor, Constant):
            factor = constant(min(max(factor.scalar, 0.0), 1.0))
            if equals(factor, 0.0):
                return self._input(node, scope, 0)
            if equals(factor, 1.0):
                return self._input(node, scope, 1)
        if _same_twice(node, scope):
            return self._input(node, scope, 0)
        first, second = self._input(node, scope, 0), self._input(node, scope, 1)
        other = complement(factor)
        opacity = self.sum(self.share(first.opacity, other), self.share(second.opacity, factor))
        assert opacity is not None
        result = Surface(None, emission=self._mixed_emission(first, second, factor), opacity=opacity)
        result.tint = self._mixed_tint(first, second, factor)
        if equals(first.opacity, 0.0) or equals(second.opacity, 0.0):
            kept = second if equals(first.opacity, 0.0) else first
            result.bsdf, result.both_sides = kept.bsdf, kept.both_sides
        elif first.bsdf is not None or second.bsdf is not None:
            element = xmltree.plugin("bsdf", "blendbsdf")
            self._put(element, "weight", self._blend_weight(first, second, factor))
            element.append(first.sided())
            element.append(second.sided())
            result.bsdf, result.both_sides = element, True
        return result

    def _mixed_emission(self, first: Surface, second: Surface, factor: Value) -> Value | None:
        if first.emission is None and second.emission is None:
            return None
        if is_view_dependent(factor):
            self.note("approximated", "emission mixed by the angle of view", "the factor's mean is used")
            factor = average(factor)
        return self.sum(self.share(first.emission, complement(factor)), self.share(second.emission, factor))

    def _mixed_tint(self, first: Surface, second: Surface, factor: Value) -> Value:
        if equals(first.opacity, 1.0):
            return second.tint
        if equals(second.opacity, 1.0):
            return first.tint
        if not (isinstance(first.tint, Constant) and isinstance(second.tint, Constant)):
            self.note("approximated", "mix of two tinted transparent shaders", "mean tints are used")
        share = average(factor).scalar
        passed = (1 - share) * (1 - average(first.opacity).scalar), share * (1 - average(second.opacity).scalar)
        whole = max(sum(passed), 1e-6)
        return constant((first.tint.mean * passed[0] + second.tint.mean * passed[1]) / whole)

    def _blend_weight(self, first: Surface, second: Surface, factor: Value) -> Value:
        if equals(first.opacity, 1.0) and equals(second.opacity, 1.0):
            return factor
        parts = first.opacity, second.opacity, factor
        if all(isinstance(part, Constant) for part in parts):
            a, b, f = (part.scalar for part in parts)
            return constant(f * b / max((1 - f) * a + f * b, 1e-6))
        self.note("approximated", "Mix Shader of partly transparent shaders", "opacities are averaged")
        return factor

    def _add(self, node: Any, scope: Scope) -> Surface:
        """Add Shader: emissions add up; two that scatter or transmit become ``dnr_add``."""
        first, second = self._input(node, scope, 0), self._input(node, scope, 1)
        emission = self.sum(first.emission, second.emission)
        for part, other in ((first, second), (second, first)):
            if part.bsdf is None and equals(part.opacity, 1.0):  # it only emits
                return Surface(other.bsdf, other.both_sides, emission, other.opacity, other.tint)
        element = xmltree.plugin("bsdf", "dnr_add")
        element.append(self.finish(first))
        element.append(self.finish(second))
        opacity = constant(1.0)
        if not (equals(first.opacity, 1.0) and equals(second.opacity, 1.0)):
            self.note("exact", "Add Shader with transparency", "light passes; the alpha channel counts it as opaque")
        return Surface(element, True, emission, opacity)

    def finish(self, surface: Surface) -> Any:
        """One element for the surface without its emission.

        Two-sided where opaque, ``mask`` where opacity is below 1, ``dnr_transparent`` where what passes is tinted,
        ``null`` where nothing is left.
        """
        if equals(surface.opacity, 1.0):
            return surface.sided()
        tinted = not is_white(surface.tint)
        empty = equals(surface.opacity, 0.0)
        if empty and not tinted:
            return xmltree.plugin("bsdf", "null")
        element = xmltree.plugin("bsdf", "dnr_transparent" if tinted else "mask")
        if tinted:
            self._put_colour(element, "transmittance", surface.tint)
        if not empty:
            self._put(element, "opacity", surface.opacity)
            element.append(surface.sided())
        return element


def _same_twice(node: Any, scope: Scope) -> bool:
    """Whether both shader inputs receive the same shader: converted once, where many such nodes follow each other."""
    sources = [resolve(socket, scope) for socket in node.inputs if socket.type == "SHADER"]
    places = {(source.socket.as_pointer(), tuple(group.as_pointer() for group in source.scope)) for source in sources}
    return len(places) == 1 and sources[0].linked

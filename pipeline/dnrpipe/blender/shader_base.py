"""What all shader conversions share: reading a node's inputs, and writing values into Mitsuba elements."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any

import bpy
import numpy as np

from . import xmltree
from .algebra import product, total
from .findings import Findings
from .sockets import Scope, find_input
from .textures import Constant, ImageReader, Placement, Textured, TextureStore, Value, constant
from .values import Evaluator


class ShaderBase:
    """Inputs and outputs of one material's shader tree.

    uv: UV layer of the images written so far (None: the active one). textured: whether any was written.
    """

    def __init__(self, material: Any, store: TextureStore, images: ImageReader, findings: Findings) -> None:
        self.blender = material
        self.store = store
        self.values = Evaluator(material.name, images, findings, self._vertex_colour)
        self.uv: str | None = None
        self.textured = False

    def note(self, kind: Any, feature: str, text: str) -> None:
        """Record a finding for this material."""
        self.values.note(kind, feature, text)

    def share(self, value: Value | None, factor: Value) -> Value | None:
        """``value`` times ``factor``; see :func:`.algebra.product`."""
        return product(value, factor, lambda feature, text: self.note("approximated", feature, text))

    def sum(self, a: Value | None, b: Value | None) -> Value | None:
        """``a`` + ``b``; see :func:`.algebra.total`."""
        return total(a, b, lambda feature, text: self.note("approximated", feature, text))

    def _diffuse_element(self, colour: Value) -> ET.Element:
        element = xmltree.plugin("bsdf", "diffuse")
        self._put_colour(element, "reflectance", colour)
        return element

    def _colour(self, node: Any, scope: Scope, *names: str) -> Value:
        socket = find_input(node, *names)
        return constant(0.0) if socket is None else self.values.colour(socket, scope)

    def _scalar(self, node: Any, scope: Scope, *names: str) -> Value:
        socket = find_input(node, *names)
        if socket is None:
            return constant(1.0 if names[0] == "Alpha" else 0.0)
        return self.values.scalar(socket, scope)

    def _number(self, node: Any, scope: Scope, default: float, *names: str) -> float:
        socket = find_input(node, *names)
        return default if socket is None else self.values.number(socket, scope)

    def _put(self, element: ET.Element, name: str, value: Value) -> None:
        """A scalar parameter in [0, 1]."""
        if isinstance(value, Textured):
            clipped = value if value.texels.dtype == np.uint8 else value.map(lambda x: np.clip(x, 0, 1))
            element.append(self._texture(clipped.grey(), name, name, raw=True))
        else:
            xmltree.number(element, name, min(max(value.scalar, 0.0), 1.0))

    def _put_colour(self, element: ET.Element, name: str, value: Value) -> None:
        """A reflectance; constants above 1 (compensated metals) go through a texel, which is not range-checked."""
        if isinstance(value, Constant) and value.mean.max() > 1:
            texel = np.maximum(value.mean, 0).reshape(1, 1, 3)
            value = Textured(texel, False, Placement())
        if isinstance(value, Textured):
            element.append(self._texture(value, name, name, raw=False))
        else:
            xmltree.rgb(element, name, np.clip(value.mean, 0, 1))

    def _texture(self, value: Textured, name: str, label: str, *, raw: bool) -> ET.Element:
        """Bitmap element; a texture on a second UV layer becomes its mean, since a shape has one."""
        layer = value.placement.uv
        if value.texels.shape[:2] != (1, 1):  # a single texel looks the same under any coordinates
            if not self.textured:
                self.uv, self.textured = layer, True
            elif layer != self.uv:
                self.note(
                    "approximated",
                    f"image on a second UV layer ('{layer or 'active'}')",
                    f"a shape has one UV layer ('{self.uv or 'active'}'): the image's mean is used",
                )
                mean = value.linear().mean(axis=(0, 1), keepdims=True)
                value = Textured(mean.astype(np.float32), False, Placement())
        return self.store.element(value, name, f"{self.blender.name}-{label}", raw=raw)

    def _vertex_colour(self, name: str) -> tuple[float, float, float] | None:
        """Mean of a colour attribute over the meshes that use this material."""
        means = []
        for mesh in bpy.data.meshes:
            if self.blender.name not in {m.name for m in mesh.materials if m}:
                continue
            attribute = mesh.color_attributes.get(name) if name else mesh.color_attributes.active_color
            if attribute is None or not len(attribute.data):
                continue
            values = np.empty(len(attribute.data) * 4, dtype=np.float32)
            attribute.data.foreach_get("color", values)
            means.append(values.reshape(-1, 4)[:, :3].mean(axis=0))
        if not means:
            return None
        r, g, b = np.mean(means, axis=0)
        return float(r), float(g), float(b)

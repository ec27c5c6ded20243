"""Blender materials -> top-level BSDFs and area emitters of the bundle."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import xmltree
from .findings import Findings
from .shaders import ShaderWalker, default_grey, twosided
from .textures import ImageReader, Textured, TextureStore, Value


@dataclass
class Converted:
    """A material ready for the scene file.

    bsdf: top-level element with id. emission: radiance or None. uv: UV layer its images use (None: active).
    textured: whether any image is in use.
    """

    id: str
    bsdf: ET.Element
    emission: Value | None
    uv: str | None
    textured: bool
    name: str | None


class MaterialConverter:
    """Converts materials once each; textures go through one store."""

    def __init__(self, store: TextureStore, images: ImageReader, findings: Findings) -> None:
        self.store = store
        self.images = images
        self.findings = findings
        self.ids = xmltree.Ids()
        self._done: dict[str | None, Converted] = {}

    def convert(self, material: Any | None) -> Converted:
        """The material's BSDF and emission; None is Cycles' default grey."""
        key = None if material is None else material.name_full
        if key not in self._done:
            self._done[key] = self._convert(material)
        return self._done[key]

    def _convert(self, material: Any | None) -> Converted:
        identity = self.ids.take("mat", "default" if material is None else material.name)
        if material is None:
            return Converted(identity, _with_id(twosided(default_grey()), identity), None, None, False, None)
        walker = ShaderWalker(material, self.store, self.images, self.findings)
        surface = walker.material()
        bsdf = _with_id(walker.finish(surface), identity)
        textured = walker.textured or isinstance(surface.emission, Textured)
        return Converted(identity, bsdf, surface.emission, walker.uv, textured, material.name)

    def emitter(self, converted: Converted) -> ET.Element | None:
        """Area emitter of an emissive material: radiance = emission colour x strength."""
        emission = converted.emission
        if emission is None:
            return None
        element = xmltree.plugin("emitter", "area")
        if isinstance(emission, Textured):
            element.append(
                self.store.element(emission, "radiance", f"{converted.name}-emission", raw=not emission.srgb)
            )
        else:
            xmltree.rgb(element, "radiance", np.maximum(emission.mean, 0))
        return element


def _with_id(element: ET.Element, identity: str) -> ET.Element:
    element.set("id", identity)
    return element

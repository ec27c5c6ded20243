"""Blender materials -> top-level BSDFs and area emitters of the bundle."""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..baking.cache import BakeCache
from ..bundle import xmltree
from ..findings import Findings
from .shaders import ShaderWalker
from .sheets import AtlasSheets
from .surface import CYCLES_DEFAULT_GREY, diffuse, twosided
from .textures import ImageReader, Placement, Textured, TextureStore, Value, constant
from .view_dependent import average

DEEPEST = 50_000  # calls


@dataclass
class Converted:
    """A material ready for the scene file.

    bsdf: top-level element with id. emission: radiance or None. uv: UV layer of the shape's own coordinates (None:
    each mesh's active one; ATLAS_LAYER: the scene atlas). textured: whether anything needs coordinates.
    layers: further UV layers; the k-th, from 1, is PLY attribute ``uv{k}`` ('' is the active one).
    colors: colour attributes, names in ``FrozenMesh.colors``; the k-th, from 0, is PLY attribute ``color{k}``.
    opacity: 1 = opaque; textures are plain images. medium: what fills a mesh of this material, with an id, or None.
    """

    id: str
    bsdf: ET.Element
    emission: Value | None
    uv: str | None
    textured: bool
    name: str | None
    layers: tuple[str, ...] = ()
    colors: tuple[str, ...] = ()
    opacity: Value = field(default_factory=lambda: constant(1.0))
    medium: ET.Element | None = None


class MaterialConverter:
    """Converts materials once each; textures go through one store.

    bakes: where baked values come from and where missing ones are listed; None: averages instead of bakes.
    """

    def __init__(
        self, store: TextureStore, images: ImageReader, findings: Findings, bakes: BakeCache | None = None
    ) -> None:
        self.store = store
        self.images = images
        self.findings = findings
        self.bakes = bakes
        self.sheets = None if bakes is None else AtlasSheets(bakes.atlas)
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
            bsdf = twosided(diffuse(CYCLES_DEFAULT_GREY))
            bsdf.set("id", identity)
            return Converted(identity, bsdf, None, None, False, None)
        # A node takes up to five calls, and trees made by scripts are hundreds deep. They use no C stack.
        sys.setrecursionlimit(max(sys.getrecursionlimit(), DEEPEST))
        walker = ShaderWalker(material, self.store, self.images, self.findings, self.bakes, self.sheets)
        surface = walker.material()
        bsdf = walker.finish(surface)
        bsdf.set("id", identity)
        emission = self._image(walker, self._sampleable(walker, surface.emission))
        own, layers = walker.settle(emission)
        textured = walker.textured or isinstance(emission, Textured)
        opacity = self._image(walker, average(surface.opacity)) or constant(1.0)
        medium = walker.inside()
        if medium is not None:
            medium.set("id", self.ids.take("medium", material.name))
        return Converted(
            identity, bsdf, emission, own, textured, material.name_full, layers, tuple(walker.colors), opacity, medium
        )

    def _sampleable(self, walker: ShaderWalker, emission: Value | None) -> Value | None:
        """An emission whose texture Mitsuba's ``area`` can pick points by.

        It picks a texel and looks for *the* surface point there, without ``to_uv``: where the UVs are mapped,
        overlap or leave the unit square, light would be lost, so the texture moves to the scene atlas.
        """
        if not isinstance(emission, Textured) or not emission.placement.plain or self.bakes is None:
            return emission
        place, name = emission.placement, walker.blender.name_full
        if place.to_uv == Placement().to_uv and self.bakes.atlas.is_unfolded(name, place.uv):
            return emission
        note = f"its UVs overlap or repeat: resampled into the atlas of {self.bakes.atlas.size}² texels, to be sampled"
        walker.note("baked", "textured emission", note)
        return walker.values.flat(emission)

    def _image(self, walker: ShaderWalker, value: Value | None) -> Value | None:
        """``value``, as an image of its own where it is textured: what lies at corners or in a region is spread out."""
        if not isinstance(value, Textured) or value.placement.plain or self.bakes is None:
            return value
        return self.bakes.image(walker.values.flat(value))

    def baked_size(self) -> int | None:
        """Side of the atlas that values were baked into, in texels; None when nothing was."""
        bakes = self.bakes
        return bakes.atlas.size if bakes is not None and (bakes.used or bakes.used_atlas) else None

    def sheets_elements(self) -> list[ET.Element]:
        """The shared textures of all materials converted so far; they belong before the materials."""
        return [] if self.sheets is None else self.sheets.elements(self.store)

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

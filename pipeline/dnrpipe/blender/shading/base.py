"""What all shader conversions share: reading a node's inputs, and writing values into Mitsuba elements."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ..baking.cache import BakeCache
from ..bundle import xmltree
from ..findings import Findings
from ..geometry.corner_colours import as_attribute
from ..geometry.frozen import ATLAS_LAYER
from . import view_dependent
from .algebra import product, total
from .sheets import AtlasSheets
from .sockets import Scope, find_input
from .textures import Constant, ImageReader, Placement, Textured, TextureStore, Value, constant
from .values import Evaluator

TANGENT_MAPS = {"normalmap", "texture"}
"""Parameters of ``dnr_normal`` (tangent space) and ``bumpmap``, which use the tangents of the shape's own UV layer."""
ACTIVE = ""
"""Stands in `Converted.layers` for each mesh's own active UV layer."""


@dataclass(frozen=True)
class _Lookup:
    """A texture element that was written, the UV layer it needs (None: the active one), and its parameter."""

    element: ET.Element
    layer: str | None
    name: str


class ShaderBase:
    """Inputs and outputs of one material's shader tree.

    textured: whether anything was written that needs UV coordinates. colors: names of the colour attributes that
    ``mesh_attribute`` textures read, in the order of their PLY attributes.
    """

    def __init__(
        self,
        material: Any,
        store: TextureStore,
        images: ImageReader,
        findings: Findings,
        bakes: BakeCache | None = None,
        sheets: AtlasSheets | None = None,
    ) -> None:
        self.blender = material
        self.store = store
        self.sheets = sheets
        self.bakes = bakes
        self.values = Evaluator(material.name_full, images, findings, bakes)
        self.note = self.values.note
        self.colors: list[str] = []
        self._lookups: list[_Lookup] = []

    @property
    def textured(self) -> bool:
        return bool(self._lookups)

    def share(self, value: Value | None, factor: Value) -> Value | None:
        """``value`` times ``factor``; see `algebra.product`."""
        value, weight = self._alike(value, factor)
        assert weight is not None
        return product(value, weight, partial(self.note, "approximated"))

    def sum(self, a: Value | None, b: Value | None) -> Value | None:
        """``a`` + ``b``; see `algebra.total`."""
        a, b = self._alike(a, b)
        return total(a, b, partial(self.note, "approximated"))

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

    def _note_thin_film(self, node: Any, scope: Scope) -> None:
        if self._number(node, scope, 0.0, "Thin Film Thickness") > 0:
            self.note("ignored", "thin film", "no interference colours")

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

    def _alike(self, a: Value | None, b: Value | None) -> tuple[Value | None, Value | None]:
        """Two textures that do not lie alike, both taken to the material's region of the scene atlas."""
        if not (isinstance(a, Textured) and isinstance(b, Textured)) or self.bakes is None:
            return a, b
        if a.placement == b.placement and a.texels.shape[:2] == b.texels.shape[:2]:
            return a, b
        if view_dependent.is_view_dependent(a) or view_dependent.is_view_dependent(b):
            return a, b
        return self.values.flat(a), self.values.flat(b)

    def _texture(self, value: Textured, name: str, label: str, *, raw: bool) -> ET.Element:
        """Texture element: a bitmap, a place on a sheet of the scene atlas, or a mesh attribute.

        One that needs another UV layer than the shape's own is wrapped in ``dnr_uv_layer`` by `settle`.
        """
        layer = value.placement.uv
        if layer == view_dependent.VIEW_LAYER:
            table = self.store.element(value, name, f"{self.blender.name}-{label}", raw=True)
            return view_dependent.element(table, name)
        if value.placement.corners is not None:
            if value.texels.shape[2] == 3:
                return self._mesh_attribute(value, name)
            value = self.values.flat(value)
        if value.placement.region is not None:
            assert self.sheets is not None
            element = ET.Element("ref", {"id": self.sheets.place(value, name), "name": name})
            self._lookups.append(_Lookup(element, ATLAS_LAYER, name))
            return element
        element = self.store.element(value, name, f"{self.blender.name}-{label}", raw=raw)
        if value.texels.shape[:2] != (1, 1):  # a single texel looks the same under any coordinates
            self._lookups.append(_Lookup(element, layer, name))
        return element

    def _mesh_attribute(self, value: Textured, name: str) -> ET.Element:
        """``mesh_attribute`` texture: a colour attribute of the mesh, interpolated linearly as in Cycles.

        Mitsuba names PLY properties ``color0_r``, ``_g``, ``_b`` ``vertex_color0_color``.
        """
        assert self.bakes is not None
        attribute = as_attribute(self.bakes.atlas, self.blender.name_full, value)
        if attribute not in self.colors:
            self.colors.append(attribute)
        element = xmltree.plugin("texture", "mesh_attribute", name=name)
        xmltree.text(element, "name", f"vertex_color{self.colors.index(attribute)}_color")
        return element

    def settle(self, emission: Value | None) -> tuple[str | None, tuple[str, ...]]:
        """Choose the shape's own UV layer and wrap the lookups that need another one.

        emission: its texture is sampled by Mitsuba through the shape's own layer. Next come tangent-space normal
        and bump maps, whose tangents are those of that layer. Returns (own layer, further layers).
        """
        wanted = [lookup.layer for lookup in self._lookups]
        frames = [lookup.layer for lookup in self._lookups if lookup.name in TANGENT_MAPS]
        own = (frames or wanted or [None])[0]
        if isinstance(emission, Textured) and emission.texels.shape[:2] != (1, 1):
            own = emission.placement.uv
        others = list(dict.fromkeys(layer for layer in wanted if layer != own))
        for lookup in self._lookups:
            if lookup.layer == own:
                continue
            if lookup.name in TANGENT_MAPS:
                self.note(
                    "approximated", "tangent-space map", f"its tangents are those of UV layer '{own or 'active'}'"
                )
            _wrap(lookup.element, f"vertex_uv{others.index(lookup.layer) + 1}")
        return own, tuple(layer or ACTIVE for layer in others)


def _wrap(element: ET.Element, attribute: str) -> None:
    """Turn ``element``, in place, into a ``dnr_uv_layer`` texture around what it was."""
    inner = ET.Element(element.tag, dict(element.attrib))
    inner.extend(list(element))
    name = inner.attrib.pop("name")
    if inner.tag != "ref":
        inner.set("name", "nested")
    for child in list(element):
        element.remove(child)
    element.tag = "texture"
    element.attrib.clear()
    element.attrib.update({"type": "dnr_uv_layer", "name": name})
    xmltree.text(element, "attribute", attribute)
    element.append(inner)

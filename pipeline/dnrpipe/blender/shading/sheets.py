"""Values over the scene atlas, and the images that many materials share for them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field

import numpy as np

from ..baking.regions import Atlas
from ..bundle import xmltree
from ..geometry.frozen import ATLAS_LAYER
from .filtering import wrapped
from .textures import Placement, Textured, TextureStore


@dataclass
class AtlasSheets:
    """One image per parameter and number of channels, in which every material has its own region."""

    atlas: Atlas
    _sheets: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)

    def place(self, value: Textured, name: str) -> str:
        """Put a region's values on a sheet for the parameter ``name``; returns the sheet's texture id."""
        region = value.placement.region
        assert region is not None
        values = value.linear()
        number = 1
        while True:
            identity = f"atlas-{xmltree.safe_name(name)}-{values.shape[2]}" + (f"-{number}" if number > 1 else "")
            sheet = self._sheets.setdefault(identity, {})
            if region not in sheet or np.array_equal(sheet[region], values):
                sheet[region] = values
                return identity
            number += 1

    def elements(self, store: TextureStore) -> list[ET.Element]:
        """Write the sheets and return their ``<texture type="bitmap" id=...>`` elements (Mitsuba plugin: bitmap)."""
        made = []
        for identity, materials in self._sheets.items():
            full = Textured(self.atlas.image(materials), False, Placement(wrap="clamp"))
            element = store.element(full, "", identity, raw=True)
            del element.attrib["name"]
            element.set("id", identity)
            made.append(element)
        return made


def on_region(atlas: Atlas, material: str, value: Textured) -> Textured:
    """The same value over the material's region of the scene atlas: images are sampled, corner values interpolated."""
    if value.placement.region == material:
        return value
    region = atlas.region(material)
    if value.placement.corners is not None:
        texels = region.interpolate(value.linear()[:, 0])
    else:
        layer = value.placement.uv
        layers = {}
        for part in atlas.parts(material):
            found = part.mesh.uv_layers.get(layer or part.mesh.active_uv or "")
            if found is not None:
                layers[id(part.mesh)] = found
        texels = sample(value, region.interpolate(atlas.stacked(material, layers, 2)))
    placement = Placement(uv=ATLAS_LAYER, wrap="clamp", region=material)
    return Textured(texels[:, None, :].astype(np.float32), False, placement)


def sample(value: Textured, uv: np.ndarray) -> np.ndarray:
    """Linear values [N, C] of an image at coordinates [N, 2] of its UV layer, as its placement tells."""
    texels = value.linear()
    height, width = texels.shape[:2]
    affine = np.asarray(value.placement.to_uv, np.float64)
    points = uv.astype(np.float64) @ affine[:2, :2].T + affine[:2, 2]
    x, y = points[:, 0] * width, points[:, 1] * height
    if value.placement.filter == "nearest":
        columns = wrapped(np.floor(x).astype(np.int64), width, value.placement.wrap)
        rows = wrapped(np.floor(y).astype(np.int64), height, value.placement.wrap)
        return texels[rows, columns]
    x, y = x - 0.5, y - 0.5
    left, low = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    s, t = (x - left)[:, None], (y - low)[:, None]
    result = np.zeros((len(uv), texels.shape[2]))
    for dx, dy, weight in ((0, 0, (1 - s) * (1 - t)), (1, 0, s * (1 - t)), (0, 1, (1 - s) * t), (1, 1, s * t)):
        columns = wrapped(left + dx, width, value.placement.wrap)
        rows = wrapped(low + dy, height, value.placement.wrap)
        result += weight * texels[rows, columns]
    return result

"""Colour attributes of the frozen meshes, as values at the corners of a material's surface."""

from __future__ import annotations

import hashlib

import numpy as np

from ..baking.cache import BakeCache
from ..baking.regions import Atlas
from ..shading.textures import Textured


def colour_corners(bakes: BakeCache, material: str, name: str) -> np.ndarray | None:
    """RGBA [M, 4], linear, of colour attribute ``name`` ('' for each mesh's active one); None where no mesh has it."""
    found = {}
    for part in bakes.atlas.parts(material):
        colour = part.mesh.colors.get(name or part.mesh.active_color or "")
        if colour is not None:
            found[id(part.mesh)] = colour
    return bakes.atlas.stacked(material, found, 4) if found else None


def as_attribute(atlas: Atlas, material: str, value: Textured) -> str:
    """Name of the attribute in ``FrozenMesh.colors`` that holds a corner value; a new one where arithmetic changed it.

    New attributes are named by their content: converting again gives the same names.
    """
    name = value.placement.corners
    assert name is not None
    texels = np.ascontiguousarray(value.linear()[:, 0], np.float32)
    found = {id(part.mesh): part.mesh.colors[name] for part in atlas.parts(material) if name in part.mesh.colors}
    if found and np.array_equal(atlas.stacked(material, found, 3), texels):
        return name
    name = f"dnrpipe.{hashlib.sha256(material.encode() + texels.tobytes()).hexdigest()[:12]}"
    start = 0
    for part in atlas.parts(material):
        corners = part.corners
        own = part.mesh.colors.setdefault(name, np.zeros((len(part.mesh.positions), 4), np.float32))
        own[corners, :3] = texels[start : start + len(corners)]
        own[corners, 3] = 1
        start += len(corners)
    return name

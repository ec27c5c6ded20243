"""Values that depend on the angle of view: Blender's Fresnel and Layer Weight nodes as tables. No bpy here.

Notation
    c    cosine between the view direction and the shading normal, in [0, 1]
    f(c) the node's output; one row for the front of the surface, one for its back

A table is a `Textured` of its own placement, so that arithmetic on it (Math, ColorRamp, Mix, ...) is exact;
texture plugin ``dnr_view`` (dnrpipe/raytrace/plugins/lookups.py) looks it up while rendering.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from dnrpipe.core.optics import fresnel

from ..bundle import xmltree
from .textures import Placement, Textured, Value, constant

VIEW_LAYER = "dnrpipe.view"
"""Name of the layer of coordinates (c, side) in `Placement`."""
COSINES = 256
COSINE = np.linspace(0.0, 1.0, COSINES)
"""The cosines of a table's columns, from grazing to straight on."""
PLACEMENT = Placement(uv=VIEW_LAYER, wrap="clamp")


def table(front: np.ndarray, back: np.ndarray) -> Textured:
    """Table from f at each COSINE, [COSINES] or [COSINES, 3] for each side."""
    rows = np.stack([front, back]).astype(np.float32)
    return Textured(rows.reshape(2, COSINES, -1), False, PLACEMENT)


def fresnel_node(ior: float) -> Textured:
    """Fresnel node: dielectric Fresnel of ``ior``, of 1 / ior from behind."""
    eta = max(ior, 1e-5)
    return table(fresnel(COSINE, eta), fresnel(COSINE, 1 / eta))


def layer_weight_fresnel(blend: float) -> Textured:
    """Layer Weight node, Fresnel: dielectric Fresnel of index 1 / (1 - blend), inverted from behind."""
    eta = max(1 - blend, 1e-5)
    return table(fresnel(COSINE, 1 / eta), fresnel(COSINE, eta))


def layer_weight_facing(blend: float) -> Textured:
    """Layer Weight node, Facing: 1 - c^p, p = 2 blend below a blend of 0.5, else 0.5 / (1 - blend)."""
    blend = min(max(blend, 0.0), 1 - 1e-5)
    power = 2 * blend if blend < 0.5 else 0.5 / (1 - blend)
    values = 1 - COSINE**power
    return table(values, values)


def is_view_dependent(value: Value | None) -> bool:
    """Whether ``value`` is a table over the angle of view."""
    return isinstance(value, Textured) and value.placement.uv == VIEW_LAYER


def average(value: Value) -> Value:
    """``value``, or the constant that stands for a view-dependent one: its cosine-weighted mean over the front."""
    if not (isinstance(value, Textured) and is_view_dependent(value)):
        return value
    weights = COSINE / COSINE.sum()
    return constant(np.broadcast_to(weights @ value.linear()[0].astype(np.float64), (3,)))


def element(inner: ET.Element, name: str) -> ET.Element:
    """``dnr_view`` texture called ``name`` around the bitmap ``inner`` of a table."""
    outer = xmltree.plugin("texture", "dnr_view", name=name)
    xmltree.integer(outer, "size", COSINES)
    inner.set("name", "values")
    outer.append(inner)
    return outer

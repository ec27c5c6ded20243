"""How an Image Texture node lies on a surface: a UV layer and an affine map of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from mathutils import Euler

from .sockets import Scope, find_input, resolve
from .textures import Placement

EXTENSIONS = {"REPEAT": "repeat", "EXTEND": "clamp", "CLIP": "clamp", "MIRROR": "mirror"}
Mean = Callable[[Any, Scope], np.ndarray]
"""(socket, scope) -> its value, float64 [3]; of a textured one, the mean (and a finding)."""
Inexact = Callable[[str, str], None]
"""(feature, what is used instead): records it, or raises."""


def image_placement(node: Any, scope: Scope, mean: Mean, inexact: Inexact) -> Placement | None:
    """Placement of an Image Texture node, or None when its coordinates are not an affine map of a UV layer."""
    if node.projection != "FLAT":
        inexact(f"{node.projection.lower()} image projection", "the image's mean is used")
        return None
    found = _coordinates(find_input(node, "Vector"), scope, mean, inexact)
    if found is None:
        return None
    uv, affine = found
    return Placement(
        uv=uv,
        to_uv=tuple(tuple(float(v) for v in row) for row in affine),
        filter="nearest" if node.interpolation == "Closest" else "bilinear",
        wrap=EXTENSIONS[node.extension],  # type: ignore[arg-type]
    )


def _coordinates(socket: Any, scope: Scope, mean: Mean, inexact: Inexact) -> tuple[str | None, np.ndarray] | None:
    """UV layer and 3x3 affine map that a vector input stands for; None where it is neither."""
    source = resolve(socket, scope)
    node = source.node
    if not source.linked:
        # An unlinked Vector means the render-active UV layer, also inside a group.
        return None, np.eye(3)
    if node.type == "UVMAP" or (node.type == "TEX_COORD" and source.socket.name == "UV"):
        return (node.uv_map or None) if node.type == "UVMAP" else None, np.eye(3)
    if node.type == "ATTRIBUTE" and node.attribute_type == "GEOMETRY" and source.socket.name == "Vector":
        return node.attribute_name or None, np.eye(3)
    if node.type == "MAPPING":
        below = _coordinates(find_input(node, "Vector"), source.scope, mean, inexact)
        affine = _mapping(node, source.scope, mean, inexact)
        if below is None or affine is None:
            return None
        return below[0], affine @ below[1]
    what = f"'{source.socket.name}' coordinates" if node.type == "TEX_COORD" else f"{node.bl_label} node"
    inexact(f"image placed by {what}", "not a UV layer: the image's mean is used")
    return None


def _mapping(node: Any, scope: Scope, mean: Mean, inexact: Inexact) -> np.ndarray | None:
    """Mapping node as a planar affine map (Blender manual: Mapping; z of a UV is 0)."""
    parts = {}
    for name in ("Location", "Rotation", "Scale"):
        socket = find_input(node, name)
        parts[name] = np.zeros(3) if socket is None else mean(socket, scope)
    rotation = np.array(Euler(parts["Rotation"]).to_matrix(), dtype=np.float64)
    size = parts["Scale"]
    if node.vector_type == "TEXTURE":
        if (np.abs(size) < 1e-12).any():
            inexact("Mapping node of scale 0", "the image's mean is used")
            return None
        linear = np.diag(1 / size) @ rotation.T
        shift = -(linear @ parts["Location"])
    elif node.vector_type in {"POINT", "VECTOR"}:
        linear = rotation @ np.diag(size)
        shift = parts["Location"] if node.vector_type == "POINT" else np.zeros(3)
    else:
        inexact("Mapping node of type Normal", "the image's mean is used")
        return None
    affine = np.eye(3)
    affine[:2, :2] = linear[:2, :2]
    affine[:2, 2] = shift[:2]
    return affine

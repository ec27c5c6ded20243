"""Texture coordinates of a world: which rotation of the view direction they are."""

from __future__ import annotations

from typing import Any

import numpy as np
from mathutils import Euler

from ..shading.sockets import find_input, resolve


def plain_colour(source: Any) -> np.ndarray | None:
    """Value of a constant socket as [3], or None."""
    if source.linked and source.node.type not in {"RGB", "VALUE"}:
        return None
    value = source.node.outputs[0].default_value if source.linked else source.default
    return np.full(3, float(value)) if isinstance(value, int | float) else np.array(value[:3], dtype=np.float64)


def rotation(socket: Any, scope: Any) -> np.ndarray | None:
    """Rotation from world direction to lookup direction, or None if the coordinates are anything else.

    Mapping node: Point and Vector types rotate the direction, Texture rotates it back.
    """
    source = resolve(socket, scope)
    if not source.linked:
        return np.eye(3)
    node = source.node
    if node.type == "TEX_COORD" and source.socket.name == "Generated":
        return np.eye(3)
    if node.type == "NEW_GEOMETRY" and source.socket.name == "Position":
        return np.eye(3)
    if node.type != "MAPPING" or node.vector_type == "NORMAL":
        return None
    below = rotation(find_input(node, "Vector"), source.scope)
    parts = {}
    for name in ("Location", "Rotation", "Scale"):
        found = find_input(node, name)
        plain = np.zeros(3) if found is None else plain_colour(resolve(found, source.scope))
        if plain is None:
            return None
        parts[name] = plain
    moved = "Location" in parts and np.any(np.abs(parts["Location"]) > 1e-6)
    uniform = np.allclose(parts["Scale"], parts["Scale"][0]) and parts["Scale"][0] > 1e-6
    if below is None or not uniform or (moved and node.vector_type != "VECTOR"):
        return None
    turn = np.array(Euler(parts["Rotation"]).to_matrix())
    return (turn.T if node.vector_type == "TEXTURE" else turn) @ below

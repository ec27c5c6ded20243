"""The sun disc of a Sky Texture becomes a lamp: in the environment image it would cover about a pixel.

A sun of half a degree holds most of the light of a clear sky; rendered into an image of 1024 x 512 it is off by some
percent of its energy. So the sky is rendered without it, and its irradiance is measured in a close-up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from mathutils import Euler

from ..shading.sockets import LUMINANCE, find_input, resolve, walk
from .world_images import render_close_up

WITH_DISC = {"NISHITA", "SINGLE_SCATTERING", "MULTIPLE_SCATTERING"}
RESOLVED = math.radians(1.4)
"""Suns from four pixels on stay in the image, limb darkening and all."""
CLOSE_UP = 64
MARGIN = 1.5
"""Width of the close-up, in diameters of the sun."""


@dataclass(frozen=True)
class SkySun:
    """direction: unit vector towards the sun, world space [3]. angle: its diameter, radians."""

    node: Any
    direction: np.ndarray
    angle: float


def find_sun(world: Any) -> SkySun | None:
    """The world's only sun disc; None where there is none, several, or one that the environment image resolves."""
    skies = [node for node in walk(world.node_tree) if node.type == "TEX_SKY" and node.sky_type in WITH_DISC]
    found = [node for node in skies if node.sun_disc and node.sun_size > 0 and node.sun_intensity > 0]
    if len(found) != 1 or found[0].sun_size > RESOLVED:
        return None
    node = found[0]
    turn = rotation(find_input(node, "Vector"), ())
    if turn is None:
        return None
    elevation, azimuth = float(node.sun_elevation), math.pi / 2 - float(node.sun_rotation)
    flat = math.cos(elevation)
    local = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
    return SkySun(node, turn.T @ local, float(node.sun_size))


@contextmanager
def without_disc(sun: SkySun) -> Iterator[None]:
    """The sky without its sun, for as long as the context lasts."""
    sun.node.sun_disc = False
    try:
        yield
    finally:
        sun.node.sun_disc = True


def measure(world: Any, sun: SkySun) -> np.ndarray:
    """Irradiance of the disc alone on a surface that faces it, linear RGB [3] (W/m2 in Blender's units)."""
    half = 0.5 * MARGIN * sun.angle
    with_disc = render_close_up(world, sun.direction, 2 * half, CLOSE_UP)
    with without_disc(sun):
        sky = render_close_up(world, sun.direction, 2 * half, CLOSE_UP)
    axis = ((np.arange(CLOSE_UP) + 0.5) / CLOSE_UP * 2 - 1) * math.tan(half)
    x, y = np.meshgrid(axis, axis)
    solid_angle = (2 * math.tan(half) / CLOSE_UP) ** 2 / (1 + x * x + y * y) ** 1.5
    excess = np.maximum(with_disc - sky, 0).astype(np.float64)
    if not np.isfinite(excess).all():
        raise ValueError("the sun of the sky texture has no finite radiance; check the world's nodes")
    return (excess * solid_angle[..., None]).sum(axis=(0, 1))


def plain_colour(source: Any) -> np.ndarray | None:
    """Value of a constant socket as [3], or None."""
    if source.linked and source.node.type not in {"RGB", "VALUE"}:
        return None
    value = source.node.outputs[0].default_value if source.linked else source.colour
    return np.full(3, float(value)) if isinstance(value, int | float) else np.array(value[:3], dtype=np.float64)


def plain_number(source: Any) -> float | None:
    """Value of a constant socket as a number, or None."""
    if not source.linked:
        return source.number
    found = plain_colour(source)
    return None if found is None else float(found @ np.array(LUMINANCE))


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

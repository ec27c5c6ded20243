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

from ..shading.sockets import find_input, walk
from .world_images import render_close_up
from .world_rotation import rotation

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
    found = [node for node in walk(world.node_tree) if node.type == "TEX_SKY" and _has_disc(node)]
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


def _has_disc(node: Any) -> bool:
    return node.sky_type in WITH_DISC and bool(node.sun_disc) and node.sun_size > 0 and node.sun_intensity > 0


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

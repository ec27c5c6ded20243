"""What the candidates want to see: pieces of surface from directions, weighted by how many pixels ask for them.

Views that will be rendered later are taken to be like the candidates. So a renderer is asked for a cell of the surface
seen from about a direction as often as the candidates see it so; a selection serves that demand as well as its
best view of the cell does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .medoids import Facilities
from .sightings import Sightings

BINS = 32
"""Bins of the sphere of directions, about 40 degrees wide."""


@dataclass(frozen=True)
class Demand:
    """D points of demand, sorted by cell.

    cells    int64 [D]
    toward   float32 [D, 3] unit mean direction from the surface to the cameras
    pixels   float32 [D] mean pixels of a sighting in it, as a share of a view's pixels
    weights  float32 [D] share of all sighted pixels, as much as their views count; sums to 1
    """

    cells: np.ndarray
    toward: np.ndarray
    pixels: np.ndarray
    weights: np.ndarray

    def __len__(self) -> int:
        return len(self.cells)


def directions(count: int = BINS) -> np.ndarray:
    """``count`` unit vectors spread over the sphere (Fibonacci spiral), float32 [count, 3]."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    angle = np.pi * (1.0 + 5.0**0.5) * k
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1).astype(np.float32)


def demand_of(sightings: Sightings, shares: np.ndarray | None = None) -> Demand:
    """All sightings, those of one cell from one bin of directions taken together.

    shares: what each view counts, [N] (default: alike).
    """
    axes = directions().T
    size = sightings.grid**2 * BINS
    pixels, number, weights = np.zeros(size), np.zeros(size), np.zeros(size)
    sums = np.zeros((size, 3))
    for view in range(len(sightings)):
        part = sightings.of(view)
        toward = sightings.toward[part]
        key = sightings.cells[part].astype(np.int64) * BINS + (toward @ axes).argmax(axis=1)
        amount = sightings.pixels[part].astype(np.float64)
        pixels[key] += amount  # a view has each cell once, so no key comes twice
        number[key] += 1.0
        weights[key] += amount if shares is None else amount * shares[view]
        sums[key] += toward * amount[:, None]
    there = np.flatnonzero(pixels)
    toward = sums[there]
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
    return Demand(
        there // BINS,
        toward.astype(np.float32),
        (pixels[there] / number[there]).astype(np.float32),
        (weights[there] / weights.sum()).astype(np.float32),
    )


def service(sightings: Sightings, demand: Demand, view: int) -> np.ndarray:
    """How well a view serves each demand, float32 [D] in [0, 1]: 1 = the same cell, direction and resolution.

    sqrt(min(1, pixels / pixels wanted)) · (1 − sin(angle / 2)); 0 where it does not see the cell. The sine is half
    the chord between the directions: proportional to the angle where it is small, 1 for opposite directions.
    """
    part = sightings.of(view)
    toward = np.zeros((sightings.grid**2, 3), np.float32)
    pixels = np.zeros(sightings.grid**2, np.float32)
    toward[sightings.cells[part]] = sightings.toward[part]
    pixels[sightings.cells[part]] = sightings.pixels[part]
    resolution = np.sqrt(np.minimum(pixels[demand.cells] / demand.pixels, 1.0))
    cosine = np.einsum("dk,dk->d", toward[demand.cells], demand.toward)
    return resolution * (1.0 - np.sqrt(np.clip(0.5 - 0.5 * cosine, 0.0, 1.0)))


def demand_problem(sightings: Sightings, demand: Demand) -> Facilities:
    """Choose views that serve the demand: the distance is 1 − :func:`service`."""

    def rows(views: np.ndarray) -> np.ndarray:
        return np.stack([1.0 - service(sightings, demand, int(view)) for view in views])

    return Facilities(len(sightings), rows, demand.weights, np.ones(len(demand), np.float32))

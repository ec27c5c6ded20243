"""Numbers of base images' paths: Kronecker sequences, in each pixel from a place of its own on.

Sample s of a pixel that begins at t has the number s TILE² + t. In tiles, t is a pixel's place in its tile: the samples
of a tile complement one another, and their mean has little error (`smoothing`). Scattered, t is anywhere: what error
there is differs from pixel to pixel as noise does, which is what a denoiser takes for noise; tiles it takes for a
pattern.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

TILE = 3
"""Side of a tile: as large as the kernels that the network smooths base images with."""
ORDER = np.array([[0, 5, 7], [3, 8, 1], [6, 2, 4]], np.uint32)
"""Places within a tile: neighbours in number are far apart."""
ANYWHERE = 64.0
"""Where scattered pixels begin: below it."""
GOLDEN = (0.7548776662466927, 0.5698402909980532)
"""Steps of the two-dimensional R2 sequence (Roberts 2018)."""


def steps(count: int) -> np.ndarray:
    """Steps of ``count`` sequences, float32: independent, so that no number of a path follows another.

    The first two are the R2 sequence's, the others the roots of primes. Raises ValueError beyond 168.
    """
    primes = [n for n in range(5, 1000) if all(n % d for d in range(2, math.isqrt(n) + 1))]
    found = [*GOLDEN, *(math.sqrt(prime) % 1 for prime in primes)]
    if count > len(found):
        raise ValueError(f"count: is {count}, there are {len(found)} steps")
    return np.array(found[:count], np.float32)


def beginnings(mi: Any, x: Any, y: Any, places: Any, tiles: Any) -> Any:
    """Where pixels begin: Float. x, y: their columns and rows, UInt32. places: ORDER. tiles: Bool; False: scattered."""
    import drjit as dr

    place = dr.gather(mi.UInt32, places, (y % TILE) * TILE + x % TILE)
    mixed = (x * 73856093) ^ (y * 19349663)  # Teschner et al. 2003, then a round of MurmurHash2
    mixed = (mixed ^ (mixed >> 13)) * 0x5BD1E995
    mixed ^= mixed >> 15
    return dr.select(tiles, mi.Float(place), mi.Float(mixed & 0xFFFF) * (ANYWHERE / 0x10000))


def fraction(x: Any) -> Any:
    """x - floor(x), of Dr.Jit floats."""
    import drjit as dr

    return x - dr.floor(x)

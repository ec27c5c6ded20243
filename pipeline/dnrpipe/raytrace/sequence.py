"""Numbers of base images' paths: Kronecker sequences over the samples of a tile of pixels.

Sample s of a pixel at place t of its tile has the number s TILE² + t.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

TILE = 3
"""Side of a tile: as large as the kernels that the network smooths base images with."""
ORDER = np.array([[0, 5, 7], [3, 8, 1], [6, 2, 4]], np.uint32)
"""Places within a tile: neighbours in number are far apart."""
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


def fraction(x: Any) -> Any:
    """x - floor(x), of Dr.Jit floats."""
    import drjit as dr

    return x - dr.floor(x)

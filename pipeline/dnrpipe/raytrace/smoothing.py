"""Base images smoothed over a tile: most of what a denoiser does to them, in a thirtieth of its time.

Notation
    S, D     specular part of a base image, and its diffuse part, which has no grain but at edges
    v        variance of the mean of a pixel's samples, mean of nine pixels; l luminance of S
    tile     3 x 3 pixels whose samples complement one another (`sequence`)

    S'_p = sum over q of w_pq S_q / sum of w_pq,    q in the tile about p
    w_pq = exp(-(l_p - l_q)² / (2 LOOSE² v_p)) where q lies on p's object and faces as it does, else 0

A tile's pixels together have nine times the samples of one, evenly spread: their mean is free of the pattern that the
sequences draw on glossy surfaces. Differences that noise does not explain are edges, and stay: the range weight of a
bilateral filter, scaled by the variance (as Schied et al. 2017, section 4.4, do).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .neighbours import AROUND, Pixels
from .recorded import Recorded, inputs_of, planes_of

LOOSE = 1.5
"""Standard deviations of a pixel's mean within which a neighbour shows the same. Measured with four and eight rays,
frames that remember: 2 is 0.1 to 0.4 dB better on metal, 0.2 to 0.4 worse on glass; 1 the other way round."""
FACING = 0.9
"""Least cosine between normals."""
LEAST = 1e-10
"""Of a variance: black stays black."""
TAKEN = (
    *("base.R", "base.G", "base.B", "diffuse.R", "diffuse.G", "diffuse.B"),
    *("normal.X", "normal.Y", "normal.Z", "object.Id", "mask", "noise"),
)
"""Channels that are read, in the kernel's order."""


class Smoother:
    """Smooths base images of one size after the other. Needs a jit variant."""

    def __init__(self, mi: Any) -> None:
        self.mi = mi
        self.kernel = Recorded(self._kernel)

    def __call__(self, channels: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The channels with ``base.R/G/B`` smoothed; float32 [H, W] each, linear Rec.709, premultiplied."""
        height, width = channels["mask"].shape
        planes = inputs_of(self.mi, (channels[name] for name in TAKEN))
        found = self.kernel(planes, width, height)
        return {**channels, **dict(zip(TAKEN[:3], planes_of(found, (height, width)), strict=True))}

    def _kernel(self, planes: list[Any], width: int, height: int) -> list[Any]:
        """Base image [3][height * width]. Recorded once for a size. planes: of TAKEN."""
        import drjit as dr

        mi = self.mi
        pixels = Pixels(mi, width, height)
        around = [pixels.index(*place) for place in AROUND]
        diffuse = mi.Color3f(*planes[3:6])
        specular, normal, noise = mi.Color3f(*planes[:3]) - diffuse, mi.Normal3f(*planes[6:9]), planes[11]
        light, place = mi.luminance(specular), dr.select(planes[10] > 0.5, planes[9], -1)  # of no object
        variance = sum((dr.square(dr.gather(mi.Float, noise, index)) for index in around), mi.Float(0)) / 9
        sharp = 0.5 / (LOOSE * LOOSE * variance + LEAST)
        seen, facing = dr.ravel(mi.Vector4f(*specular, light)), dr.ravel(mi.Vector4f(*normal, place))
        total, weights = mi.Color3f(0), mi.Float(0)
        for index in around:
            beside, on = dr.gather(mi.Vector4f, seen, index), dr.gather(mi.Vector4f, facing, index)
            same = (on.w == place) & (place >= 0) & (dr.dot(on.xyz, normal) > FACING)
            weight = dr.select(
                same | (index == mi.Int32(pixels.pixel)), dr.exp(-dr.square(beside.w - light) * sharp), 0
            )
            total, weights = total + weight * mi.Color3f(beside.x, beside.y, beside.z), weights + weight
        return [*(total / weights + diffuse)]

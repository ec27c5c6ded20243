"""A readable twin of the texture half of the DNR: plain numpy loops, same weights, same numbers.

What `dnrtrain.textures`, `dnrtrain.aggregator` (strategy ``concat``) and the composition compute
fast, written once more the way the papers say it, one pixel at a time. For reading and for tests; slow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

Array = np.ndarray
SLOPE = 0.2


def bilinear(texels: Array, x: float, y: float) -> Array:
    """One bilinear look-up in ``texels`` [C, S_y, S_x] at (x, y) in [-1, 1]² -> [C].

    Texel i's centre lies at (2i + 1) / S − 1; coordinates beyond the outermost centres are clamped.
    """
    _, height, width = texels.shape
    column = min(max(((x + 1) * width - 1) / 2, 0.0), width - 1.0)
    row = min(max(((y + 1) * height - 1) / 2, 0.0), height - 1.0)
    c0, r0 = int(column), int(row)
    c1, r1 = min(c0 + 1, width - 1), min(r0 + 1, height - 1)
    u, v = column - c0, row - r0
    upper = (1 - u) * texels[:, r0, c0] + u * texels[:, r0, c1]
    lower = (1 - u) * texels[:, r1, c0] + u * texels[:, r1, c1]
    return (1 - v) * upper + v * lower


def hierarchical_sample(levels: list[Array], x: float, y: float) -> Array:
    """π: the sum of one look-up per level of the pyramid (Thies et al. 2019, section 4.1) -> [C]."""
    return np.sum([bilinear(level, x, y) for level in levels], axis=0)


def octahedral(normal: Array) -> tuple[float, float]:
    """Unit vector -> the octahedral square [-1, 1]² (Cigolle et al. 2014)."""
    x, y = normal[:2] / max(float(np.abs(normal).sum()), 1e-12)
    if normal[2] < 0:
        x, y = (1 - abs(y)) * (1 if x >= 0 else -1), (1 - abs(x)) * (1 if y >= 0 else -1)
    return float(x), float(y)


def harmonics(direction: Array) -> Array:
    """Nine real spherical harmonics Y_lm of a unit vector, from their Cartesian forms -> [9]."""
    x, y, z = direction
    return np.array(
        [
            math.sqrt(1 / (4 * math.pi)),
            math.sqrt(3 / (4 * math.pi)) * y,
            math.sqrt(3 / (4 * math.pi)) * z,
            math.sqrt(3 / (4 * math.pi)) * x,
            math.sqrt(15 / (4 * math.pi)) * x * y,
            math.sqrt(15 / (4 * math.pi)) * y * z,
            math.sqrt(5 / (16 * math.pi)) * (3 * z * z - 1),
            math.sqrt(15 / (4 * math.pi)) * x * z,
            math.sqrt(15 / (16 * math.pi)) * (x * x - y * y),
        ]
    )


def spatial_texture(weights: Mapping[str, Array], levels: int, view: Mapping[str, Array]) -> Array:
    """The 3D texture aggregator of one view (paper, section III-D): T = CNN([π(D), π(N), π(U)]).

    Args:
        weights: the model's state by its names (``aggregator.…``), float64.
        levels: levels of each pyramid.
        view: uv [2, H, W] in [-1, 1], depth [1, H, W] in [0, 1], normal [3, H, W], mask [1, H, W].

    Returns:
        T [C, H, W], 0 outside the mask.
    """

    def pyramid(name: str) -> list[Array]:
        return [weights[f"aggregator.texture_{name}.levels.{i}"][0] for i in range(levels)]

    tex_d, tex_n, tex_u = pyramid("depth"), pyramid("normal"), pyramid("uv")
    matrix, offset = weights["aggregator.fusion.point.weight"], weights["aggregator.fusion.point.bias"]
    _, height, width = view["mask"].shape
    hidden = np.zeros((matrix.shape[0], height, width))
    for row in range(height):
        for column in range(width):
            if view["mask"][0, row, column] <= 0.5:
                continue
            depth = view["depth"][0, row, column]
            features = np.concatenate(
                [
                    hierarchical_sample(tex_d, 2 * depth - 1, 0.0),
                    hierarchical_sample(tex_n, *octahedral(view["normal"][:, row, column])),
                    hierarchical_sample(tex_u, *view["uv"][:, row, column]),
                ]
            )
            response = matrix @ features + offset
            hidden[:, row, column] = np.where(response > 0, response, SLOPE * response)
    kernel, bias = weights["aggregator.fusion.conv.weight"], weights["aggregator.fusion.conv.bias"]
    texture = np.zeros((kernel.shape[0], height, width))
    padded = np.pad(hidden, ((0, 0), (1, 1), (1, 1)))
    for row in range(height):
        for column in range(width):
            patch = padded[:, row : row + 3, column : column + 3]
            texture[:, row, column] = np.einsum("oikl,ikl->o", kernel, patch) + bias
    return texture * view["mask"]


def view_dependent(texture: Array, view_dir: Array) -> Array:
    """Channels 4 to 12 (one-based) of T [C, H, W] times the harmonics of view_dir [3, H, W]."""
    shaded = texture.copy()
    for row in range(texture.shape[1]):
        for column in range(texture.shape[2]):
            shaded[3:12, row, column] *= harmonics(view_dir[:, row, column])
    return shaded


def over_white(rgb: Array, coverage: Array) -> Array:
    """out = coverage · rgb + (1 − coverage) · 1."""
    return coverage * rgb + (1 - coverage) * np.ones(3)[:, None, None]

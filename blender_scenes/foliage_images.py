"""Images of ``build_foliage.py``: colours, heights, normals. Arrays only (see `patterns`)."""

from __future__ import annotations

import numpy as np
from patterns import mix, normals_from_height, smoothstep, spectral_noise, texel_grid


def leaf_sheet(size: int = 512) -> tuple[np.ndarray, np.ndarray]:
    """Four leaves, 2 x 2, base at the left: (colour and alpha [N, N, 4], vein normals [N, N, 3])."""
    half = size // 2
    colours = [((0.17, 0.36, 0.09), (0.30, 0.50, 0.16)), ((0.11, 0.28, 0.08), (0.21, 0.42, 0.14))]
    colours += [((0.26, 0.45, 0.11), (0.44, 0.60, 0.22)), ((0.14, 0.31, 0.10), (0.52, 0.58, 0.22))]
    sheet = np.zeros((size, size, 4))
    height = np.zeros((size, size))
    u, v = texel_grid(half, half)
    x, y = (u - 0.03) / 0.94, np.abs(2 * v - 1)
    for k, (dark, light) in enumerate(colours):
        t = np.clip(x, 0, 1)
        outline = 0.80 * np.sin(np.pi * t**0.78) ** 0.85 * (1 - 0.35 * smoothstep(0.6, 1.0, t))
        outline += 0.015 * np.sin(t * 40 + k) * np.sin(np.pi * t)
        stalk = 0.035 * (x < 0.25)
        alpha = smoothstep(0.02, -0.02, y - np.maximum(outline, stalk)) * (x >= 0) * (x <= 1)
        rib = np.exp(-((y / 0.035) ** 2))
        side = np.exp(-(((((t - 0.42 * y) * 13 + 0.5 * k) % 1 - 0.5) / 0.10) ** 2)) * smoothstep(0.02, 0.10, y)
        noise = spectral_noise(half, half, 50 + k, slope=1.4)
        tone = np.clip(0.35 + 0.35 * y / np.maximum(outline, 0.1) + 0.16 * noise, 0, 1)
        if k == 3:  # a leaf that yellows from its edge
            tone = np.clip(tone + 0.5 * smoothstep(0.5, 1.0, y / np.maximum(outline, 0.1)), 0, 1)
        colour = mix(mix(dark, light, tone), (0.58, 0.68, 0.34), 0.75 * rib + 0.28 * side)
        row, column = divmod(k, 2)
        window = np.s_[row * half : (row + 1) * half, column * half : (column + 1) * half]
        sheet[window] = np.concatenate([colour, alpha[..., None]], axis=-1)
        height[window] = 0.8 * rib + 0.35 * side
    return sheet, normals_from_height(height, 2.0)


def bark(size: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """Grey fissured bark with lenticels, v along the trunk: (colour, height), tileable."""
    coarse = spectral_noise(size, size, 61, slope=1.5, stretch=3.5)
    fine = spectral_noise(size, size, 62, slope=0.7)
    u, v = texel_grid(size, size)
    rng = np.random.default_rng(63)
    scars = np.zeros((size, size))
    for _ in range(70):
        cx, cy, width = rng.random(), rng.random(), rng.uniform(0.02, 0.06)
        dx, dy = (u - cx + 0.5) % 1 - 0.5, (v - cy + 0.5) % 1 - 0.5
        scars = np.maximum(scars, np.exp(-((dx / width) ** 2) - (dy / 0.006) ** 2))
    tone = np.clip(0.5 + 0.22 * coarse + 0.10 * fine, 0, 1)
    colour = mix(mix((0.25, 0.20, 0.16), (0.58, 0.52, 0.44), tone), (0.66, 0.60, 0.50), 0.7 * scars)
    return np.clip(colour, 0, 1), np.clip(0.5 + 0.3 * coarse + 0.1 * fine, 0, 1) + 0.4 * scars

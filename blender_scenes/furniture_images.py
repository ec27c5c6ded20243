"""Images of ``build_furniture.py``: colours, heights, normals. Arrays only (see `patterns`)."""

from __future__ import annotations

import numpy as np
from patterns import mix, plain, smoothstep, spectral_noise, texel_grid


def damask(size: int = 512) -> np.ndarray:
    """Ogee lattice with palmettes, cream on teal, tileable."""
    u, v = texel_grid(size, size)
    ink = np.zeros((size, size))
    gold = np.zeros((size, size))
    for shift_u, shift_v in ((0.0, 0.0), (0.5, 0.5)):
        x = ((u + shift_u) % 1 - 0.5) * 2
        y = ((v + shift_v) % 1 - 0.5) * 2
        edge = np.abs(np.abs(x) - 0.5 * (1 + np.cos(np.pi * y)))
        ink = np.maximum(ink, smoothstep(0.075, 0.055, edge))
        gold = np.maximum(gold, smoothstep(0.035, 0.02, edge))
        r, a = np.hypot(x, y * 0.8 + 0.1), np.arctan2(x, y * 0.8 + 0.1)
        petals = 0.26 + 0.13 * np.cos(7 * a) * smoothstep(2.9, 1.9, np.abs(a))
        ink = np.maximum(ink, smoothstep(0.015, -0.015, r - petals) * smoothstep(0.09, 0.115, r))
        gold = np.maximum(gold, smoothstep(0.015, -0.015, np.abs(r - 0.5 * petals) - 0.016))
        ink = np.maximum(ink, smoothstep(0.012, -0.012, np.hypot(np.abs(x) - 0.22, y - 0.42) - 0.06))
    slub = spectral_noise(size, size, 7, slope=0.8)
    base = mix((0.07, 0.30, 0.34), (0.10, 0.37, 0.40), smoothstep(-1.5, 1.5, slub))
    image = mix(base, (0.88, 0.82, 0.68), ink * (0.93 + 0.07 * np.tanh(slub)))
    return mix(image, (0.80, 0.58, 0.22), gold)


def kilim(size: int = 512) -> np.ndarray:
    """Stepped diamonds in four colours, tileable: the pillow."""
    u, v = texel_grid(size, size)
    step = 24.0
    x, y = np.floor(u * step) / step, np.floor(v * step * 2) / (step * 2)
    distance = np.abs(((x * 2) % 1) - 0.5) + np.abs(((y * 2) % 1) - 0.5)
    bands = np.floor(distance * 10).astype(int) % 5
    palette = np.array(
        [(0.78, 0.28, 0.17), (0.93, 0.86, 0.72), (0.18, 0.24, 0.36), (0.90, 0.62, 0.20), (0.93, 0.86, 0.72)]
    )
    fibre = spectral_noise(size, size, 21, slope=0.5)
    return np.clip(palette[bands] * (1 + 0.05 * fibre[..., None]), 0, 1)


def rug(size: int = 640) -> np.ndarray:
    """Round rug seen from above: rings of zigzag, dots and plain bands over raw wool."""
    u, v = texel_grid(size, size)
    x, y = 2 * u - 1, 2 * v - 1
    r, a = np.hypot(x, y), np.arctan2(y, x)
    image = plain(size, size, (0.86, 0.80, 0.70))
    red, blue, ochre = (0.62, 0.20, 0.15), (0.17, 0.25, 0.36), (0.80, 0.58, 0.25)
    for low, high, colour in ((0.93, 1.2, blue), (0.86, 0.89, red), (0.52, 0.55, red), (0.30, 0.50, blue)):
        image = mix(image, colour, smoothstep(low - 0.003, low + 0.003, r) * smoothstep(high + 0.003, high - 0.003, r))
    zigzag = np.abs(((a / (2 * np.pi) * 36) % 1) - 0.5) * 2
    image = mix(image, red, smoothstep(0.012, -0.012, np.abs(r - 0.62 - 0.09 * zigzag) - 0.022))
    image = mix(image, ochre, smoothstep(0.012, -0.012, np.abs(r - 0.69 - 0.09 * zigzag) - 0.014))
    petal = 0.40 + 0.075 * np.cos(16 * a)
    image = mix(image, ochre, smoothstep(0.012, -0.012, np.abs(r - petal) - 0.012))
    star = 0.17 + 0.07 * np.cos(8 * a)
    image = mix(image, red, smoothstep(0.01, -0.01, r - star))
    image = mix(image, ochre, smoothstep(0.01, -0.01, r - 0.45 * star))
    wool = spectral_noise(size, size, 33, slope=0.45)
    return np.clip(image * (1 + 0.06 * wool[..., None]), 0, 1)


def knit(size: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """Stocking stitch: (colour with two stripes [N, N, 3], height [N, N]), tileable."""
    u, v = texel_grid(size, size)
    columns, rows = 12, 12
    x, y = (u * columns) % 1, v * rows
    arm = np.abs(x - 0.5) * 2
    height = np.sqrt(np.clip(1 - ((((y - 0.9 * arm) % 1) - 0.5) * 2) ** 2, 0, 1)) * smoothstep(0.0, 0.25, arm)
    height *= smoothstep(1.0, 0.8, arm)
    stripe = smoothstep(0.0, 0.02, (v % 1) - 0.55) * smoothstep(0.80, 0.78, v % 1)
    colour = mix((0.90, 0.87, 0.80), (0.72, 0.36, 0.24), stripe)
    return colour * (0.70 + 0.30 * height[..., None]), height

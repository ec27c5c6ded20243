"""Images of ``build_interior.py``: colours, heights, normals. Arrays only (see `patterns`)."""

from __future__ import annotations

import numpy as np
from patterns import mix, plain, smoothstep, spectral_noise, texel_grid


def wallpaper(size: int = 512) -> tuple[np.ndarray, np.ndarray]:
    """A square as high as the room: panelling below, sprigged stripes above. (colour, height), tileable along u."""
    u, v = texel_grid(size, size)
    paper = mix((0.44, 0.52, 0.47), (0.50, 0.58, 0.52), smoothstep(-0.1, 0.1, np.sin(2 * np.pi * 12 * u)))
    sprig = np.zeros((size, size))
    for shift in (0.0, 0.5):
        x = ((u * 6 + shift) % 1 - 0.5) / 6
        y = ((v * 6 + 0.5 + shift) % 1 - 0.5) / 6
        r, a = np.hypot(x, y), np.arctan2(x, y)
        sprig = np.maximum(sprig, smoothstep(0.003, -0.002, r - 0.030 * (0.45 + 0.55 * np.cos(2.5 * a) ** 2)))
    paper = mix(paper, (0.84, 0.80, 0.66), 0.85 * sprig)
    x, y = ((u * 4) % 1 - 0.5) / 4, v - 0.17
    edge = np.maximum(np.abs(x) - 0.090, np.abs(y) - 0.105)
    groove = smoothstep(0.010, 0.004, np.abs(edge)) + smoothstep(0.004, 0.001, np.abs(np.abs(x) - 0.124))
    height = -0.8 * groove
    panel = mix((0.83, 0.81, 0.75), (0.70, 0.68, 0.62), np.clip(groove, 0, 1))
    low = smoothstep(0.345, 0.343, v)
    image = mix(paper * (1 + 0.02 * spectral_noise(size, size, 1, slope=0.6)[..., None]), panel, low)
    rail = smoothstep(0.022, 0.019, np.abs(v - 0.345))
    skirting = smoothstep(0.05, 0.048, v)
    image = mix(image, (0.80, 0.78, 0.72), np.maximum(rail, skirting))
    ledges = rail * (1 - ((v - 0.345) / 0.022) ** 2) + skirting
    return np.clip(image, 0, 1), height * low * (1 - np.maximum(rail, skirting)) + ledges


def painting(height: int = 256, width: int = 384) -> np.ndarray:
    """A lake at dusk below mountains, in broad strokes."""
    u, v = texel_grid(height, width)
    strokes = spectral_noise(height, width, 5, slope=1.1, stretch=0.3)
    image = mix((0.93, 0.62, 0.38), (0.30, 0.38, 0.58), smoothstep(0.42, 1.0, v + 0.02 * strokes))
    sun = np.hypot((u - 0.66) * 1.5, v - 0.52)
    image = mix(image, (0.99, 0.90, 0.66), 0.9 * np.exp(-((sun / 0.10) ** 2)))
    ridges = (
        (0.62, 0.13, (0.44, 0.40, 0.52), 3),
        (0.54, 0.10, (0.28, 0.29, 0.40), 5),
        (0.47, 0.06, (0.15, 0.19, 0.22), 9),
    )
    for base, rise, colour, seed in ridges:
        line = base + rise * 0.5 * spectral_noise(2, width, seed, slope=1.3)[0] * np.ones((height, 1))
        image = mix(image, colour, smoothstep(0.008, -0.004, v - line))
    water = smoothstep(0.385, 0.375, v)
    mirror = image[np.clip((2 * 0.38 * height - np.arange(height)).astype(int), 0, height - 1)]
    ripple = smoothstep(0.2, 1.4, spectral_noise(height, width, 11, slope=0.9, stretch=0.12))
    image = image * (1 - water[..., None]) + water[..., None] * mix(0.75 * mirror, (0.96, 0.72, 0.45), 0.35 * ripple)
    return np.clip(image * (1 + 0.06 * strokes[..., None]), 0, 1)


def carpet(height: int = 384, width: int = 512) -> np.ndarray:
    """Oriental rug: borders, lattice of rosettes, a medallion."""
    u, v = texel_grid(height, width)
    x, y = (u - 0.5) * width / height, v - 0.5
    edge = np.minimum(np.minimum(u, 1 - u) * width / height, np.minimum(v, 1 - v))
    red, navy, cream, gold = (0.45, 0.10, 0.09), (0.10, 0.13, 0.24), (0.84, 0.76, 0.60), (0.72, 0.50, 0.22)
    image = plain(height, width, red)
    a, r = np.arctan2(y, x), np.hypot(x * 0.8, y)
    cells = np.hypot(((x * 11) % 1 - 0.5), ((y * 11) % 1 - 0.5))
    image = mix(image, gold, smoothstep(0.30, 0.26, cells) * smoothstep(0.16, 0.20, cells))
    medallion = r - 0.22 - 0.03 * np.cos(12 * a)
    image = mix(image, navy, smoothstep(0.008, -0.004, medallion))
    image = mix(image, cream, smoothstep(0.012, 0.006, np.abs(medallion + 0.03)))
    image = mix(image, gold, smoothstep(0.006, -0.006, r - 0.10 - 0.03 * np.cos(8 * a)))
    image = mix(image, red, smoothstep(0.006, -0.006, r - 0.05))
    image = mix(image, navy, smoothstep(0.137, 0.133, edge))
    diamonds = np.abs(((u * 32) % 1) - 0.5) + np.abs(((v * 24) % 1) - 0.5)
    band = smoothstep(0.115, 0.112, edge) * smoothstep(0.035, 0.038, edge)
    image = mix(image, cream, band * smoothstep(0.34, 0.28, diamonds))
    image = mix(image, gold, band * smoothstep(0.14, 0.10, diamonds))
    image = mix(image, cream, smoothstep(0.020, 0.017, edge))
    return np.clip(image * (1 + 0.08 * spectral_noise(height, width, 13, slope=0.4)[..., None]), 0, 1)


def herringbone(size: int = 256) -> np.ndarray:
    """Tweed, tileable."""
    u, v = texel_grid(size, size)
    slope = np.where((u * 4) % 2 < 1, 1.0, -1.0)
    line = np.sin(2 * np.pi * (v * 16 + slope * u * 16))
    image = mix((0.42, 0.26, 0.17), (0.62, 0.43, 0.29), smoothstep(-0.6, 0.6, line))
    return np.clip(image * (1 + 0.10 * spectral_noise(size, size, 15, slope=0.4)[..., None]), 0, 1)

"""Images of ``build_drums.py``: colours, heights, normals. Arrays only (see `patterns`)."""

from __future__ import annotations

import numpy as np
from patterns import lattice_noise, mix, normals_from_height, plain, smoothstep, spectral_noise, texel_grid


def sparkle(size: int = 512) -> np.ndarray:
    """Glitter flakes in red lacquer, tileable: cells of random tone with bright grains."""
    rng = np.random.default_rng(3)
    cells = 160
    tone = rng.random((cells, cells))
    bright = np.where(rng.random((cells, cells)) > 0.86, rng.uniform(0.5, 1.0, (cells, cells)), 0.0)
    step = (np.arange(size) * cells) // size
    depth = np.clip(0.5 + 0.12 * spectral_noise(size, size, 4), 0, 1)
    image = mix((0.32, 0.01, 0.02), (0.62, 0.03, 0.05), 0.55 * tone[np.ix_(step, step)] + 0.45 * depth)
    return mix(image, (1.0, 0.55, 0.42), 0.8 * bright[np.ix_(step, step)])


def skin(size: int, seed: int, worn: float) -> np.ndarray:
    """Coated white skin seen from above: stick marks gathered about the middle, a maker's ring near the rim."""
    rng = np.random.default_rng(seed)
    u, v = texel_grid(size, size)
    x, y = 2 * u - 1, 2 * v - 1
    r = np.hypot(x, y)
    image = mix((0.90, 0.89, 0.86), (0.80, 0.79, 0.75), smoothstep(0.2, 1.6, np.abs(spectral_noise(size, size, seed))))
    dirt = np.zeros((size, size))
    for _ in range(int(90 * worn)):
        cx, cy = rng.normal(0, 0.22, 2)
        a = rng.uniform(0, np.pi)
        along = (x - cx) * np.cos(a) + (y - cy) * np.sin(a)
        across = -(x - cx) * np.sin(a) + (y - cy) * np.cos(a)
        spot = np.exp(-((along / rng.uniform(0.03, 0.10)) ** 2) - (across / rng.uniform(0.008, 0.02)) ** 2)
        dirt = np.maximum(dirt, rng.uniform(0.2, 0.6) * spot)
    image = mix(image, (0.33, 0.31, 0.30), np.clip(dirt + 0.25 * worn * np.exp(-((r / 0.3) ** 2)), 0, 1))
    return mix(image, (0.25, 0.25, 0.27), smoothstep(0.012, 0.006, np.abs(r - 0.90)))


def front_skin(size: int = 512) -> np.ndarray:
    """Printed kick-drum head: cream with a sunburst, rings and a bar of lozenges."""
    u, v = texel_grid(size, size)
    x, y = 2 * u - 1, 2 * v - 1
    r, a = np.hypot(x, y), np.arctan2(y, x)
    soft = 0.008
    image = plain(size, size, (0.93, 0.90, 0.80))
    navy, red, gold = (0.10, 0.13, 0.24), (0.70, 0.13, 0.10), (0.87, 0.64, 0.20)
    rays = smoothstep(-0.04, 0.04, np.cos(24 * a)) * smoothstep(0.30, 0.31, r) * smoothstep(0.66, 0.65, r)
    image = mix(image, gold, rays)
    for ring, width, colour in ((0.84, 0.05, navy), (0.74, 0.012, red), (0.70, 0.006, navy), (0.31, 0.016, navy)):
        image = mix(image, colour, smoothstep(width + soft, width - soft, np.abs(r - ring)))
    disc = smoothstep(0.28 + soft, 0.28 - soft, r)
    image = mix(image, red, disc)
    star = 0.20 * np.cos(np.pi / 5) / np.cos(((a - np.pi / 2) % (2 * np.pi / 5)) - np.pi / 5)
    wave = 0.5 + 0.5 * np.cos(5 * (a - np.pi / 2))
    image = mix(image, (0.95, 0.92, 0.84), disc * smoothstep(soft, -soft, r - star * (0.42 + 0.58 * wave**1.5)))
    for k in range(20):
        turn = (k + 0.5) * 2 * np.pi / 20
        px, py = x - 0.84 * np.cos(turn), y - 0.84 * np.sin(turn)
        along, across = px * np.cos(turn) + py * np.sin(turn), -px * np.sin(turn) + py * np.cos(turn)
        image = mix(image, gold, smoothstep(0.034, 0.024, np.abs(along) + 0.55 * np.abs(across)))
    return np.clip(image * (1 + 0.015 * spectral_noise(size, size, 8)[..., None]), 0, 1)


def grooves(height: int = 512, width: int = 32) -> np.ndarray:
    """Normal map of a lathe's traces, which run along u."""
    v = spectral_noise(height, 4, 12, slope=0.3)[:, :1]
    fine = np.sin(2 * np.pi * np.arange(height) / 6.0)[:, None]
    return normals_from_height(np.repeat(0.6 * v + 0.5 * fine, width, axis=1), 0.10)


def bronze(height: int = 256, width: int = 512) -> np.ndarray:
    """Cymbal bronze: tonal bands along v, hammer shadows and fingerprints."""
    u, v = texel_grid(height, width)
    circle_ = np.stack([np.cos(2 * np.pi * u), np.sin(2 * np.pi * u), 6 * v], axis=-1)
    blotch = lattice_noise(circle_, 3.0, 4, 5)
    bands = np.repeat(spectral_noise(height, 4, 6, slope=0.7)[:, :1], width, axis=1)
    tone = np.clip(0.5 + 0.5 * (blotch - 0.5) * 2 + 0.10 * bands, 0, 1)
    return mix((0.70, 0.50, 0.26), (0.95, 0.78, 0.47), tone)


def hammered(size: int = 256) -> np.ndarray:
    """Normal map of round hammer blows, tileable."""
    rng = np.random.default_rng(14)
    u, v = texel_grid(size, size)
    height = np.zeros((size, size))
    cells = 9
    for i in range(cells):
        for j in range(cells):
            cx, cy = (np.array([i, j]) + 0.5 + rng.uniform(-0.22, 0.22, 2)) / cells
            dx, dy = (u - cx + 0.5) % 1 - 0.5, (v - cy + 0.5) % 1 - 0.5
            height -= np.clip(1 - (np.hypot(dx, dy) * cells / 0.72) ** 2, 0, 1) ** 2
    return normals_from_height(height, 8.0)

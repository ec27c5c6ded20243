"""Images of ``build_food.py``: colours, heights, normals. Arrays only (see `patterns`)."""

from __future__ import annotations

import numpy as np
from patterns import mix, normals_from_height, plain, smoothstep, spectral_noise, texel_grid

CRUST = 0.66  # share of a bun's section that is crust, from one lip under the bread to the other


def bun_maps(height: int = 512, width: int = 512) -> tuple[np.ndarray, np.ndarray]:
    """Colour and normals of a bun, u around its section (crust first, then crumb), v along."""
    u, v = texel_grid(height, width)
    blotch = spectral_noise(height, width, 1, slope=1.6, lowest=2)
    fine = spectral_noise(height, width, 2, slope=0.8)
    across = np.clip(u / CRUST, 0, 1)
    up = np.abs(2 * across - 1)  # 1 at the lips, 0 underneath
    ends = smoothstep(0.22, 0.02, np.minimum(v, 1 - v))
    bake = np.clip(
        0.55 + 0.40 * np.exp(-(((up - 0.55) / 0.28) ** 2)) + 0.16 * blotch + 0.25 * ends - 0.55 * (up < 0.12), 0, 1
    )
    crust = mix((0.90, 0.70, 0.42), (0.60, 0.29, 0.09), smoothstep(0.15, 1.0, bake))
    holes = smoothstep(0.9, 1.7, spectral_noise(height, width, 3, slope=1.0, lowest=18))
    crumb = mix((0.95, 0.88, 0.72), (0.78, 0.63, 0.42), np.clip(0.75 * holes + 0.10 * fine + 0.1, 0, 1))
    seam = smoothstep(CRUST - 0.012, CRUST + 0.012, u) * smoothstep(1.0, 0.985, u)
    colour = mix(crust * (1 + 0.02 * fine[..., None]), crumb, seam)
    bumps = 0.25 * blotch + 0.05 * fine
    return np.clip(colour, 0, 1), normals_from_height(mix1(bumps, -2.2 * holes + 0.12 * fine, seam), 0.9)


def mix1(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Blend values [H, W] by ``t``."""
    return a + (b - a) * t


def sausage_maps(height: int = 512, width: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """Colour with grill marks and normals with wrinkles, u around, v along."""
    u, v = texel_grid(height, width)
    blotch = spectral_noise(height, width, 5, slope=1.5, lowest=2)
    colour = mix((0.74, 0.31, 0.17), (0.52, 0.17, 0.09), np.clip(0.45 + 0.28 * blotch, 0, 1))
    phase = v * 9 + 0.9 * u + 0.03 * blotch
    bars = smoothstep(0.16, 0.08, np.abs((phase % 1) - 0.5)) * smoothstep(0.10, 0.16, np.abs(u - 0.5) * 0.5 + 0.06)
    char = np.clip(bars * (0.75 + 0.25 * spectral_noise(height, width, 6, slope=0.8)), 0, 1)
    colour = mix(colour, (0.13, 0.05, 0.03), 0.85 * char)
    tips = smoothstep(0.06, 0.0, np.minimum(v, 1 - v))
    colour = mix(colour, (0.40, 0.13, 0.07), 0.7 * tips)
    wrinkle = spectral_noise(height, width, 7, slope=1.0, lowest=6, stretch=0.35)
    return np.clip(colour, 0, 1), normals_from_height(0.25 * wrinkle - 0.9 * char, 0.8)


def plate_map(height: int = 512, width: int = 512) -> np.ndarray:
    """Ivory glaze seen from above with blue sprigs and bands about the rim."""
    u, v = texel_grid(height, width)
    x, y = 2 * u - 1, 2 * v - 1
    r, a = np.hypot(x, y), np.arctan2(y, x)
    image = mix((0.94, 0.93, 0.88), (0.90, 0.89, 0.83), np.clip(0.5 + 0.3 * spectral_noise(height, width, 8), 0, 1))
    blue = (0.13, 0.25, 0.52)
    ink = smoothstep(0.008, 0.003, np.abs(r - 0.965)) + smoothstep(0.006, 0.002, np.abs(r - 0.725))
    stem = np.abs(r - 0.845 - 0.035 * np.sin(a * 18))
    ink += smoothstep(0.010, 0.004, stem) + 0.0
    for shift, rise in ((0.25, 0.055), (0.75, -0.055)):
        turn = ((a / (2 * np.pi) * 18 + shift) % 1 - 0.5) * 2 * np.pi / 18
        px, py = 0.845 * turn, r - 0.845 - 0.0 - rise * 0.35
        petals = 0.028 + 0.012 * np.cos(5 * np.arctan2(py, px))
        ink += smoothstep(0.006, -0.004, np.hypot(px, py) - petals)
    return mix(image, blue, np.clip(ink, 0, 1) * (0.85 + 0.15 * np.tanh(spectral_noise(height, width, 9))))


def napkin_map(size: int = 256) -> np.ndarray:
    """Red gingham, tileable: four checks of two crossing bands."""
    u, v = texel_grid(size, size)
    bands = ((np.floor(u * 2) % 2) + (np.floor(v * 2) % 2)) / 2
    fibre = spectral_noise(size, size, 10, slope=0.3)
    return np.clip(mix((0.93, 0.91, 0.87), (0.70, 0.10, 0.09), bands) * (1 + 0.04 * fibre[..., None]), 0, 1)


def lettuce_map(size: int = 256) -> np.ndarray:
    """Frilled leaf: pale rib below (v = 0), bright frill above."""
    u, v = texel_grid(size, size)
    veins = np.exp(-((np.sin(u * 40 + 6 * v + spectral_noise(size, size, 12)) / 0.35) ** 2)) * (1 - v)
    tone = np.clip(v + 0.12 * spectral_noise(size, size, 11), 0, 1)
    return mix(mix((0.78, 0.86, 0.52), (0.26, 0.52, 0.10), smoothstep(0.1, 0.9, tone)), (0.86, 0.92, 0.66), 0.5 * veins)


def fry_map(height: int = 256, width: int = 64) -> np.ndarray:
    """Golden potato, darker towards the ends, v along."""
    _, v = texel_grid(height, width)
    noise = spectral_noise(height, width, 13, slope=1.3)
    tone = np.clip(0.35 + 0.20 * noise + 0.6 * smoothstep(0.16, 0.0, np.minimum(v, 1 - v)), 0, 1)
    return mix((0.96, 0.80, 0.40), (0.72, 0.42, 0.12), tone)


def box_print(size: int = 256) -> np.ndarray:
    """Red and white stripes with a yellow band and disc."""
    u, v = texel_grid(size, size)
    image = mix((0.94, 0.92, 0.88), (0.74, 0.09, 0.08), smoothstep(-0.06, 0.06, np.sin(2 * np.pi * 5 * u)))
    image = mix(image, (0.95, 0.75, 0.20), smoothstep(0.27, 0.262, np.hypot(u - 0.5, v - 0.5)))
    image = mix(image, (0.74, 0.09, 0.08), smoothstep(0.21, 0.202, np.hypot(u - 0.5, v - 0.5)))
    star = np.cos(np.pi / 5) / np.cos((np.arctan2(u - 0.5, v - 0.5) % (2 * np.pi / 5)) - np.pi / 5)
    return mix(image, (0.96, 0.94, 0.88), smoothstep(0.004, -0.004, np.hypot(u - 0.5, v - 0.5) - 0.13 * star))


def gherkin_map(size: int = 128) -> np.ndarray:
    """Slice from above: pale flesh with seeds, dark skin."""
    u, v = texel_grid(size, size)
    x, y = 2 * u - 1, 2 * v - 1
    r, a = np.hypot(x, y), np.arctan2(y, x)
    seeds = (
        smoothstep(0.05, 0.02, np.abs(r - 0.42) - 0.12)
        * smoothstep(0.2, 0.7, np.cos(13 * a))
        * smoothstep(0.0, 0.5, np.cos(3 * a) + 0.4)
    )
    image = mix(plain(size, size, (0.66, 0.72, 0.32)), (0.84, 0.84, 0.56), np.clip(seeds, 0, 1))
    return mix(image, (0.22, 0.32, 0.08), smoothstep(0.86, 0.93, r))

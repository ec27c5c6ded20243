"""The pictures of `ship`: hull, stern, sails, sand, marble. Display-encoded arrays, rows bottom first; no Blender."""

from __future__ import annotations

import numpy as np
from patterns import mix, plain, smoothstep, spectral_noise, texel_grid


def hull_planks(width: int = 1024, height: int = 256) -> np.ndarray:
    """Strakes along u from keel (v = 0) to rail: coppered below, then black, an ochre band with gunports, red rail."""
    u, v = texel_grid(height, width)
    grain = spectral_noise(width, height, 61, slope=0.9, stretch=14.0).T
    strakes = v * 22
    tone = np.random.default_rng(6).normal(0, 0.05, 22)[np.floor(strakes).astype(int)] + 0.05 * grain
    image = plain(height, width, (0.16, 0.11, 0.08))
    image = mix(image, (0.42, 0.30, 0.20), smoothstep(0.42, 0.43, v) * smoothstep(0.56, 0.55, v))
    image = mix(image, (0.80, 0.58, 0.22), smoothstep(0.61, 0.615, v) * smoothstep(0.775, 0.77, v))
    image = mix(image, (0.50, 0.10, 0.08), smoothstep(0.90, 0.905, v))
    image = mix(image, (0.33, 0.40, 0.34), smoothstep(0.30, 0.29, v + 0.012 * grain))
    image = image * (1 + 1.4 * tone)[..., None]
    seams = smoothstep(0.93, 0.98, np.abs(strakes % 1 - 0.5) * 2)
    image = mix(image, (0.05, 0.035, 0.03), 0.8 * seams)
    ports = np.maximum(np.abs((u * 15) % 1 - 0.5) * 4.4, np.abs(v - 0.692) / 0.036)
    ports = np.where((u > 0.12) & (u < 0.88), ports, 9.0)
    image = mix(image, (0.30, 0.09, 0.06), smoothstep(1.25, 1.2, ports))
    return np.clip(mix(image, (0.015, 0.013, 0.012), smoothstep(1.0, 0.95, ports)), 0, 1)


def stern_gallery(size: int = 256) -> np.ndarray:
    """Carved transom with two rows of lit windows, [N, N, 3]."""
    u, v = texel_grid(size, size)
    image = plain(size, size, (0.30, 0.16, 0.09)) * (1 + 0.12 * spectral_noise(size, size, 62, slope=1.0))[..., None]
    for row, count in ((0.60, 5), (0.80, 4)):
        x, y = (u * (count + 1)) % 1 - 0.5, (v - row) / 0.13
        frame = np.maximum(np.abs(x) / 0.34, np.abs(y) / 0.5)
        keep = ((u > 0.5 / (count + 1)) & (u < 1 - 0.5 / (count + 1))).astype(float)
        image = mix(image, (0.83, 0.63, 0.25), keep * smoothstep(1.02, 0.96, frame))
        pane = keep * smoothstep(0.80, 0.74, frame) * smoothstep(0.02, 0.05, np.minimum(np.abs(x), np.abs(y) * 0.4))
        image = mix(image, (0.95, 0.82, 0.52), pane)
    for band in (0.44, 0.70, 0.90):
        image = mix(image, (0.83, 0.63, 0.25), smoothstep(0.014, 0.010, np.abs(v - band)))
    return np.clip(image, 0, 1)


def sailcloth(emblem: bool, size: int = 256) -> np.ndarray:
    """Sewn canvas with reef bands, and a red sun on the main sail, [N, N, 3]."""
    u, v = texel_grid(size, size)
    fold = spectral_noise(size, size, 63, slope=1.7, stretch=2.5)
    image = plain(size, size, (0.90, 0.85, 0.74)) * (1 + 0.03 * fold)[..., None]
    seam = np.abs((u * 9) % 1 - 0.5)
    image = mix(image, (0.68, 0.60, 0.47), 0.6 * smoothstep(0.465, 0.485, seam))
    for band in (0.72, 0.86):
        image = mix(image, (0.76, 0.69, 0.56), smoothstep(0.012, 0.008, np.abs(v - band)))
    if emblem:
        x, y = u * 2 - 1, (v * 2 - 0.86)
        radius, angle = np.hypot(x, y), np.arctan2(y, x)
        disc = smoothstep(0.01, -0.01, radius - 0.30)
        rays = smoothstep(0.01, -0.01, np.abs(radius - 0.46) - 0.10 * (np.cos(6 * angle) > 0.35))
        image = mix(image, (0.66, 0.10, 0.08), np.clip(disc + rays, 0, 1) * 0.92)
    return np.clip(image, 0, 1)


def sand(size: int = 512) -> tuple[np.ndarray, np.ndarray]:
    """Rippled sea bed, tileable: colour [N, N, 3] and height [N, N]."""
    _, v = texel_grid(size, size)
    bend = spectral_noise(size, size, 64, slope=2.0)
    ripple = 0.5 + 0.5 * np.sin(2 * np.pi * (v * 26) + 1.6 * bend)
    grain = spectral_noise(size, size, 65, slope=0.3)
    image = mix(plain(size, size, (0.74, 0.65, 0.48)), (0.90, 0.83, 0.67), ripple)
    return np.clip(image * (1 + 0.035 * grain + 0.04 * bend)[..., None], 0, 1), ripple


def marble(width: int = 512, height: int = 256) -> np.ndarray:
    """Pale marble with grey veins, [H, W, 3]."""
    fold = spectral_noise(height, width, 66, slope=1.9)
    vein = np.exp(-np.abs(spectral_noise(height, width, 67, slope=1.7) + 0.3 * fold) * 9)
    tone = 0.025 * fold
    return np.clip(
        mix(plain(height, width, (0.86, 0.84, 0.80)), (0.42, 0.43, 0.45), 0.75 * vein) + tone[..., None], 0, 1
    )

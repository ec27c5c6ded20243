"""Images made of arithmetic: noise, cloth, wood, skies. Arrays only, no Blender.

Images are float64 [H, W] or [H, W, 3], rows bottom first like Blender's. Colours are display-encoded
unless a docstring says linear.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Rgb = tuple[float, float, float]


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Hermite step from 0 at ``low`` to 1 at ``high``."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def plain(height: int, width: int, colour: Rgb) -> np.ndarray:
    """An image of one colour, [H, W, 3]."""
    return np.broadcast_to(np.asarray(colour), (height, width, 3)).copy()


def mix(a: np.ndarray | Rgb, b: np.ndarray | Rgb, t: np.ndarray) -> np.ndarray:
    """Blend colours [..., 3] by ``t`` [...]."""
    return np.asarray(a) + (np.asarray(b) - np.asarray(a)) * t[..., None]


def texel_grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """(u, v) in (0, 1) of texel centres, each [H, W]."""
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    return u, v


def lattice_noise(points: np.ndarray, frequency: float, octaves: int, seed: int) -> np.ndarray:
    """Fractal value noise in [0, 1] at ``points`` [..., 3], trilinear with smoothstep, period 64."""
    total = np.zeros(points.shape[:-1])
    weight = 0.0
    for octave in range(octaves):
        lattice = np.random.default_rng(seed + octave).random((64, 64, 64))
        scaled = points * frequency * 2**octave + 17.3 * octave
        base = np.floor(scaled).astype(int)
        t = scaled - base
        t = t * t * (3 - 2 * t)
        value = np.zeros(points.shape[:-1])
        for dx in (0, 1):
            for dy in (0, 1):
                for dz in (0, 1):
                    corner = lattice[(base[..., 0] + dx) % 64, (base[..., 1] + dy) % 64, (base[..., 2] + dz) % 64]
                    share = np.ones(points.shape[:-1])
                    for axis, d in enumerate((dx, dy, dz)):
                        share = share * (t[..., axis] if d else 1 - t[..., axis])
                    value += corner * share
        total += value * 0.5**octave
        weight += 0.5**octave
    return total / weight


def spectral_noise(
    height: int, width: int, seed: int, *, slope: float = 1.6, lowest: float = 1.0, stretch: float = 1.0
) -> np.ndarray:
    """Tileable Gaussian noise with an amplitude spectrum f^-slope above ``lowest`` cycles, mean 0, deviation 1.

    ``stretch`` > 1 makes features that much longer along v (wood grain, brushed metal).
    """
    rng = np.random.default_rng(seed)
    fx, fy = np.meshgrid(np.fft.fftfreq(width) * width, np.fft.fftfreq(height) * height)
    f = np.hypot(fx, fy * stretch)
    gain = np.where(f < lowest, 0.0, np.maximum(f, 1e-9) ** -slope)
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal((height, width))) * gain).real
    return noise / noise.std()


def normals_from_height(height: np.ndarray, strength: float) -> np.ndarray:
    """Tangent-space normal map [H, W, 3] of a tileable height field [H, W], raw values in [0, 1], green up."""
    dx = np.roll(height, -1, 1) - np.roll(height, 1, 1)
    dy = np.roll(height, -1, 0) - np.roll(height, 1, 0)
    normal = np.stack([-dx * strength, -dy * strength, np.ones_like(dx)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return normal * 0.5 + 0.5


def weave(size: int, threads: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Plain weave, tileable: (height [N, N] in [0, 1], warp mask [N, N], 1 where the vertical thread is on top)."""
    u, v = texel_grid(size, size)
    x, y = u * threads, v * threads
    over = (np.floor(x) + np.floor(y)) % 2
    across_x, across_y = np.abs(x % 1 - 0.5) * 2, np.abs(y % 1 - 0.5) * 2
    warp = np.sqrt(np.clip(1 - across_x**2, 0, 1)) * (0.65 + 0.35 * np.cos(across_y * np.pi / 2))
    weft = np.sqrt(np.clip(1 - across_y**2, 0, 1)) * (0.65 + 0.35 * np.cos(across_x * np.pi / 2))
    height = np.where(over > 0, warp, weft)
    fibre = spectral_noise(size, size, seed, slope=0.6)
    return np.clip(height * (0.92 + 0.08 * fibre), 0, 1), over


def wood(height: int, width: int, seed: int, dark: Rgb, light: Rgb, rings: float = 9.0) -> np.ndarray:
    """Planed wood, tileable, grain along v: growth rings bent by noise, with fine pores. [H, W, 3]."""
    u, _ = texel_grid(height, width)
    bend = spectral_noise(height, width, seed, slope=2.2, stretch=5.0)
    phase = u * rings + 0.55 * bend
    ring = phase - np.floor(phase)
    grain = smoothstep(0.0, 0.75, ring) * smoothstep(1.0, 0.88, ring)
    pores = spectral_noise(height, width, seed + 1, slope=0.5, stretch=14.0)
    tone = np.clip(0.15 + 0.62 * (1 - grain) + 0.10 * pores + 0.10 * bend, 0, 1)
    return mix(light, dark, tone)


def planks(size: int, seed: int, dark: Rgb, light: Rgb, count: int = 6, lengths: int = 2) -> np.ndarray:
    """Floor boards along v, tileable: ``count`` across, ``lengths`` along, each its own cut of wood. [N, N, 3]."""
    rng = np.random.default_rng(seed)
    source = wood(size, size, seed, dark, light, rings=5.0)
    u, v = texel_grid(size, size)
    column = np.floor(u * count).astype(int)
    shifted = v * lengths + rng.random(count)[column]
    board = column * (lengths + 1) + np.floor(shifted).astype(int) % lengths
    total = count * (lengths + 1)
    rows = (np.arange(size)[:, None] + rng.integers(0, size, total)[board]) % size
    columns = (np.arange(size)[None, :] + rng.integers(0, size, total)[board]) % size
    image = source[rows, columns] * rng.uniform(0.82, 1.12, total)[board][..., None]
    gap_u = np.abs(u * count - np.round(u * count)) / count
    gap_v = np.abs(shifted - np.round(shifted)) / lengths
    seam = np.maximum(smoothstep(0.0035, 0.0015, gap_u), smoothstep(0.003, 0.001, gap_v))
    return np.clip(image * (1 - 0.75 * seam[..., None]), 0, 1)


SoftBox = tuple[float, float, float, float, Rgb]
"""Azimuth, elevation, half width, half height in degrees; linear radiance."""


def studio_sky(
    boxes: Sequence[SoftBox],
    zenith: Rgb = (0.34, 0.50, 0.80),
    horizon: Rgb = (0.62, 0.66, 0.74),
    ground: Rgb = (0.42, 0.37, 0.32),
    strength: float = 0.36,
    width: int = 256,
) -> np.ndarray:
    """Linear radiance [width/2, width, 3] of a gradient sky with blurred soft boxes.

    Directions follow Blender's equirectangular map: u = 0.5 - atan2(y, x) / 2 pi.
    """
    u, v = texel_grid(width // 2, width)
    azimuth = (0.5 - u) * 2 * np.pi
    elevation = (v - 0.5) * np.pi
    sky = plain(width // 2, width, horizon)
    sky = mix(sky, zenith, smoothstep(0.0, 1.2, elevation))
    sky = mix(sky, ground, smoothstep(0.05, -0.35, elevation))
    sky *= strength
    for centre, lift, half_width, half_height, radiance in boxes:
        turn = (azimuth - np.radians(centre) + np.pi) % (2 * np.pi) - np.pi
        x = np.abs(turn) * np.cos(elevation) / np.radians(half_width)
        y = np.abs(elevation - np.radians(lift)) / np.radians(half_height)
        inside = smoothstep(1.12, 0.88, x) * smoothstep(1.12, 0.88, y)
        sky = sky + inside[..., None] * np.array(radiance)
    return sky

"""Tileable pictures by seed: a colour [N, N, 3], display-encoded, and a height [N, N] in [0, 1]. Arrays only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from patterns import mix, plain, planks, smoothstep, spectral_noise, texel_grid, weave, wood

from factory.dice import Dice, scaled

SIZE = 256
Picture = tuple[np.ndarray, np.ndarray]


def _unit(noise: np.ndarray, contrast: float = 0.22) -> np.ndarray:
    """Noise of mean 0 and deviation 1 to [0, 1]."""
    return np.clip(0.5 + contrast * noise, 0, 1)


def _noise(dice: Dice, slope: float, lowest: float = 2.0, stretch: float = 1.0) -> np.ndarray:
    return spectral_noise(SIZE, SIZE, dice.seed(), slope=slope, lowest=lowest, stretch=stretch)


def _cells(dice: Dice, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Voronoi cells on a torus: distance to the nearest and the second seed, index of the nearest."""
    u, v = (c.astype(np.float32) for c in texel_grid(SIZE, SIZE))
    first, second = np.full((SIZE, SIZE), 9.0, np.float32), np.full((SIZE, SIZE), 9.0, np.float32)
    owner = np.zeros((SIZE, SIZE), dtype=int)
    for k, (cx, cy) in enumerate(dice.rng.random((count, 2)).astype(np.float32)):
        far = np.hypot((u - cx + 0.5) % 1 - 0.5, (v - cy + 0.5) % 1 - 0.5)
        closer = far < first
        second = np.where(closer, first, np.minimum(second, far))
        owner = np.where(closer, k, owner)
        first = np.where(closer, far, first)
    return first, second, owner


def boards(dice: Dice) -> Picture:
    """Planed wood or a floor of it."""
    light = dice.pick([(0.62, 0.44, 0.27), (0.78, 0.63, 0.45), (0.45, 0.29, 0.19), (0.72, 0.66, 0.58)])
    light = dice.near(light, 0.08)
    dark = scaled(light, dice.uniform(0.45, 0.75))
    if dice.chance(0.5):
        colour = planks(SIZE, dice.seed(), dark, light, dice.whole(3, 8), dice.whole(1, 3))
    else:
        colour = wood(SIZE, SIZE, dice.seed(), dark, light, dice.uniform(3, 12))
    return colour, np.clip(colour.mean(axis=-1) * 1.3, 0, 1)


def cloth(dice: Dice) -> Picture:
    """Plain weave of two threads, maybe with broad stripes."""
    height, over = weave(SIZE, dice.pick([16, 24, 32]), dice.seed())
    warp = dice.shown()
    weft = dice.near(warp, 0.25) if dice.chance(0.6) else dice.shown()
    colour = mix(plain(SIZE, SIZE, weft), warp, over)
    if dice.chance(0.35):
        u, _ = texel_grid(SIZE, SIZE)
        colour = mix(colour, dice.shown(), ((u * dice.whole(1, 4)) % 1 < dice.uniform(0.2, 0.5)) * 0.85)
    return colour * (0.55 + 0.45 * height[..., None]), height


def checks(dice: Dice) -> Picture:
    """Chequerboard, stripes or gingham."""
    u, v = texel_grid(SIZE, SIZE)
    a, b = dice.shown(), dice.shown()
    across = dice.whole(2, 8)
    x, y = np.floor(u * 2 * across) % 2, np.floor(v * 2 * across) % 2
    kind = dice.pick(["board", "stripes", "gingham"])
    share = {"board": (x + y) % 2, "stripes": x, "gingham": 0.5 * (x + y)}[kind]
    return mix(plain(SIZE, SIZE, a), b, share) * (0.95 + 0.05 * _unit(_noise(dice, 0.8)))[..., None], share * 0.3


def dots(dice: Dice) -> Picture:
    """Rows of dots or rings."""
    u, v = texel_grid(SIZE, SIZE)
    across = 2 * dice.whole(2, 6)
    row = np.floor(v * across)
    far = np.hypot((u * across + 0.5 * (row % 2)) % 1 - 0.5, (v * across) % 1 - 0.5)
    size = dice.uniform(0.18, 0.42)
    share = smoothstep(size + 0.03, size - 0.03, far)
    if dice.chance(0.4):
        share = share * smoothstep(size * 0.5 - 0.03, size * 0.5 + 0.03, far)
    return mix(plain(SIZE, SIZE, dice.shown()), dice.shown(), share), share


def tiles(dice: Dice) -> Picture:
    """Square tiles or bricks with grout, each of its own tone."""
    u, v = texel_grid(SIZE, SIZE)
    across, down = (dice.whole(2, 8),) * 2 if dice.chance(0.5) else (dice.whole(2, 4), 2 * dice.whole(3, 6))
    row = np.floor(v * down)
    x = u * across + (0.5 * (row % 2) if down != across else 0)
    tone = dice.rng.uniform(-1, 1, (down, across))[row.astype(int), np.floor(x).astype(int) % across]
    face = dice.shown((0.0, 0.65))
    other = dice.near(face, 0.3)
    stone = mix(plain(SIZE, SIZE, face), other, 0.5 + 0.5 * tone) * (0.9 + 0.2 * _unit(_noise(dice, 1.0)))[..., None]
    width = dice.uniform(0.01, 0.05)
    edge = np.minimum(0.5 - np.abs(x % 1 - 0.5), (0.5 - np.abs(v * down % 1 - 0.5)) * across / down)
    body = smoothstep(width * 0.6, width * 1.4, edge)
    return np.clip(mix(plain(SIZE, SIZE, dice.shown((0.0, 0.2), (0.2, 0.8))), stone, body), 0, 1), body


def marble(dice: Dice) -> Picture:
    """Veined stone."""
    folds = np.abs(_noise(dice, 1.9, 1.0))
    vein = np.exp(-folds * dice.uniform(4, 12)) * _unit(_noise(dice, 1.6), 0.4)
    cloud = _unit(_noise(dice, 1.8, 1.0))
    base = dice.shown((0.0, 0.3), (0.3, 0.95))
    colour = mix(
        mix(plain(SIZE, SIZE, base), dice.near(base, 0.15), cloud), dice.shown((0.0, 0.5)), np.clip(vein, 0, 1)
    )
    return colour, cloud * 0.2


def chips(dice: Dice) -> Picture:
    """Terrazzo, cobbles or mosaic: cells of several colours in a binder."""
    first, second, owner = _cells(dice, dice.whole(20, 90))
    palette = np.array([dice.shown((0.0, 0.6)) for _ in range(5)])
    colour = palette[dice.rng.integers(0, 5, 100)[owner]]
    gap = dice.uniform(0.002, 0.02)
    body = smoothstep(gap * 0.5, gap * 1.5, second - first)
    return mix(plain(SIZE, SIZE, dice.shown((0.0, 0.3))), colour, body), body * (1 - 4 * np.clip(first, 0, 0.2))


def blotches(dice: Dice) -> Picture:
    """Soft noise between two or three colours: plaster, paint, camouflage, rust."""
    coarse, fine = _noise(dice, dice.uniform(1.2, 2.2), 1.0), _noise(dice, 0.8)
    a = dice.shown()
    near = dice.chance(0.6)
    b, c = (dice.near(a, 0.15), dice.near(a, 0.25)) if near else (dice.shown(), dice.shown())
    first = _unit(coarse, 0.3)
    if dice.chance(0.35):
        first = smoothstep(0.45, 0.55, first)
    return mix(mix(plain(SIZE, SIZE, a), b, first), c, 0.4 * _unit(fine)), np.clip(
        0.6 * first + 0.4 * _unit(fine), 0, 1
    )


def grit(dice: Dice) -> Picture:
    """Sand, soil, asphalt, short grass from far: fine noise of high contrast."""
    fine, coarse = _noise(dice, dice.uniform(0.1, 0.6)), _unit(_noise(dice, 1.6, 1.0))
    base = dice.pick([(0.66, 0.57, 0.43), (0.34, 0.27, 0.2), (0.3, 0.3, 0.31), (0.3, 0.42, 0.16), (0.75, 0.74, 0.72)])
    colour = mix(plain(SIZE, SIZE, dice.near(base, 0.1)), dice.near(base, 0.2), coarse)
    height = _unit(fine, 0.25)
    return np.clip(colour * (0.55 + 0.8 * height)[..., None], 0, 1), height


def painting(dice: Dice) -> Picture:
    """Overlapping shapes and lines of print: posters, labels, toys."""
    u, v = texel_grid(SIZE, SIZE)
    image = plain(SIZE, SIZE, dice.shown())
    height = np.zeros((SIZE, SIZE))
    for _ in range(dice.whole(4, 14)):
        cx, cy, w, h = dice.rng.uniform([0.1, 0.1, 0.03, 0.03], [0.9, 0.9, 0.35, 0.35])
        x, y = np.abs(u - cx) / w, np.abs(v - cy) / h
        far = dice.pick([np.maximum(x, y), np.hypot(x, y), x + y])
        inside = smoothstep(1.03, 0.97, far)
        image = mix(image, dice.shown(), inside)
        height = np.maximum(height, inside * dice.uniform(0, 0.4))
    if dice.chance(0.5):
        left, low, lines = dice.uniform(0.05, 0.4), dice.uniform(0.05, 0.5), dice.whole(3, 8)
        line = np.floor((v - low) * 36)
        ink = dice.rng.random((40, 64)) < 0.75
        on = ink[line.astype(int) % 40, np.floor(u * 64).astype(int)] & ((v - low) * 36 % 1 < 0.55)
        on &= (line >= 0) & (line < lines) & (u > left) & (u < left + 0.5)
        image = mix(image, dice.shown(), on * 1.0)
    return image, height


def ornament(dice: Dice) -> Picture:
    """Carpets, rosettes and prints: bands of strong colours with bent edges, and a lattice of motifs on them.

    Fine and sharp, so that some of it is smaller than a pixel.
    """
    u, v = texel_grid(SIZE, SIZE)
    palette = np.array([dice.shown() for _ in range(dice.whole(3, 6))])
    if dice.chance(0.5):  # round a centre
        x, y = 2 * np.hypot(u - 0.5, v - 0.5), np.arctan2(v - 0.5, u - 0.5) / (2 * np.pi) * dice.whole(1, 4)
    else:
        x, y = u, v
    bands, waves = dice.whole(5, 28), dice.whole(4, 24)
    wave = dice.pick([np.abs((y * waves) % 1 - 0.5), 0.25 + 0.25 * np.sin(2 * np.pi * waves * y), np.zeros_like(y)])
    along = x * bands + dice.uniform(0, 2) * wave
    colour = palette[dice.rng.integers(0, len(palette), 64)[np.floor(along).astype(int) % 64]]
    if dice.chance(0.6):
        count = dice.whole(4, 20)
        across, down = np.abs((u * count) % 1 - 0.5), np.abs((v * count) % 1 - 0.5)
        far = dice.pick([across + down, np.hypot(across, down), np.maximum(across, down)])
        colour = mix(colour, palette[0], (far < dice.uniform(0.15, 0.4)) * 1.0)
        colour = mix(colour, palette[1], (far < dice.uniform(0.05, 0.15)) * 1.0)
    return colour, colour.mean(axis=-1) * 0.3


def mosaic(dice: Dice) -> Picture:
    """Small squares of few colours: mosaic, knitting, pebbles, flower beds from far."""
    count = dice.pick([16, 32, 64, 128])
    base = dice.shown()
    palette = np.array([dice.near(base, 0.5) if dice.chance(0.5) else dice.shown() for _ in range(dice.whole(2, 6))])
    cells = dice.rng.integers(0, len(palette), (count, count))
    if dice.chance(0.4):  # mirrored, as embroidery is
        cells = np.concatenate([cells[:, : count // 2], cells[:, : count // 2][:, ::-1]], axis=1)
    whole = np.kron(cells, np.ones((SIZE // count, SIZE // count), dtype=int))
    return palette[whole], palette[whole].mean(axis=-1) * 0.5


def ribs(dice: Dice) -> Picture:
    """Ridges: corrugated card, cord, knurling."""
    u, v = texel_grid(SIZE, SIZE)
    count = dice.whole(6, 24)
    height = 0.5 + 0.5 * np.cos(2 * np.pi * count * u)
    if dice.chance(0.4):
        height = height * (0.5 + 0.5 * np.cos(2 * np.pi * count * v))
    base = dice.shown()
    return mix(plain(SIZE, SIZE, base), dice.near(base, 0.12), height), height


PATTERNS: dict[Callable[[Dice], Picture], float] = {
    boards: 2.0,
    cloth: 1.5,
    checks: 1.0,
    dots: 0.8,
    tiles: 1.5,
    marble: 1.0,
    chips: 1.2,
    blotches: 2.0,
    grit: 1.2,
    painting: 1.6,
    ornament: 4.0,
    mosaic: 2.0,
    ribs: 0.7,
}


def wear(dice: Dice) -> np.ndarray:
    """Where a coating has gone, [N, N] in [0, 1]."""
    level = dice.uniform(0.4, 0.75)
    return smoothstep(level - 0.04, level + 0.04, _unit(_noise(dice, 1.5, 1.0)))


def smudges(dice: Dice) -> np.ndarray:
    """A roughness picture: finger marks, brushing or scratches about a mean."""
    middle = dice.log(0.08, 0.5)
    noise = dice.pick([_noise(dice, 1.6, 1.0), _noise(dice, 0.5, 2.0, 14.0), _noise(dice, 0.9)])
    return np.clip(middle * (1 + 0.45 * noise), 0.02, 1)


def leaf(dice: Dice, size: int = 128) -> np.ndarray:
    """One leaf, flower or blade with alpha, base at the bottom, [N, N, 4]."""
    u, v = texel_grid(size, size)
    x = np.abs(2 * u - 1)
    green = dice.pick([(0.2, 0.42, 0.12), (0.35, 0.5, 0.15), (0.55, 0.45, 0.15), (0.6, 0.2, 0.12), (0.16, 0.34, 0.2)])
    light, dark = dice.near(green, 0.12), scaled(green, 0.6)
    kind = dice.pick(["oval", "lobed", "blade", "fern", "flower"])
    if kind == "oval":
        outline = dice.uniform(0.4, 0.9) * np.sin(np.pi * np.clip(v, 0, 1) ** dice.uniform(0.6, 1.1)) ** 0.8
        alpha = x < outline
    elif kind == "lobed":
        outline = 0.75 * np.sin(np.pi * v**0.8) * (0.7 + 0.3 * np.cos(v * dice.whole(4, 8) * 2 * np.pi))
        alpha = x < np.maximum(outline, 0.04 * (v < 0.3))
    elif kind == "blade":
        alpha = x < 0.28 * (1 - v) ** 0.6
    elif kind == "fern":
        comb = (v * dice.whole(8, 14) - 0.6 * x) % 1 < 0.62
        alpha = (x < 0.04) | (comb & (x < 0.9 * (1 - v) ** 0.7))
    else:
        turn, far = np.arctan2(v - 0.6, u - 0.5), np.hypot(v - 0.6, u - 0.5)
        petals = 0.22 + 0.14 * np.cos(dice.whole(4, 8) * turn)
        alpha = (far < petals) | ((x < 0.05) & (v < 0.6))
        bloom = dice.shown((0.4, 0.9), (0.6, 0.95))
        colour = np.where((far < petals)[..., None], np.array(bloom), np.array(green))
        colour = np.where((far < 0.08)[..., None], np.array((0.9, 0.75, 0.2)), colour)
        return np.concatenate([colour, alpha[..., None] * 1.0], axis=-1)
    vein = np.exp(-((x / 0.05) ** 2)) + 0.5 * np.exp(-((((v - 0.35 * x) * 9 % 1 - 0.5) / 0.1) ** 2))
    tone = np.clip(0.5 + 0.2 * spectral_noise(size, size, dice.seed(), slope=1.4), 0, 1)
    colour = mix(mix(plain(size, size, light), dark, tone), (0.65, 0.72, 0.4), np.clip(0.5 * vein, 0, 1))
    return np.concatenate([np.clip(colour, 0, 1), alpha[..., None] * 1.0], axis=-1)


def net(dice: Dice, size: int = 128) -> np.ndarray:
    """Lace, mesh or slats with holes, [N, N, 4]."""
    u, v = texel_grid(size, size)
    count = dice.whole(3, 9)
    x, y = (u * count) % 1 - 0.5, (v * count) % 1 - 0.5
    open_share = dice.uniform(0.25, 0.42)
    hole = dice.pick(
        [np.hypot(x, y) < open_share, np.maximum(np.abs(x), np.abs(y)) < open_share, np.abs(x) < open_share]
    )
    colour = plain(size, size, dice.shown())
    return np.concatenate([colour, (~hole)[..., None] * 1.0], axis=-1)

"""The hull of `ship`: lines (beam, sheer, keel) over t in [-1, 1] from stern to stem, lofted into one closed body."""

from __future__ import annotations

import numpy as np
from patterns import smoothstep
from solids import Shape, grid, join

LENGTH = 0.78  # half of the hull


def half_beam(t: np.ndarray) -> np.ndarray:
    """Half width of the hull at t in [-1, 1] from stern to stem."""
    return np.where(t > 0, 0.2 * np.clip(1 - np.abs(t) ** 2.6, 0, 1) ** 0.8, 0.2 * (1 - 0.30 * t**2)) + 0.005


def sheer(t: np.ndarray) -> np.ndarray:
    """Height of the rail: a curve, a forecastle and a stepped quarterdeck."""
    steps = 0.075 * smoothstep(-0.44, -0.46, t) + 0.05 * smoothstep(0.56, 0.58, t) + 0.045 * smoothstep(-0.72, -0.74, t)
    return 0.175 + 0.06 * t**2 + steps


def keel(t: np.ndarray) -> np.ndarray:
    return -0.15 + 0.20 * np.clip((t - 0.62) / 0.38, 0, 1) ** 2.2 + 0.07 * np.clip((-t - 0.75) / 0.25, 0, 1) ** 2


def deck_height(t: np.ndarray) -> np.ndarray:
    return sheer(t) - 0.045


def hull() -> Shape:
    """Closed body: outside (slot 0), rail and bulwark (1), deck (2), transom (3)."""
    t = np.unique(np.concatenate([np.linspace(-1, 1, 73), [-0.46, -0.44, -0.74, -0.72, 0.56, 0.58]]))
    w = np.linspace(0, 1, 17)
    beam, top, low = half_beam(t)[:, None], sheer(t)[:, None], keel(t)[:, None]
    y = beam * np.sin(w * np.pi / 2) ** 0.75 * (1 - 0.13 * smoothstep(0.6, 1.0, w))
    z = low + (top - low) * w**1.35
    x = np.broadcast_to(LENGTH * t[:, None] + 0.10 * smoothstep(0.5, 1.0, t)[:, None] * w, y.shape)
    side = np.stack([x, y, z], axis=-1)
    rail = side[:, -1].copy()
    inner, foot = rail.copy(), rail.copy()
    inner[:, 1] = np.maximum(rail[:, 1] - 0.014, 0.001)
    foot[:, 1] = inner[:, 1]
    foot[:, 2] = deck_height(t)
    half = np.concatenate([side, inner[:, None], foot[:, None]], axis=1)
    other = half[:, ::-1] * (1, -1, 1)
    rings = np.concatenate([half, other[:, :-1]], axis=1)  # the keel is shared
    columns = rings.shape[1]
    v_half = np.concatenate([w, [1.02, 0.98]])
    v = np.concatenate([v_half, v_half[::-1][:-1], [0.0]])
    u = np.linspace(0, 1, 2 * len(t) - 1)[::2]
    body = grid(rings, np.stack(np.broadcast_arrays(u[:, None], v[None]), axis=-1), wrap=True)
    column = np.tile(np.arange(columns), len(t) - 1)
    bulwark, deck = {16, 17, 19, 20}, {18}
    body.slots = [2 if c in deck else 1 if c in bulwark else 0 for c in column.tolist()]
    deck_faces = np.repeat([slot == 2 for slot in body.slots], [len(f) for f in body.faces])
    corners = body.points[np.concatenate([list(f) for f in body.faces])]
    body.uv[deck_faces] = corners[deck_faces][:, [1, 0]] * 2.0
    outline = rings[0, ::-1]
    low_z, span = outline[:, 2].min(), np.ptp(outline[:, 2])
    uv = np.stack([outline[:, 1] / 0.32 + 0.5, (outline[:, 2] - low_z) / span], axis=-1)
    transom = Shape(outline, [tuple(range(columns))], uv, [3])
    stem = rings[-1]
    return join([body, transom, Shape(stem, [tuple(range(columns))], stem[:, [1, 2]], [1])])

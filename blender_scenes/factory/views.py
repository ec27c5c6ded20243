"""The camera: a path that sees something and starts in no wall, keyed over 24 frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from building import camera
from mathutils import Vector

from factory.dice import Dice

FRAMES = (1, 9, 17, 24)


@dataclass
class Path:
    """Where the camera is and what it looks at, [4, 3] each, at `FRAMES`."""

    eyes: np.ndarray
    targets: np.ndarray
    lens: float


Draw = Callable[[Dice], Path]


def around(
    centre: tuple[float, float, float],
    reach: float,
    *,
    azimuth: tuple[float, float] = (-180.0, 180.0),
    elevation: tuple[float, float] = (8.0, 60.0),
) -> Draw:
    """Paths about ``centre`` that frame a sphere of radius ``reach``; degrees, azimuth 0 looks along +y."""

    def draw(dice: Dice) -> Path:
        lens = dice.log(26, 85)
        quick = dice.chance(0.2)
        sweep = dice.pick([-1, 1]) * (dice.uniform(60, 110) if quick else dice.uniform(8, 35))
        low, high = azimuth
        sweep = np.clip(sweep, -(high - low) * 0.8, (high - low) * 0.8)
        first = dice.uniform(low + max(-sweep, 0), high - max(sweep, 0))
        t = np.array([0, 1 / 3, 2 / 3, 1])
        turn = np.radians(first + sweep * t)
        lift = np.radians(np.clip(dice.uniform(*elevation) + dice.uniform(-8, 8) * t, *elevation))
        near = dice.uniform(0.65, 1.15)  # below 1 some of the sphere lies outside the frame
        far = near * reach * lens / 18 * (1 + dice.uniform(-0.2, 0.2) * t)
        away = np.stack([np.sin(turn) * np.cos(lift), -np.cos(turn) * np.cos(lift), np.sin(lift)], axis=-1)
        middle = np.array(centre) + dice.rng.uniform(-0.25, 0.25, 3) * reach
        middle[2] = max(middle[2], centre[2])
        targets = middle + np.outer(t, dice.rng.uniform(-0.1, 0.1, 3) * reach)
        return Path(np.array(centre) + away * far[:, None], targets, lens)

    return draw


def inside(low: np.ndarray, high: np.ndarray, blocked: list[tuple[float, float, float, float, float]]) -> Draw:
    """Paths in the box between two corners, clear of ``blocked`` (x0, y0, x1, y1, top), looking across it."""

    def free(point: np.ndarray) -> bool:
        x, y, z = point
        gap = 0.14
        return not any(
            x0 - gap < x < x1 + gap and y0 - gap < y < y1 + gap and z < top + gap for x0, y0, x1, y1, top in blocked
        )

    def draw(dice: Dice) -> Path:
        eye = dice.rng.uniform(low, high)
        for _ in range(60):
            if free(eye):
                break
            eye = dice.rng.uniform(low, high)
        step = dice.rng.uniform(-0.25, 0.25, 3) * np.array([1, 1, 0.3])
        t = np.array([0, 1 / 3, 2 / 3, 1])
        eyes = np.clip(eye + np.outer(t, step), low, high)
        eyes = np.array([e if free(e) else eye for e in eyes])
        middle = (low + high) / 2
        toward = np.degrees(np.arctan2(middle[1] - eye[1], middle[0] - eye[0])) + dice.uniform(-35, 35)
        sweep = dice.pick([-1, 1]) * (dice.uniform(60, 120) if dice.chance(0.3) else dice.uniform(5, 35))
        turn = np.radians(toward + sweep * (t - 0.5))
        drop = dice.uniform(-0.28, 0.08)
        return Path(eyes, eyes + np.stack([np.cos(turn), np.sin(turn), drop + 0 * t], axis=-1), dice.log(16, 32))

    return draw


def rays(eye: np.ndarray, target: np.ndarray, lens: float, across: int = 7) -> list[float]:
    """Distances to what a grid of rays through a square frame meets; infinite where nothing."""
    scene, graph = bpy.context.scene, bpy.context.evaluated_depsgraph_get()
    turn = (Vector(target) - Vector(eye)).to_track_quat("-Z", "Y")
    half = 18 / lens
    out = []
    for y in np.linspace(-0.9, 0.9, across):
        for x in np.linspace(-0.9, 0.9, across):
            direction = turn @ Vector((float(x) * half, float(y) * half, -1.0)).normalized()
            hit, point, *_ = scene.ray_cast(graph, Vector(eye), direction)
            out.append((point - Vector(eye)).length if hit else np.inf)
    return out


def score(path: Path, clearance: float) -> float:
    """1 where every key sees the scene from clear of it; less the closer and the emptier its pictures are."""
    worst = 1.0
    for eye, target in zip(path.eyes[::3], path.targets[::3], strict=True):
        far = np.array(rays(eye, target, path.lens))
        seen = np.isfinite(far).mean()
        crowded = (far < clearance).mean()
        middle = np.median(far[np.isfinite(far)]) if seen else 0.0
        worst = min(worst, min(seen / 0.35, 1.0) - 2 * crowded - (0.5 if middle < 2 * clearance else 0.0))
    return float(worst)


def shoot(dice: Dice, draw: Draw, clearance: float, tries: int = 14) -> float:
    """Key the first good path of ``draw``, or the best of all tries; returns its score."""
    best: tuple[float, Path] | None = None
    for _ in range(tries):
        path = draw(dice)
        value = score(path, clearance)
        if best is None or value > best[0] + 1e-3:
            best = value, path
        if value > 0.95:
            break
    assert best is not None
    _key(best[1])
    return best[0]


def _key(path: Path) -> None:
    focus = bpy.data.objects.new("Focus", None)
    bpy.context.scene.collection.objects.link(focus)
    eye = camera(tuple(path.eyes[0]), tuple(path.targets[0]), path.lens)
    data: Any = eye.data
    data.clip_start = 0.01
    track: Any = eye.constraints.new("TRACK_TO")
    track.target, track.track_axis, track.up_axis = focus, "TRACK_NEGATIVE_Z", "UP_Y"
    for frame, position, target in zip(FRAMES, path.eyes, path.targets, strict=True):
        eye.location, focus.location = position, target
        eye.keyframe_insert("location", frame=frame)
        focus.keyframe_insert("location", frame=frame)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = FRAMES[0], FRAMES[-1]
    scene.frame_set(1)

"""Tens to thousands of copies of a few meshes: heaps, grids, spirals, cities, fields, walls of bricks."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from solids import ball, box, lathe, mesh_of, place

from factory import cut, soft, turned
from factory.dice import Dice
from factory.families.table import disc
from factory.lighting import rig
from factory.stage import Stage
from factory.thing import Thing
from factory.things import small
from factory.views import Draw, around

TRIANGLES = 70_000  # of all copies together


def _pool(stage: Stage, radius: float, kinds: int, budget: int) -> list[bpy.types.Mesh]:
    """Meshes within ``radius`` and of at most ``budget`` triangles each."""
    dice = stage.dice
    simple = [turned.cone, cut.block, cut.prism, cut.gem, soft.rock, turned.sphere, turned.cylinder]
    out: list[bpy.types.Mesh] = []
    for _ in range(kinds):
        for _ in range(8):
            thing = small(dice) if budget > 2500 else dice.pick(simple)(dice)
            if sum(len(f) - 2 for f in thing.shape.faces) <= budget:
                break
        else:
            thing = Thing("Box", box((0.9, 0.9, 0.9), bevel=0.03, at=(0, 0, 0.45)), smooth=None)
        out.append(stage.mesh(thing.fitted(radius, 2.2 * radius), again=0.1))
    return out


def _strew(stage: Stage, meshes: list[bpy.types.Mesh], spots: np.ndarray, turns: np.ndarray) -> None:
    """Linked copies at spots [N, 3]; by vertex instancing for some of the scenes."""
    dice = stage.dice
    which = dice.rng.integers(0, len(meshes), len(spots))
    if dice.chance(0.35):
        for k, mesh in enumerate(meshes):
            points = bpy.data.meshes.new(f"Places {k + 1}")
            points.from_pydata([tuple(p) for p in spots[which == k]], [], [])
            carrier: Any = place(f"Places {k + 1}", points)
            carrier.instance_type = "VERTS"
            place(f"Copy {k + 1}", mesh).parent = carrier
        return
    for k, (spot, turn) in enumerate(zip(spots, turns, strict=True)):
        place(f"Copy {k + 1}", meshes[which[k]], at=tuple(spot), turn=(0, 0, float(turn)))


def _lattice(dice: Dice, count: int, reach: float) -> tuple[np.ndarray, float]:
    """Square or hexagonal grid on the ground: spots, and the largest radius that does not touch."""
    side = max(int(np.sqrt(count)), 3)
    step = 2 * reach / side
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    shift = 0.5 * (y % 2) if dice.chance(0.5) else 0.0
    spots = np.stack([(x + shift - side / 2 + 0.25) * step, (y - side / 2 + 0.5) * step, 0.0 * x], axis=-1)
    return spots.reshape(-1, 3), step * 0.47


def _spiral(count: int, reach: float) -> tuple[np.ndarray, float]:
    """Phyllotaxis: seeds of a sunflower."""
    k = np.arange(count) + 0.5
    far, turn = reach * np.sqrt(k / count), k * np.radians(137.508)
    spots = np.stack([far * np.cos(turn), far * np.sin(turn), 0 * k], axis=-1)
    return spots, 0.8 * reach / np.sqrt(count)


def _heap(dice: Dice, count: int, reach: float) -> tuple[np.ndarray, float]:
    """Close-packed layers that shrink upwards, as stacked oranges."""
    radius = 0.62 * reach / np.cbrt(count)
    out: list[tuple[float, float, float]] = []
    layer, wide = 0, int(np.sqrt(count * 0.8)) + 1
    while wide > 0 and len(out) < count:
        x, y = np.meshgrid(np.arange(wide), np.arange(wide))
        for a, b in zip(x.ravel(), y.ravel(), strict=True):
            spot = ((a - (wide - 1) / 2) * 2.01 * radius, (b - (wide - 1) / 2) * 2.01 * radius, layer * 1.425 * radius)
            out.append(spot)
        layer, wide = layer + 1, wide - 1
    spots = np.array(out[:count])
    fit = min(1.0, reach / max(np.abs(spots[:, :2]).max(), 1e-6))
    return spots * fit, radius * fit


def _bricks(stage: Stage, count: int) -> float:
    """A wall or tower of bricks, with gaps; returns its height."""
    dice = stage.dice
    columns = dice.whole(8, 16)
    rows = min(max(count // columns, 4), 22)
    length, high, deep = 2.0 / columns, dice.uniform(0.04, 0.08), dice.uniform(0.06, 0.12)
    brick = Thing("Brick", box((length * 0.97, deep, high * 0.97), bevel=0.004, at=(0, 0, high / 2)), smooth=None)
    meshes = [stage.mesh(brick, again=0.0) for _ in range(dice.whole(1, 4))]
    curved = dice.chance(0.5)
    spots, turns = [], []
    for row in range(rows):
        for k in range(columns):
            if dice.chance(0.06):
                continue
            t = (k + 0.5 * (row % 2)) / columns
            if curved:
                radius, a = 2.0 / (2 * np.pi), 2 * np.pi * t
                radius *= 1 + 0.5 * deep
                spots.append((radius * 1.25 * np.cos(a), radius * 1.25 * np.sin(a), row * high))
                turns.append(float(np.degrees(a)) + 90)
            else:
                spots.append((2 * t - 1, 0.0, row * high))
                turns.append(dice.uniform(-1, 1))
    for k, (spot, turn) in enumerate(zip(spots, turns, strict=True)):
        place(f"Brick {k + 1}", dice.pick(meshes), at=spot, turn=(0, 0, turn))
    return rows * high


def _city(stage: Stage) -> float:
    """Blocks of many heights on a grid of streets."""
    dice = stage.dice
    side = dice.whole(6, 14)
    step = 2.0 / side
    unit = [mesh_of("Tower", box((1, 1, 1), at=(0, 0, 0.5), scale=1.0), smooth=None) for _ in range(dice.whole(2, 5))]
    for mesh in unit:
        mesh.materials.append(stage.finish.draw(dice.pick(["wall", "thing", "plain"])))
    tallest = 0.0
    for x in range(side):
        for y in range(side):
            if dice.chance(0.1):
                continue
            wide, high = step * dice.uniform(0.5, 0.85), step * dice.log(0.4, 4.0)
            tower = place(f"Tower {x} {y}", dice.pick(unit), at=((x + 0.5) * step - 1, (y + 0.5) * step - 1, 0.0))
            tower.scale = (wide, wide * dice.uniform(0.7, 1.0), high)
            tallest = max(tallest, high)
    return tallest


def _dominoes(stage: Stage, count: int) -> float:
    """A spiral of standing tiles or coins."""
    dice = stage.dice
    tall = dice.uniform(0.12, 0.2)
    edge = [(0.0, -0.012), (tall / 2 - 0.004, -0.012), (tall / 2, -0.008)]
    coin = lathe([*edge, *[(r, -z) for r, z in edge[::-1]]], 24)
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    shape = dice.pick(
        [
            box((tall * 0.5, 0.022, tall), bevel=0.004, at=(0, 0, tall / 2)),
            coin.moved(turn=turn).moved((0, 0, tall / 2)),
        ]
    )
    meshes = [stage.mesh(Thing("Domino", shape, smooth=30), again=0.0) for _ in range(dice.whole(1, 3))]
    a = 0.0
    for k in range(min(count, 160)):
        reach = 0.25 + 0.13 * a / (2 * np.pi) * 1.6
        if reach > 1.0:
            break
        at = (float(reach * np.cos(a)), float(reach * np.sin(a)), 0.0)
        place(f"Domino {k + 1}", dice.pick(meshes), at=at, turn=(0, 0, float(np.degrees(a))))
        a += 0.065 / reach
    return tall


def build(stage: Stage) -> Draw:
    dice = stage.dice
    count = int(dice.log(20, 1800))
    kind = dice.weighted({"grid": 2.0, "spiral": 1.5, "heap": 1.5, "bricks": 1.0, "city": 1.0, "dominoes": 0.8})
    if dice.chance(0.5):
        stage.put(Thing("Floor", box((3.2, 3.2, 0.04), at=(0, 0, -0.0205)), ("ground",), smooth=None))
    else:
        stage.put(Thing("Disc", disc(1.55, 0.08), ("ground",)), (0, 0, -0.0005))
    if kind == "bricks":
        height = _bricks(stage, count)
    elif kind == "city":
        height = _city(stage)
    elif kind == "dominoes":
        height = _dominoes(stage, count)
    else:
        count = min(count, 400) if kind == "heap" else count
        spots, radius = (
            {"grid": _lattice, "heap": _heap}[kind](dice, count, 0.95) if kind != "spiral" else _spiral(count, 1.0)
        )
        meshes = [_heap_ball(stage, radius)] if kind == "heap" else []
        meshes = meshes or _pool(stage, radius, dice.whole(1, 4), TRIANGLES // len(spots))
        _strew(stage, meshes, spots, dice.rng.uniform(0, 360, len(spots)))
        height = float(spots[:, 2].max()) + 2 * radius
    rig(dice, 1.4, (0, 0, height / 3))
    return around((0, 0, height / 3), max(dice.uniform(0.5, 1.15), height * 0.6), elevation=(10.0, 60.0))


def _heap_ball(stage: Stage, radius: float) -> bpy.types.Mesh:
    """A ball of a heap: its layers fit balls."""
    return stage.mesh(Thing("Ball", ball(radius * 0.995, 8, 14).moved((0, 0, radius))), again=0.0)

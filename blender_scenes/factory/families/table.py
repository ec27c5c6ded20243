"""Five to fourteen things on a slab, a pedestal, a table or the floor, with and without walls behind."""

from __future__ import annotations

import numpy as np
from shapes import grid_uv, rounded_disc
from solids import Shape, box, grid, join, lathe

from factory.dice import Dice
from factory.lighting import rig
from factory.stage import Stage
from factory.thing import Thing
from factory.things import small
from factory.views import Draw, around


def disc(radius: float, thick: float) -> Shape:
    """Round slab whose top is z = 0; UVs from above."""
    shape = lathe([(r, z - thick) for r, z in rounded_disc(radius, 0.0, thick, min(0.03, thick * 0.4))], 72)
    corners = shape.points[np.concatenate([list(f) for f in shape.faces])]
    return Shape(shape.points, shape.faces, corners[:, :2] + corners[:, 2:] * 0.7, shape.slots)


def _support(dice: Dice, kind: str, reach: float, side: float) -> Thing:
    """What the things stand on; its top is z = 0."""
    if kind == "plinth":
        return Thing("Plinth", disc(reach, dice.uniform(0.04, 0.5)), ("ground",))
    if kind == "pedestal":
        foot = lathe([(0.0, -1.0), (0.5, -1.0), (0.3, -0.85), (0.25, -0.1), (0.0, -0.1)], 40).painted(1)
        return Thing("Pedestal", join([disc(reach, 0.08), foot]), ("ground", "thing"))
    thick = dice.uniform(0.03, 0.15)
    top = box((2 * reach, 2 * side, thick), bevel=0.008, at=(0, 0, -thick / 2))
    if kind == "slab":
        return Thing("Slab", top, ("ground",), smooth=None)
    legs = [
        box((0.07, 0.07, 0.7), at=(sx * (reach - 0.08), sy * (side - 0.08), -thick - 0.35)).painted(1)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return Thing("Table", join([top, *legs]), ("wood", "wood"), smooth=None)


def backdrop(dice: Dice, reach: float) -> Thing:
    """A studio's paper: floor that bends up into a wall."""
    bend = dice.uniform(0.2, 0.6)
    turn = np.linspace(0, np.pi / 2, 12)
    back = reach * 1.3
    profile = [(-reach * 1.5, 0.0), *zip(back - bend + bend * np.sin(turn), bend - bend * np.cos(turn), strict=True)]
    profile.append((back, reach * 1.6))
    points = np.array([[(x, y, z) for x in (-1.6 * reach, 1.6 * reach)] for y, z in profile])
    return Thing("Backdrop", grid(points, grid_uv(len(profile), 2, 2.0, 2.0)), (dice.pick(["plain", "ground"]),), 60)


def build(stage: Stage) -> Draw:
    dice = stage.dice
    reach = dice.uniform(0.8, 1.2)
    kind = dice.weighted({"plinth": 1.5, "pedestal": 0.7, "slab": 2.0, "table": 1.5, "floor": 1.5, "paper": 1.2})
    side: float | None = None
    if kind in ("slab", "table"):
        side = reach * dice.uniform(0.5, 1.0)
    if kind == "paper":
        stage.put(backdrop(dice, reach))
    elif kind == "floor":
        wide = 1.7 * reach
        stage.put(Thing("Floor", box((2 * wide, 2 * wide, 0.05), at=(0, 0, -0.025)), ("ground",), smooth=None))
    else:
        stage.put(_support(dice, kind, reach, side or reach))
    azimuth = (-180.0, 180.0)
    if kind == "paper":
        azimuth = (-50.0, 50.0)
    elif dice.chance(0.45):
        azimuth = _walls(stage, reach if side is None else side, reach)
    count = dice.whole(5, 14)
    sizes = [dice.log(0.08, 0.3) for _ in range(count)]
    height = stage.scatter(
        [small(dice) for _ in sizes], sizes, 0.0, reach * 0.95, None if side is None else side * 0.95
    )
    rig(dice, reach * 1.2, (0, 0, height * 0.3))
    return around((0, 0, 0.25 * height), reach * dice.uniform(0.55, 1.0), azimuth=azimuth)


def _walls(stage: Stage, back: float, reach: float) -> tuple[float, float]:
    """One wall or a corner behind the things; returns where the camera may be."""
    dice = stage.dice
    high, y = dice.uniform(0.8, 1.5), (1.72 if back == reach else 1.05) * back
    wall = box((3.4 * reach, 0.05, high + 1.0), at=(0, y + 0.025, (high - 1.0) / 2), scale=dice.pick([0.5, 1.0]))
    stage.put(Thing("Wall", wall, ("wall",), smooth=None))
    if dice.chance(0.4):
        x = 1.7 * reach
        other = box((0.05, 2 * y, high + 1.0), at=(x + 0.025, 0, (high - 1.0) / 2), scale=1.0)
        stage.put(Thing("Side wall", other, ("wall",), smooth=None))
        return -70.0, 15.0
    return -65.0, 65.0

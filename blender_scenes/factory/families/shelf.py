"""A bookcase, a niche or a drawer full of small things: contact shadows, light that comes from one side."""

from __future__ import annotations

import numpy as np
from building import area_light, point_light
from solids import Shape, box, join

from factory import cut
from factory.dice import Dice
from factory.lighting import lamp, plain_world, rig, tint
from factory.stage import Stage
from factory.thing import Thing
from factory.things import small
from factory.views import Draw, around


def _case(dice: Dice, wide: float, tall: float, deep: float, rows: int, columns: int) -> tuple[Thing, float]:
    """Boards about cells, open to -y; the back's own slot. Returns their thickness too."""
    thick = dice.uniform(0.02, 0.06)
    parts: list[Shape] = []
    for k in range(rows + 1):
        parts.append(box((wide + thick, deep, thick), at=(0, 0, k * tall / rows), scale=1.0))
    for k in range(columns + 1):
        for row in range(rows):
            inner = tall / rows - thick
            at = (wide * (k / columns - 0.5), 0, (row + 0.5) * tall / rows)
            parts.append(box((thick, deep, inner), at=at, scale=1.0))
    back = box((wide + thick, 0.02, tall + thick), at=(0, deep / 2 + 0.01, tall / 2), scale=1.0)
    return Thing("Case", join([*parts, back.painted(1)]), ("wood", "wall"), smooth=None), thick


def _fill(stage: Stage, x0: float, x1: float, z: float, high: float, deep: float) -> None:
    """Stand things side by side in one cell."""
    dice = stage.dice
    if dice.chance(0.1):
        return
    if dice.chance(0.25):
        row = cut.book_row(dice, 0.7 * (x1 - x0) / high).scaled(min(high, deep * 1.4) * 0.95)
        points = row.shape.points
        if np.ptp(points[:, 0]) < x1 - x0 - 0.02:
            stage.put(row, (x0 + 0.01 - float(points[:, 0].min()), -deep * 0.3, z))
        return
    x = x0 + 0.01
    while x < x1 - 0.06:
        radius = min(dice.log(0.05, 0.24), (x1 - x) / 2 - 0.005, deep / 2)
        if radius < 0.03:
            break
        thing = small(dice).fitted(radius, high * 0.92)
        y = dice.uniform(-1, 1) * max(deep / 2 - thing.radius, 0) * 0.8
        stage.put(thing, (x + thing.radius, y, z), dice.uniform(0, 360))
        x += 2 * thing.radius + dice.log(0.005, 0.12)


def build(stage: Stage) -> Draw:
    dice = stage.dice
    rows, columns = dice.pick([(1, 1), (1, 2), (2, 1), (2, 2), (3, 1), (3, 2), (2, 3), (4, 1)])
    grow = 1.7 if rows * columns < 3 else 1.0
    cell = grow * dice.uniform(0.38, 0.6)
    tall, wide = rows * cell, max(grow * columns * dice.uniform(0.5, 0.9), 0.8)
    deep = grow * dice.uniform(0.3, 0.55)
    case, thick = _case(dice, wide, tall, deep, rows, columns)
    stage.put(case)
    for row in range(rows):
        for column in range(columns):
            x0 = wide * (column / columns - 0.5) + thick / 2
            z = row * tall / rows + thick / 2 + 0.0005
            _fill(stage, x0, x0 + wide / columns - thick, z, tall / rows - thick, deep - 0.02)
    if dice.chance(0.5):  # set into a wall
        y, reach = -deep / 2 + 0.02, 0.5
        left, high = wide / 2 + thick / 2, tall + thick / 2
        walls = [
            box((reach, 0.04, high + 2 * reach), at=(s * (left + reach / 2), y, high / 2), scale=1.0) for s in (-1, 1)
        ]
        walls.append(box((2 * left, 0.04, reach), at=(0, y, high + reach / 2), scale=1.0))
        walls.append(
            box((2 * left, 0.04, reach - thick / 2), at=(0, y, -thick / 2 - (reach - thick / 2) / 2), scale=1.0)
        )
        stage.put(Thing("Niche wall", join(walls), ("wall",), smooth=None))
    elif dice.chance(0.6):
        floor = box((wide + 1.4, deep + 1.6, 0.03), at=(0, -0.4, -thick / 2 - 0.016), scale=1.0)
        stage.put(Thing("Floor", floor, ("ground",), smooth=None))
    middle = (0.0, -deep / 2, tall / 2)
    if dice.chance(0.5):
        rig(dice, 1.2, middle)
    else:  # lamps in front, a strip in a cell: most of the light in there has bounced
        plain_world(dice, 0.02, 0.5)
        _front_lamps(dice, wide, tall, deep)
        if dice.chance(0.3):
            lamp(dice, "spot", 1.2, middle)
    return around(middle, max(tall, wide) * dice.uniform(0.4, 0.75), azimuth=(-42.0, 42.0), elevation=(-8.0, 30.0))


def _front_lamps(dice: Dice, wide: float, tall: float, deep: float) -> None:
    """A lamp before the case, to one side, or a small one inside."""
    if dice.chance(0.4):
        at = (dice.uniform(-0.3, 0.3) * wide, -0.2 * deep, tall * dice.uniform(0.4, 0.95))
        point_light("Cabinet lamp", at, 6.0, dice.log(0.004, 0.03), tint(dice))
    at = (dice.uniform(-1.5, 1.5), -dice.uniform(0.8, 2.0), dice.uniform(0.2, 1.8))
    size = dice.log(0.05, 1.0)
    area_light("Front lamp", at, (0, 0, tall / 2), 40.0, (size, size), tint(dice))

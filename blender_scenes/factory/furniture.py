"""Furniture of simple parts. Each piece stands on z = 0 with its back to +y; a storey is about one unit high."""

from __future__ import annotations

import numpy as np
from shapes import cushion as cushion_mesh
from shapes import rounded_disc
from solids import Shape, ball, box, join, lathe, tube

from factory.cut import book_row
from factory.dice import Dice
from factory.thing import Thing, shape_of


def _soft(size: tuple[float, float, float], at: tuple[float, float, float], puff: float = 0.015) -> Shape:
    return shape_of(cushion_mesh("Cushion", size, min(0.03, min(size) * 0.4), puff, 6)).moved(at)


def _legs(x: float, y: float, high: float, thick: float) -> list[Shape]:
    return [box((thick, thick, high), at=(sx * x, sy * y, high / 2)) for sx in (-1, 1) for sy in (-1, 1)]


def table(dice: Dice) -> Thing:
    high, wide, deep = dice.uniform(0.15, 0.33), dice.uniform(0.35, 0.8), dice.uniform(0.3, 0.5)
    if dice.chance(0.35):
        radius = wide / 2
        foot = lathe(
            [(0.0, 0.0), (radius * 0.6, 0.0), (radius * 0.55, 0.02), (0.03, 0.04), (0.03, high), (0, high)], 28
        )
        shape = join([lathe(rounded_disc(radius, high, high + 0.025, 0.008), 48), foot.painted(1)])
        return Thing("Round table", shape, ("wood", "metal"), top=(0, 0, high + 0.025, radius * 0.8))
    legs = [leg.painted(1) for leg in _legs(wide / 2 - 0.03, deep / 2 - 0.03, high, 0.03)]
    shape = join([box((wide, deep, 0.025), bevel=0.004, at=(0, 0, high + 0.0125), scale=2.0), *legs])
    return Thing(
        "Table", shape, ("wood", dice.pick(["wood", "metal"])), smooth=None, top=(0, 0, high + 0.025, deep * 0.45)
    )


def chair(dice: Dice) -> Thing:
    seat, wide = 0.19, 0.19
    parts = _legs(wide / 2 - 0.012, wide / 2 - 0.012, seat, 0.018)
    parts += [box((0.018, 0.018, 0.22), at=(s * (wide / 2 - 0.012), wide / 2 - 0.012, seat + 0.11)) for s in (-1, 1)]
    for k in range(slats := dice.whole(1, 3)):
        parts.append(box((wide, 0.012, 0.16 / slats), at=(0, wide / 2 - 0.012, seat + 0.05 + 0.2 * (k + 0.5) / slats)))
    pad = _soft((wide, wide, 0.03), (0, 0, seat + 0.012), 0.008).painted(1)
    return Thing("Chair", join([*parts, pad]), ("wood", dice.pick(["cloth", "wood"])), smooth=40)


def stool(dice: Dice) -> Thing:
    high = dice.uniform(0.16, 0.3)
    parts = [lathe(rounded_disc(0.08, high, high + 0.025, 0.008), 32).painted(1)]
    for k in range(legs := dice.pick([3, 4])):
        a = 2 * np.pi * k / legs
        path = np.array([(0.09 * np.cos(a), 0.09 * np.sin(a), 0.0), (0.05 * np.cos(a), 0.05 * np.sin(a), high)])
        parts.append(tube(path, 0.009, 8))
    return Thing("Stool", join(parts), (dice.pick(["metal", "wood"]), "thing"))


def sofa(dice: Dice) -> Thing:
    wide, seat = dice.uniform(0.4, 0.85), 0.17
    parts = [
        _soft((wide, 0.36, 0.1), (0, 0, 0.1), 0.0),
        _soft((wide, 0.1, 0.3), (0, 0.15, 0.24), 0.0),
        *[_soft((0.09, 0.38, 0.2), (s * wide / 2, 0, 0.15), 0.005) for s in (-1, 1)],
    ]
    for k in range(seats := 1 if wide < 0.55 else 2):
        inner = (wide - 0.1) / seats
        parts.append(_soft((inner - 0.008, 0.3, 0.08), ((k + 0.5) * inner - (wide - 0.1) / 2, -0.03, seat + 0.02)))
    if dice.chance(0.6):
        pillow = _soft((0.17, 0.06, 0.17), (dice.uniform(-0.1, 0.1), 0.05, seat + 0.16), 0.02)
        parts.append(pillow.painted(1))
    legs = [leg.painted(2) for leg in _legs(wide / 2, 0.14, 0.06, 0.025)]
    return Thing("Sofa", join([*parts, *legs]), ("cloth", "cloth", "wood"), smooth=60)


def bed(dice: Dice) -> Thing:
    wide = dice.uniform(0.4, 0.65)
    parts = [box((wide, 0.85, 0.1), at=(0, 0, 0.08)), box((wide, 0.03, 0.4), at=(0, 0.43, 0.2))]
    parts += _legs(wide / 2 - 0.03, 0.38, 0.04, 0.04)
    parts.append(_soft((wide - 0.02, 0.82, 0.12), (0, -0.005, 0.18), 0.01).painted(1))
    parts.append(_soft((wide + 0.01, 0.55, 0.06), (0, -0.14, 0.235), 0.015).painted(2))
    for s in (-1, 1) if wide > 0.5 else (0,):
        parts.append(_soft((0.22, 0.15, 0.05), (s * wide / 4, 0.3, 0.26), 0.03).painted(1))
    return Thing("Bed", join(parts), ("wood", "cloth", "cloth"), smooth=60)


def cabinet(dice: Dice) -> Thing:
    """Drawers or doors with knobs."""
    wide, deep, high = dice.uniform(0.25, 0.6), dice.uniform(0.18, 0.25), dice.uniform(0.25, 0.75)
    parts = [box((wide, deep, high), at=(0, 0, high / 2 + 0.02), scale=1.5)]
    rows, columns = dice.whole(1, 3), dice.whole(1, 2)
    for row in range(rows):
        for column in range(columns):
            x, z = wide * ((column + 0.5) / columns - 0.5), 0.02 + high * (row + 0.5) / rows
            at = (x, -deep / 2 - 0.004, z)
            parts.append(box((wide / columns - 0.015, 0.012, high / rows - 0.015), bevel=0.003, at=at, scale=1.5))
            parts.append(ball(0.012, 8, 12).moved((x, -deep / 2 - 0.02, z)).painted(1))
    parts += _legs(wide / 2 - 0.02, deep / 2 - 0.02, 0.02, 0.03)
    top = (0.0, 0.0, high + 0.02, deep * 0.45)
    return Thing("Cabinet", join(parts), ("wood", "metal"), smooth=30, top=top)


def bookcase(dice: Dice) -> Thing:
    wide, deep, rows = dice.uniform(0.3, 0.6), 0.14, dice.whole(2, 4)
    row = 0.19
    high = rows * row
    parts = [box((wide, deep, 0.014), at=(0, 0, k * row + 0.01), scale=1.5) for k in range(rows + 1)]
    parts += [box((0.014, deep, high + 0.02), at=(s * wide / 2, 0, high / 2 + 0.01), scale=1.5) for s in (-1, 1)]
    parts.append(box((wide, 0.008, high), at=(0, deep / 2, high / 2), scale=1.5))
    for k in range(rows):
        if dice.chance(0.15):
            continue
        books = book_row(dice, (wide - 0.06) / 0.18 * dice.uniform(0.4, 0.9)).scaled(0.165).shape
        low = books.points.min(0)
        if np.ptp(books.points[:, 0]) > wide - 0.03:
            continue
        moved = books.moved((-wide / 2 + 0.012 - low[0], -deep * 0.4 - low[1], k * row + 0.0175))
        parts.append(Shape(moved.points, moved.faces, moved.uv, [s + 1 for s in moved.slots]))
    roles = ("wood", "thing", "paper", "plain", "paper", "cloth")
    return Thing("Bookcase", join(parts), roles, smooth=None, top=(0, 0, high + 0.017, 0.06))


def floor_lamp(dice: Dice) -> Thing:
    """Foot, pole, an open shade about a bulb, small or large."""
    high = dice.uniform(0.5, 0.72)
    foot = lathe([(0.0, 0.0), (0.08, 0.0), (0.08, 0.012), (0.008, 0.025), (0.008, high), (0.0, high)], 24)
    low, top, tall = dice.uniform(0.07, 0.14), dice.uniform(0.04, 0.12), dice.uniform(0.08, 0.16)
    shade = lathe([(low, high - 0.03), (top, high - 0.03 + tall)], 32).painted(1)
    bulb = ball(dice.log(0.008, 0.03), 8, 16).moved((0, 0, high + 0.035)).painted(2)
    return Thing("Floor lamp", join([foot, shade, bulb]), ("metal", "shade", "bulb"))


def fireplace(dice: Dice) -> Thing:
    """A hearth with glowing embers."""
    wide, high, deep = 0.5, 0.4, 0.16
    parts = [box((0.1, deep, high), at=(s * (wide / 2 - 0.05), 0, high / 2)) for s in (-1, 1)]
    parts += [
        box((wide, deep, 0.12), at=(0, 0, high + 0.06)),
        box((wide, 0.02, high), at=(0, deep / 2, high / 2)).painted(1),
    ]
    parts.append(box((wide + 0.08, deep + 0.06, 0.03), at=(0, -0.02, high + 0.135)).painted(2))
    for k in range(4):
        ember = ball(0.035, 6, 10).moved((-0.09 + 0.06 * k, -0.01, 0.035 + 0.02 * (k % 2)))
        parts.append(ember.painted(3))
    return Thing("Fireplace", join(parts), ("wall", "soil", "wood", "bulb"), smooth=None, top=(0, 0, high + 0.15, 0.07))

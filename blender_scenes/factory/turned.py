"""Things of revolution: vessels, fruit, turned wood, lamps."""

from __future__ import annotations

import numpy as np
from shapes import ball_profile, curve_profile, rounded_disc
from solids import Shape, ball, grid, join, lathe, tube

from factory.dice import Dice
from factory.thing import Thing, resting

Profile = list[tuple[float, float]]


def _repeats(dice: Dice) -> tuple[float, float]:
    return dice.pick([(1, 1), (2, 1), (3, 1), (4, 2)])


def _hollow(outer: Profile, wall: float, floor: float) -> Profile:
    """A vessel of ``wall`` thickness from its outer profile, which starts on the axis and ends at the rim."""
    inner = [(max(r - wall, 0.0), max(z, floor)) for r, z in outer[::-1] if r > wall]
    return [*outer, *inner, (0.0, floor)]


def sphere(dice: Dice) -> Thing:
    return Thing("Ball", resting(ball(0.5, 20, 40, _repeats(dice))))


def cylinder(dice: Dice) -> Thing:
    """Upright drum, coin or rod with round edges."""
    height = dice.log(0.15, 2.2)
    bevel = dice.uniform(0.01, 0.06)
    shape = lathe(rounded_disc(0.5, 0.0, height, min(bevel, height * 0.4)), 40, _repeats(dice))
    return Thing("Cylinder", shape, top=(0, 0, height, 0.4))


def rod(dice: Dice) -> Thing:
    """Cylinder that lies."""
    length = dice.uniform(0.8, 2.5)
    shape = lathe(rounded_disc(dice.uniform(0.08, 0.35), 0.0, length, 0.03), 32)
    return Thing("Rod", resting(shape, (1, 90.0)))


def cone(dice: Dice) -> Thing:
    tip = dice.pick([0.0, dice.uniform(0.1, 0.4)])
    profile = [(0.0, 0.0), (0.48, 0.0), (0.5, 0.02), (tip + 0.01, 1.0), (tip, 1.01), (0.0, 1.01)]
    return Thing("Cone", lathe(profile if tip else [*profile[:-2], (0.0, 1.01)], dice.pick([4, 6, 40, 40])))


def torus(dice: Dice) -> Thing:
    thin = dice.uniform(0.05, 0.2)
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    path = np.stack([(0.5 - thin) * np.cos(turn), (0.5 - thin) * np.sin(turn), 0 * turn], axis=-1)
    shape = tube(path, thin, 16, closed=True, repeats=(2, 12))
    return Thing("Ring", resting(shape, (0, dice.pick([0.0, 0.0, 90.0]))))


def _body(dice: Dice) -> Profile:
    """Random smooth outline of a vessel, from the axis at the bottom to the rim."""
    count = dice.whole(3, 6)
    heights = np.linspace(0, dice.uniform(0.7, 1.6), count + 1)[1:]
    knots = [(dice.uniform(0.2, 0.45), 0.0), *[(dice.uniform(0.14, 0.5), float(z)) for z in heights]]
    return [(0.0, 0.0), *curve_profile(knots, 5)]


def vase(dice: Dice) -> Thing:
    outer = _body(dice)
    return Thing("Vase", lathe(_hollow(outer, 0.035, 0.06), 40, _repeats(dice)), ("ceramic",))


def turned_wood(dice: Dice) -> Thing:
    """Solid: chess man, baluster, candlestick, spinning top."""
    outer = _body(dice)
    crown = ball_profile(dice.uniform(0.1, 0.2), 10)[1:]
    shape = lathe([*outer, (0.05, outer[-1][1] + 0.02), *[(r, z + outer[-1][1] + 0.02) for r, z in crown]], 32)
    return Thing("Turned piece", shape, (dice.pick(["wood", "metal", "thing"]),))


def bowl(dice: Dice) -> Thing:
    height = dice.uniform(0.12, 0.5)
    outer = [(0.0, 0.0), (0.2, 0.0), *curve_profile([(0.22, 0.02), (0.4, height * 0.5), (0.5, height)], 6)]
    return Thing("Bowl", lathe(_hollow(outer, 0.03, 0.03), 48, _repeats(dice)), ("ceramic",))


def plate(dice: Dice) -> Thing:
    profile = [(0.0, 0.0), (0.3, 0.0), (0.5, 0.05), (0.5, 0.062), (0.31, 0.02), (0.0, 0.018)]
    return Thing("Plate", lathe(profile, 56), ("ceramic",), top=(0, 0, 0.02, 0.3))


def mug(dice: Dice) -> Thing:
    """With a handle, sometimes full."""
    waist, height = dice.uniform(0.3, 0.42), dice.uniform(0.7, 1.0)
    outer = [(0.0, 0.0), *curve_profile([(0.36, 0.0), (waist, height / 2), (0.4, height)], 6)]
    parts = [lathe(_hollow(outer, 0.035, 0.05), 40, _repeats(dice))]
    turn = np.linspace(-np.pi / 2, np.pi / 2, 14)
    path = np.stack([waist - 0.03 + 0.24 * np.cos(turn), 0 * turn, height / 2 + 0.27 * np.sin(turn)], axis=-1)
    parts.append(tube(path, 0.045, 10))
    roles: tuple[str, ...] = ("ceramic",)
    if dice.chance(0.6):
        level = height * dice.uniform(0.6, 0.85)
        parts.append(
            lathe([(0.0, level - 0.02), (waist - 0.045, level - 0.02), (waist - 0.045, level), (0, level)], 32)
        )
        parts[-1] = parts[-1].painted(1)
        roles = ("ceramic", "plain")
    return Thing("Mug", resting(join(parts)), roles)


def drinking_glass(dice: Dice) -> Thing:
    """Thin-walled, some with a stem, some with a drink that stands clear of the wall."""
    wall = 0.025
    if dice.chance(0.4):
        cup = curve_profile([(0.06, 0.55), (dice.uniform(0.25, 0.38), 0.8), (dice.uniform(0.18, 0.35), 1.2)], 7)
        outer = [(0.0, 0.0), (0.3, 0.0), (0.3, 0.015), (0.04, 0.05), (0.03, 0.3), (0.035, 0.53), *cup]
        inner = [(max(r - wall, 0.0), z) for r, z in cup[::-1] if z > 0.62]
        return Thing("Wine glass", lathe([*outer, *inner, (0.0, 0.6)], 40), ("clear",))
    low, high = dice.uniform(0.26, 0.4), dice.uniform(0.3, 0.42)
    outer = [(0.0, 0.0), (low - 0.02, 0.0), (low, 0.02), (high, 1.0)]
    parts = [lathe(_hollow(outer, wall, 0.07), 40)]
    roles: tuple[str, ...] = ("glass",)
    if dice.chance(0.6):
        level, inside = dice.uniform(0.35, 0.8), min(low, high) - wall - 0.012
        parts.append(lathe([(0.0, 0.085), (inside, 0.085), (inside, level), (0.0, level)], 40).painted(1))
        roles = ("clear", "liquid")
    return Thing("Tumbler", join(parts), roles)


def bottle(dice: Dice) -> Thing:
    """Body, shoulder, neck, a cap, and a label wound about it."""
    wide, shoulder, neck = dice.uniform(0.22, 0.36), dice.uniform(0.7, 1.0), dice.uniform(0.06, 0.12)
    tall = shoulder + dice.uniform(0.25, 0.5)
    knots = [(wide, shoulder), ((wide + neck) / 1.8, shoulder + 0.12), (neck, shoulder + 0.25), (neck, tall)]
    outer = [(0.0, 0.0), (wide - 0.02, 0.0), (wide, 0.02), *curve_profile(knots, 5), (0.0, tall)]
    cap = lathe([(0.0, tall), (neck + 0.025, tall - 0.06), (neck + 0.025, tall + 0.08), (0.0, tall + 0.08)], 28)
    low, high = shoulder * 0.2, shoulder * 0.75
    label = lathe([(wide + 0.003, low), (wide + 0.003, high)], 40)
    roles = (dice.pick(["glass", "ceramic", "thing"]), dice.pick(["metal", "plain", "wood"]), "thing")
    return Thing("Bottle", join([lathe(outer, 40), cap.painted(1), label.painted(2)]), roles)


def fruit(dice: Dice) -> Thing:
    """Apple, pear, orange, pumpkin: a dented ball with ribs and a stalk."""
    rows, columns = 22, 40
    lat, turn = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, rows + 1), np.linspace(0, 2 * np.pi, columns + 1), indexing="ij"
    )
    dent, ribs = dice.uniform(0.0, 0.4), dice.pick([0.0, 0.0, 0.08])
    reach = 0.5 * (1 - dent * np.abs(np.sin(lat)) ** 6) * (1 + ribs * np.cos(dice.whole(6, 10) * turn) * np.cos(lat))
    reach *= 1 - dice.pick([0.0, 0.35]) * np.clip(np.sin(lat), 0, 1)
    long = dice.uniform(0.8, 1.25)
    profile = np.stack(
        [reach * np.cos(lat) * np.cos(turn), reach * np.cos(lat) * np.sin(turn), long * reach * np.sin(lat)], -1
    )
    uv = np.stack([turn / (2 * np.pi), lat / np.pi + 0.5], axis=-1)
    profile[0, :, :2] = profile[-1, :, :2] = 0
    body = grid(profile[:, :-1], uv, wrap=True)
    top = profile[-1, 0, 2]
    stalk = tube(np.array([(0, 0, top - 0.03), (0.01, 0, top + 0.06), (0.05, 0.01, top + 0.14)]), 0.02, 6).painted(1)
    return Thing("Fruit", resting(join([body, stalk])), (dice.pick(["thing", "plain", "ceramic"]), "wood"), smooth=60)


def candle(dice: Dice) -> Thing:
    """Wax with a flame."""
    tall = dice.uniform(0.5, 1.4)
    wax = lathe(rounded_disc(0.2, 0.0, tall, 0.03), 32)
    flame = lathe(
        curve_profile([(0.0, tall + 0.03), (0.05, tall + 0.1), (0.025, tall + 0.2), (0.0, tall + 0.3)], 5), 16
    )
    wick = lathe([(0.0, tall - 0.01), (0.008, tall - 0.01), (0.008, tall + 0.06), (0.0, tall + 0.06)], 8)
    dish = lathe([(0.0, -0.03), (0.3, -0.03), (0.34, 0.03), (0.32, 0.03), (0.28, 0.0), (0.0, 0.0)], 32)
    parts = [wax, flame.painted(1), wick.painted(2), dish.painted(3)]
    return Thing("Candle", resting(join(parts)), ("thing", "bulb", "plain", "metal"))


def lantern(dice: Dice) -> Thing:
    """A glowing ball in a cage of rods under a lid."""
    tall = dice.uniform(0.8, 1.2)
    parts = [lathe(rounded_disc(0.4, z, z + 0.06, 0.015), 28) for z in (0.0, tall)]
    count = dice.whole(4, 10)
    for k in range(count):
        x, y = 0.34 * np.cos(2 * np.pi * k / count), 0.34 * np.sin(2 * np.pi * k / count)
        parts.append(tube(np.array([(x, y, 0.05), (x, y, tall + 0.01)]), 0.018, 8))
    glow = ball(dice.uniform(0.1, 0.2), 12, 24).moved((0, 0, tall * 0.5)).painted(1)
    return Thing("Lantern", join([*parts, glow]), ("metal", "bulb"))


def lamp(dice: Dice) -> Thing:
    """Table lamp: foot, stem, an open shade of cloth about a glowing bulb."""
    stem = dice.uniform(0.5, 0.9)
    foot = curve_profile(
        [(0.26, 0.0), (0.24, 0.05), (0.05, 0.12), (dice.uniform(0.03, 0.18), stem / 2), (0.03, stem)], 5
    )
    low, high, tall = dice.uniform(0.35, 0.5), dice.uniform(0.15, 0.4), dice.uniform(0.3, 0.5)
    shade = lathe([(low, stem - 0.05), (high, stem - 0.05 + tall)], 40).painted(1)
    bulb = ball(0.07, 10, 20).moved((0, 0, stem + 0.09)).painted(2)
    body: Shape = lathe([(0.0, 0.0), *foot, (0.0, stem + 0.02)], 32)
    return Thing("Lamp", join([body, shade, bulb]), ("thing", "shade", "bulb"))

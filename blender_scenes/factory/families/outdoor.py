"""A patch of ground under sky or sun: walls, fences, paths, rocks, plants of alpha cut-out cards."""

from __future__ import annotations

import numpy as np
from patterns import spectral_noise
from shapes import grid_uv
from solids import Shape, box, extruded, grid, join, lathe, place, tube

from factory import cut, furniture, soft
from factory.dice import Dice
from factory.lighting import rig
from factory.stage import Stage
from factory.thing import Thing
from factory.things import small
from factory.views import Draw, around

RIGS = {"sun": 3.0, "sunset": 1.2, "clouds": 1.6, "sun lamp": 2.5, "lamps": 0.6}
REACH = 1.6


def _ground(dice: Dice) -> Thing:
    """Flat in the middle where things stand, rough towards its rim."""
    cells = 48
    x, y = np.meshgrid(np.linspace(-REACH, REACH, cells), np.linspace(-REACH, REACH, cells))
    far = np.clip(np.hypot(x, y) / REACH - 0.75, 0, 1)
    z = 0.5 * far * np.abs(spectral_noise(cells, cells, dice.seed(), slope=1.9)) - 0.002
    repeat = dice.pick([2.0, 4.0, 6.0])
    return Thing("Ground", grid(np.stack([x, y, z], axis=-1), grid_uv(cells, cells, repeat, repeat)), ("terrain",), 70)


def fence(dice: Dice, length: float) -> Thing:
    """Palings or rails along x."""
    high = dice.uniform(0.3, 0.6)
    parts: list[Shape] = []
    step = dice.uniform(0.07, 0.14)
    pointed = dice.chance(0.5)
    for x in np.arange(-length / 2, length / 2, step):
        wide = step * 0.6
        if pointed:
            outline = [
                (-wide / 2, 0.0),
                (wide / 2, 0.0),
                (wide / 2, high - 0.04),
                (0.0, high),
                (-wide / 2, high - 0.04),
            ]
            board = extruded(outline, 0.015).moved(turn=np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]))
            parts.append(board.moved((x, 0, 0)))
        else:
            parts.append(box((wide, 0.015, high), at=(x, 0, high / 2)))
    parts += [box((length, 0.02, 0.035), at=(0, 0.018, high * s), scale=1.0) for s in (0.25, 0.75)]
    return Thing("Fence", join(parts), ("wood",), smooth=None)


def wall(dice: Dice, length: float) -> Thing:
    """Low garden wall or a house's side with a window."""
    high = dice.uniform(0.25, 1.1)
    parts = [box((length, 0.1, high), at=(0, 0, high / 2), scale=1.0)]
    parts.append(box((length + 0.04, 0.14, 0.03), at=(0, 0, high + 0.015), scale=1.0).painted(1))
    if high > 0.7:
        parts.append(box((0.35, 0.02, 0.35), at=(dice.uniform(-0.4, 0.4), -0.05, high * 0.6)).painted(2))
    return Thing("Wall", join(parts), ("wall", "ground", dice.pick(["mirror", "plain", "bulb"])), smooth=None)


def columns(dice: Dice, length: float) -> Thing:
    """A row of columns under a beam."""
    high, count = dice.uniform(0.6, 1.1), dice.whole(3, 6)
    parts = []
    for x in np.linspace(-length / 2, length / 2, count):
        shaft = lathe([(0, 0), (0.09, 0), (0.09, 0.04), (0.06, 0.06), (0.05, high - 0.06), (0.09, high), (0, high)], 20)
        parts.append(shaft.moved((x, 0, 0)))
    parts.append(box((length + 0.25, 0.2, 0.1), at=(0, 0, high + 0.05), scale=1.0))
    return Thing("Columns", join(parts), ("wall",), smooth=40)


def bench(dice: Dice) -> Thing:
    parts = [box((0.7, 0.06, 0.02), at=(0, -0.08 + 0.075 * k, 0.2)) for k in range(3)]
    parts += [box((0.7, 0.015, 0.06), at=(0, 0.12, 0.28 + 0.08 * k)) for k in range(2)]
    for s in (-0.28, 0.28):
        path = np.array([(s, -0.09, 0.0), (s, -0.09, 0.19), (s, 0.1, 0.19), (s, 0.13, 0.4)])
        parts += [
            tube(path, 0.012, 8).painted(1),
            tube(np.array([(s, 0.1, 0.19), (s, 0.12, 0.0)]), 0.012, 8).painted(1),
        ]
    return Thing("Bench", join(parts), ("wood", "metal"), smooth=40)


def _grass(stage: Stage) -> None:
    """Linked copies of two or three tufts."""
    dice = stage.dice
    for _ in range(dice.whole(1, 3)):
        tuft = soft.tuft(dice).fitted(0.12, dice.uniform(0.06, 0.16))
        mesh = stage.mesh(tuft)
        for k in range(dice.whole(20, 90)):
            turn, far = dice.uniform(0, 2 * np.pi), REACH * 0.95 * np.sqrt(dice.uniform(0, 1))
            at = (float(far * np.cos(turn)), float(far * np.sin(turn)))
            if all(np.hypot(at[0] - x, at[1] - y) > 0.8 * r for x, y, r in stage.taken):
                place(f"Grass {k}", mesh, at=(*at, 0.0), turn=(0, 0, dice.uniform(0, 360)))


def build(stage: Stage) -> Draw:
    dice = stage.dice
    stage.put(_ground(dice))
    backs = 0
    for turn in (0.0, 90.0):
        if dice.chance(0.55):
            length = dice.uniform(1.6, 2.2)
            back = dice.pick([fence, wall, columns])(dice, length)
            c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
            far = dice.uniform(0.95, 1.1)
            stage.put(back, (float(-s * far), float(c * far), 0.0), turn)
            backs += 1
            stage.taken += [(float(-s * far + c * t), float(c * far + s * t), 0.14) for t in np.linspace(-1, 1, 9)]
    if dice.chance(0.25):  # a pool or puddle
        spot = stage.space(dice.uniform(0.25, 0.45), 0.9)
        if spot is not None:
            radius = stage.taken[-1][2]
            pool = lathe([(0.0, 0.0), (radius * 0.93, 0.0), (radius * 0.93, 0.012), (0.0, 0.012)], 48)
            rim = tube(
                radius * np.array([(np.cos(a), np.sin(a), 0.03) for a in np.arange(32) * np.pi / 16]),
                0.03,
                8,
                closed=True,
            )
            stage.put(
                Thing("Pool", join([pool, rim.painted(1)]), (dice.pick(["liquid", "mirror"]), "ground")), (*spot, 0)
            )
    plants = [soft.tree, soft.bush, soft.tuft, soft.pot_plant]
    others = [soft.rock, soft.rock, cut.house, cut.crate, cut.stairs, bench, furniture.table, furniture.chair]
    makers = [dice.pick(plants) for _ in range(dice.whole(1, 4))] + [dice.pick(others) for _ in range(dice.whole(1, 4))]
    things = [make(dice) for make in makers] + [small(dice) for _ in range(dice.whole(0, 4))]
    large = {"Tree": (0.35, 0.55), "House": (0.2, 0.4), "Bench": (0.3, 0.4), "Bush": (0.15, 0.35)}
    sizes = [dice.uniform(*large.get(thing.name, (0.08, 0.25))) for thing in things]
    height = stage.scatter(things, sizes, 0.0, 0.95)
    if dice.chance(0.7):
        _grass(stage)
    rig(dice, REACH, (0, 0, 0.2), RIGS)
    # Backs stand at +y and -x: look at them, not from behind them.
    azimuth = (-15.0, 75.0) if backs else (-180.0, 180.0)
    return around((0, 0, 0.25 * height), dice.uniform(0.55, 0.95), azimuth=azimuth, elevation=(5.0, 40.0))

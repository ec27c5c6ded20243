"""One to three finely made things under soft boxes, before a plain bright or dark world."""

from __future__ import annotations

from collections.abc import Callable

from solids import box

from factory import cut, soft, turned, wiry
from factory.dice import Dice
from factory.families.table import backdrop, disc
from factory.lighting import lamp, plain_world, rig
from factory.stage import Stage
from factory.thing import Thing
from factory.views import Draw, around

HEROES: dict[Callable[[Dice], Thing], float] = {
    turned.bottle: 2.0,
    turned.vase: 1.5,
    turned.mug: 1.2,
    turned.drinking_glass: 1.5,
    turned.lamp: 1.0,
    turned.lantern: 0.7,
    turned.turned_wood: 1.0,
    turned.torus: 0.6,
    wiry.knot: 1.2,
    wiry.spring: 0.6,
    wiry.cage: 0.6,
    cut.gem: 1.2,
    cut.gear: 0.8,
    cut.block: 0.6,
    soft.suzanne: 1.3,
    soft.text: 1.0,
    soft.blob: 1.2,
    soft.cushion: 0.7,
    soft.pot_plant: 0.7,
}


def build(stage: Stage) -> Draw:
    dice = stage.dice
    kind = dice.weighted({"paper": 3.0, "disc": 2.0, "floor": 2.0, "mirror": 0.8, "none": 1.0})
    if kind == "paper":
        stage.put(backdrop(dice, 1.1))
    elif kind == "disc":
        stage.put(Thing("Disc", disc(1.05, dice.uniform(0.03, 0.4)), (dice.pick(["plain", "ground", "metal"]),)))
    elif kind in ("floor", "mirror"):
        role = "mirror" if kind == "mirror" else dice.pick(["plain", "ground"])
        stage.put(Thing("Floor", box((3.0, 3.0, 0.04), at=(0, 0, -0.02)), (role,), smooth=None))
    count = dice.weighted({1: 3.0, 2: 1.0, 3: 1.0})
    sizes = [dice.uniform(0.6, 0.85) if count == 1 else dice.uniform(0.3, 0.5) for _ in range(count)]
    heroes = [dice.weighted(HEROES)(dice) for _ in sizes]
    height = stage.scatter(heroes, sizes, 0.0, 1.0)
    if dice.chance(0.7):
        plain_world(dice, *dice.pick([(0.005, 0.05), (0.3, 1.5)]))
        for _ in range(dice.whole(1, 3)):
            lamp(dice, "area", 1.0, (0, 0, height / 2))
        if dice.chance(0.25):
            lamp(dice, "spot", 1.0, (0, 0, height / 2))
    else:
        rig(dice, 1.0, (0, 0, height / 2))
    azimuth = (-50.0, 50.0) if kind == "paper" else (-180.0, 180.0)
    elevation = (-10.0, 40.0) if kind == "none" else (6.0, 45.0)
    return around((0, 0, 0.42 * height), max(0.62 * height, 0.7), azimuth=azimuth, elevation=elevation)

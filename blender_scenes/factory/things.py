"""Which small things there are, and how often each stands in a scene."""

from __future__ import annotations

from collections.abc import Callable

from factory import cut, soft, turned, wiry
from factory.dice import Dice
from factory.thing import Thing

SMALL: dict[Callable[[Dice], Thing], float] = {
    turned.sphere: 2.0,
    turned.cylinder: 1.2,
    turned.rod: 0.6,
    turned.cone: 0.7,
    turned.torus: 0.8,
    turned.vase: 1.5,
    turned.turned_wood: 1.0,
    turned.bowl: 1.0,
    turned.plate: 0.5,
    turned.mug: 1.0,
    turned.drinking_glass: 1.3,
    turned.bottle: 1.2,
    turned.fruit: 1.3,
    turned.candle: 0.5,
    turned.lantern: 0.25,
    turned.lamp: 0.3,
    wiry.spring: 0.6,
    wiry.knot: 0.8,
    wiry.tangle: 0.7,
    wiry.cage: 0.6,
    wiry.stand: 0.4,
    wiry.chain: 0.4,
    cut.block: 1.5,
    cut.prism: 1.0,
    cut.gear: 0.5,
    cut.gem: 1.0,
    cut.stack: 0.8,
    cut.books: 1.0,
    cut.crate: 0.4,
    cut.house: 0.4,
    cut.picture_frame: 0.5,
    cut.stairs: 0.3,
    soft.cushion: 0.5,
    soft.cloth: 0.5,
    soft.paper: 0.4,
    soft.blob: 0.8,
    soft.rock: 0.8,
    soft.text: 0.7,
    soft.suzanne: 0.6,
    soft.tuft: 0.5,
    soft.pot_plant: 0.8,
    soft.screen: 0.25,
}


def small(dice: Dice) -> Thing:
    """Any small thing, about one unit large."""
    return dice.weighted(SMALL)(dice)

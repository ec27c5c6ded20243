"""Swept things: springs, knots, tangles, wire cages, chains."""

from __future__ import annotations

import numpy as np
from shapes import spline
from solids import join, loop_spline, tube

from factory.dice import Dice
from factory.thing import Thing, resting


def _role(dice: Dice) -> tuple[str, ...]:
    return (dice.pick(["metal", "metal", "thing", "plain"]),)


def spring(dice: Dice) -> Thing:
    turns = dice.whole(3, 8)
    t = np.linspace(0, 1, turns * 16)
    reach = 0.4 * (1 - dice.pick([0.0, 0.6]) * t)
    angle = 2 * np.pi * turns * t
    path = np.stack([reach * np.cos(angle), reach * np.sin(angle), dice.uniform(0.5, 1.4) * t], axis=-1)
    return Thing("Spring", resting(tube(path, dice.uniform(0.02, 0.06), 10, repeats=(1, 20))), _role(dice))


def knot(dice: Dice) -> Thing:
    """Torus knot."""
    p, q = dice.pick([(2, 3), (3, 2), (2, 5), (3, 4), (3, 5)])
    t = np.linspace(0, 2 * np.pi, 40 * q, endpoint=False)
    ring = 0.34 + 0.14 * np.cos(q * t)
    path = np.stack([ring * np.cos(p * t), ring * np.sin(p * t), 0.16 * np.sin(q * t)], axis=-1)
    shape = tube(path, dice.uniform(0.03, 0.075), 12, closed=True, repeats=(1, 24))
    return Thing("Knot", resting(shape, (0, dice.pick([0.0, 90.0, 60.0]))))


def tangle(dice: Dice) -> Thing:
    """A cable thrown down, or twisted sculpture: a closed curve through random knots."""
    flat = dice.pick([0.12, 0.12, 0.9])
    knots = dice.rng.uniform(-0.45, 0.45, (dice.whole(5, 10), 3)) * np.array([1, 1, flat])
    return Thing(
        "Tangle", resting(tube(loop_spline(knots, 14), dice.uniform(0.012, 0.05), 8, closed=True)), _role(dice)
    )


def cage(dice: Dice) -> Thing:
    """Wire globe or basket: meridians and parallels."""
    top = dice.pick([np.pi / 2 * 0.96, 0.0, 0.4])
    lat = np.linspace(-np.pi / 2 * 0.96, top, 14)
    thin, count = dice.uniform(0.006, 0.02), dice.whole(8, 20)
    parts = []
    for k in range(count):
        turn = 2 * np.pi * k / count
        path = 0.5 * np.stack([np.cos(lat) * np.cos(turn), np.cos(lat) * np.sin(turn), np.sin(lat)], axis=-1)
        parts.append(tube(path, thin, 6))
    around = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    for a in np.linspace(-1.2, top, dice.whole(3, 6)):
        ring = 0.5 * np.stack([np.cos(a) * np.cos(around), np.cos(a) * np.sin(around), 0 * around + np.sin(a)], axis=-1)
        if np.cos(a) > 0.15:
            parts.append(tube(ring, thin, 6, closed=True))
    return Thing("Cage", resting(join(parts)), _role(dice))


def stand(dice: Dice) -> Thing:
    """Bent wire on a foot: hooks, clothes tree, a desk toy."""
    parts = []
    for _ in range(dice.whole(2, 5)):
        turn = dice.uniform(0, 2 * np.pi)
        knots = np.array([(0, 0, 0.0), (0, 0, 0.5), (0.15, 0, 0.8), (0.35, 0, dice.uniform(0.5, 1.2))])
        c, s = np.cos(turn), np.sin(turn)
        path = spline(knots, 8) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        parts.append(tube(path, 0.02, 8))
    around = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    foot = np.stack([0.3 * np.cos(around), 0.3 * np.sin(around), 0 * around], axis=-1)
    parts += [tube(foot, 0.025, 8, closed=True), tube(np.array([(-0.3, 0, 0.0), (0, 0, 0.01), (0.3, 0, 0.0)]), 0.02, 8)]
    return Thing("Wire stand", resting(join(parts)), _role(dice))


def chain(dice: Dice) -> Thing:
    """Links along an arc, each a quarter turn from the last."""
    count, turn = dice.whole(6, 14), np.linspace(0, 2 * np.pi, 20, endpoint=False)
    link = np.stack([0.075 * np.cos(turn), 0.045 * np.sin(turn), 0 * turn], axis=-1)
    parts = []
    for k in range(count):
        a = 1.6 * np.pi * k / count
        shape = tube(link, 0.014, 8, closed=True)
        tilted = resting(shape, (0, 45.0 if k % 2 else -45.0), (2, float(np.degrees(a)) + 90))
        reach = count * 0.11 / (1.6 * np.pi)
        parts.append(tilted.moved((reach * np.cos(a), reach * np.sin(a), 0)))
    return Thing("Chain", resting(join(parts)), ("metal",))

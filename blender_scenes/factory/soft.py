"""Soft, grown and written things: cushions, cloth, rocks, blobs, text, Suzanne, plants of cards."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from patterns import lattice_noise, spectral_noise
from shapes import cushion as cushion_mesh
from shapes import grid_uv, spline
from solids import Shape, ball, box_uv, grid, join, lathe, rotation, tube

from factory.dice import Dice
from factory.thing import Thing, resting, shape_of

WORDS = ("LIGHT", "Aa", "B", "7", "&", "OPEN", "R2", "hello", "42", "mesh", "S", "Q", "?", "ok", "NOVA", "83")


def cushion(dice: Dice) -> Thing:
    wide, deep = dice.uniform(0.7, 1.0), dice.uniform(0.7, 1.0)
    mesh = cushion_mesh("Cushion", (wide, deep, 0.12), 0.05, dice.uniform(0.05, 0.15), 8)
    return Thing("Cushion", resting(shape_of(mesh)), ("cloth",), smooth=60)


def _relief(dice: Dice, size: int, slope: float, lowest: float = 1.0) -> np.ndarray:
    return spectral_noise(size, size, dice.seed(), slope=slope, lowest=lowest)


def cloth(dice: Dice) -> Thing:
    """A sheet thrown down in folds, one-sided as cloth is modelled."""
    size = 40
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, size), np.linspace(-0.5, 0.5, size))
    z = np.clip(0.05 + 0.045 * _relief(dice, size, dice.uniform(1.4, 2.2)), 0.004, None)
    shape = grid(np.stack([x, y, z], axis=-1), grid_uv(size, size))
    return Thing("Cloth", resting(shape, (2, dice.uniform(0, 90))), ("cloth",), smooth=70)


def paper(dice: Dice) -> Thing:
    """Crumpled or curled sheet."""
    size = 24
    x, y = np.meshgrid(np.linspace(-0.35, 0.35, size), np.linspace(-0.5, 0.5, size))
    z = dice.uniform(0.2, 1.5) * y**2 + dice.uniform(0.0, 0.02) * _relief(dice, size, 1.2)
    roles = (dice.pick(["paper", "thing", "shade"]),)
    return Thing("Sheet", resting(grid(np.stack([x, y, z], axis=-1), grid_uv(size, size))), roles, smooth=30)


def blob(dice: Dice) -> Thing:
    """Smooth lump, abstract sculpture."""
    shape = ball(0.5, 28, 48, (2, 1))
    noise = lattice_noise(shape.points + dice.uniform(0, 9), dice.uniform(1.5, 3.0), 1, dice.seed())
    shape.points = shape.points * (0.55 + 0.9 * noise)[:, None]
    return Thing("Blob", resting(shape), smooth=80)


def rock(dice: Dice) -> Thing:
    shape = ball(0.5, 16, 26, (2, 1))
    noise = lattice_noise(shape.points + dice.uniform(0, 9), 2.5, 3, dice.seed())
    stretch = dice.rng.uniform([0.7, 0.7, 0.45], [1.0, 1.0, 0.8])
    shape.points = shape.points * (0.5 + 0.9 * noise)[:, None] * stretch
    return Thing("Rock", resting(shape), ("ground",), smooth=dice.pick([None, 30.0, 70.0]))


def text(dice: Dice) -> Thing:
    """Extruded letters that stand, in Blender's own font."""
    curve: Any = bpy.data.curves.new("Text", "FONT")
    curve.body = dice.pick(WORDS)
    curve.extrude, curve.bevel_depth, curve.resolution_u = dice.uniform(0.05, 0.2), dice.pick([0.0, 0.015]), 3
    body = bpy.data.objects.new("Text", curve)
    bpy.context.scene.collection.objects.link(body)
    mesh = bpy.data.meshes.new_from_object(body.evaluated_get(bpy.context.evaluated_depsgraph_get()))
    bpy.data.objects.remove(body)
    bpy.data.curves.remove(curve)
    shape = shape_of(mesh)
    shape = Shape(shape.points, shape.faces, box_uv(shape.points, shape.faces, 1.0))
    return Thing("Text", resting(shape, (0, 90.0)), smooth=30)


def suzanne(dice: Dice) -> Thing:
    """Blender's monkey, leaning back on its chin."""
    bpy.ops.mesh.primitive_monkey_add(size=1.0)
    body = bpy.context.object
    mesh = body.data
    bpy.data.objects.remove(body)
    return Thing("Suzanne", resting(shape_of(mesh), (0, -dice.uniform(20, 40))), smooth=60, modifier="subdivide")


# ---------------------------------------------------------------- plants


def _card(length: float, width: float, bend: float, lean: float, turn: float, at: np.ndarray) -> Shape:
    """One leaf card of three quads that bends down; u across, v along."""
    t = np.linspace(0, 1, 4)
    angle = np.radians(lean) - bend * t
    along = np.concatenate([[0], np.cumsum(np.cos(angle[1:]) * length / 3)])
    rise = np.concatenate([[0], np.cumsum(np.sin(angle[1:]) * length / 3)])
    points = np.stack([np.stack([along, 0 * t + s * width / 2, rise], axis=-1) for s in (1, -1)], axis=1)
    return grid(points, grid_uv(4, 2)).moved(at, turn=rotation(2, turn))


def leaves(dice: Dice, spots: np.ndarray, size: float, lean: tuple[float, float]) -> Shape:
    """A card at each spot [N, 3], turned at random."""
    wide = dice.uniform(0.35, 0.8)
    cards = [
        _card(
            size * dice.uniform(0.7, 1.2),
            size * wide,
            dice.uniform(0.1, 1.2),
            dice.uniform(*lean),
            dice.uniform(0, 360),
            p,
        )
        for p in spots
    ]
    return join(cards)


def tuft(dice: Dice) -> Thing:
    """Grass, fern or flowers that rise from one place."""
    spots = dice.rng.uniform(-0.08, 0.08, (dice.whole(8, 24), 3)) * np.array([1, 1, 0])
    return Thing("Tuft", resting(leaves(dice, spots, 0.7, (35, 85))), ("leaf",), smooth=80)


def bush(dice: Dice) -> Thing:
    """A round heap of cards."""
    count = dice.whole(60, 160)
    spots = dice.rng.normal(size=(count, 3))
    spots *= (dice.rng.uniform(0.5, 1.0, count) / np.linalg.norm(spots, axis=1))[:, None] * np.array([0.4, 0.4, 0.35])
    return Thing("Bush", resting(leaves(dice, spots, 0.22, (-20, 70))), ("leaf",), smooth=80)


def tree(dice: Dice) -> Thing:
    """Trunk, boughs, a crown of cards."""
    tall = dice.uniform(1.0, 1.6)
    trunk = spline(np.array([(0, 0, 0), (dice.uniform(-0.1, 0.1), 0, tall / 2), (0, dice.uniform(-0.1, 0.1), tall)]), 6)
    parts = [tube(trunk, np.linspace(0.07, 0.03, len(trunk)), 10, repeats=(2, 6))]
    spots = []
    for _ in range(dice.whole(5, 9)):
        start = trunk[dice.whole(5, len(trunk) - 1)]
        turn, reach = dice.uniform(0, 2 * np.pi), dice.uniform(0.25, 0.5)
        end = start + np.array([reach * np.cos(turn), reach * np.sin(turn), dice.uniform(0.1, 0.4)])
        middle = (start + end) / 2 + np.array([0, 0, 0.05])
        bough = spline(np.array([start, middle, end]), 4)
        parts.append(tube(bough, np.linspace(0.025, 0.008, len(bough)), 6))
        spots.append(bough[3:].repeat(3, 0) + dice.rng.normal(scale=0.08, size=((len(bough) - 3) * 3, 3)))
    crown = leaves(dice, np.concatenate(spots), 0.18, (-40, 50)).painted(1)
    return Thing("Tree", resting(join([*parts, crown])), ("wood", "leaf"), smooth=80)


def pot_plant(dice: Dice) -> Thing:
    """Leaves on stalks in a pot of soil."""
    pot = lathe([(0.0, 0.0), (0.16, 0.0), (0.22, 0.3), (0.24, 0.3), (0.24, 0.34), (0.2, 0.34), (0.19, 0.29)], 32)
    soil = lathe([(0.192, 0.29), (0.0, 0.3)], 24).painted(1)
    parts, spots = [pot, soil], []
    for _ in range(dice.whole(4, 9)):
        turn, reach, tall = dice.uniform(0, 2 * np.pi), dice.uniform(0.02, 0.3), dice.uniform(0.3, 0.9)
        end = np.array([reach * np.cos(turn), reach * np.sin(turn), 0.3 + tall])
        stalk = spline(
            np.array([end * np.array([0.2, 0.2, 0]) + (0, 0, 0.29), end * np.array([0.4, 0.4, 0.6]), end]), 4
        )
        parts.append(tube(stalk, 0.008, 6).painted(2))
        spots.append(stalk[4:])
    parts.append(leaves(dice, np.concatenate(spots), dice.uniform(0.2, 0.35), (-20, 60)).painted(3))
    return Thing("Pot plant", join(parts), ("ceramic", "soil", "plain", "leaf"), smooth=60)


def screen(dice: Dice) -> Thing:
    """A standing card with holes: lace, mesh, slats."""
    t = np.linspace(-0.5, 0.5, 17)
    wave = dice.uniform(0.0, 0.12) * np.sin(dice.uniform(4, 12) * t)
    points = np.stack([np.stack([t, wave, 0 * t + z], axis=-1) for z in (0.0, 0.9)])
    return Thing("Screen", resting(grid(points, grid_uv(2, 17, 2.0, 2.0))), ("net",), smooth=80)

"""Things with edges: boxes, prisms, gems, gears, stacks, books, crates, toys."""

from __future__ import annotations

import numpy as np
from gems import brilliant, emerald_cut
from gems import resting as tilted_gem
from shapes import rounded_disc
from solids import Shape, box, extruded, join, lathe

from factory.dice import Dice
from factory.thing import Thing, resting


def block(dice: Dice) -> Thing:
    """Box with sharp, chamfered or live-bevelled edges."""
    x, y, z = (dice.log(0.3, 1.0) for _ in range(3))
    top = (0.0, 0.0, z, 0.45 * min(x, y))
    kind = dice.pick(["sharp", "chamfer", "bevel"])
    chamfer = 0.03 * min(x, y, z) if kind == "chamfer" else 0.0
    shape = resting(box((x, y, z), bevel=chamfer, scale=dice.pick([1.0, 2.0])))
    return Thing("Box", shape, smooth=40 if kind == "bevel" else None, modifier="bevel" * (kind == "bevel"), top=top)


def prism(dice: Dice) -> Thing:
    """Extruded polygon, star, letter L, cross or arch."""
    kind = dice.pick(["polygon", "star", "L", "cross", "arch"])
    if kind in ("polygon", "star"):
        count = dice.whole(3, 8)
        turn = np.linspace(0, 2 * np.pi, 2 * count, endpoint=False)
        reach = np.where(np.arange(2 * count) % 2, dice.uniform(0.2, 0.3) if kind == "star" else 0.5, 0.5)
        outline = np.stack([reach * np.cos(turn), reach * np.sin(turn)], axis=-1)[:: 1 if kind == "star" else 2]
        points = [(float(x), float(y)) for x, y in outline]
    elif kind == "L":
        points = [(0, 0), (0.8, 0), (0.8, 0.3), (0.3, 0.3), (0.3, 1.0), (0, 1.0)]
    elif kind == "cross":
        points = [(0.3, 0), (0.6, 0), (0.6, 0.3), (0.9, 0.3), (0.9, 0.6), (0.6, 0.6), (0.6, 0.9), (0.3, 0.9)]
        points += [(0.3, 0.6), (0, 0.6), (0, 0.3), (0.3, 0.3)]
    else:
        turn = np.linspace(0, np.pi, 14)
        arc = [(float(0.5 + 0.3 * np.cos(a)), float(0.4 + 0.3 * np.sin(a))) for a in turn]
        points = [(0, 0), (0.2, 0), *arc[::-1], (0.8, 0), (1, 0), (1, 0.9), (0, 0.9)]
    shape = extruded(points, dice.uniform(0.2, 0.6), dice.pick([1.0, 2.0]))
    upright = kind in ("L", "arch", "cross") or dice.chance(0.4)
    return Thing(kind.capitalize(), resting(shape, (0, 90.0 if upright else 0.0)), smooth=30)


def gear(dice: Dice) -> Thing:
    teeth = dice.whole(8, 20)
    turn = np.linspace(0, 2 * np.pi, 4 * teeth, endpoint=False)
    reach = np.where(np.arange(4 * teeth) % 4 < 2, 0.5, 0.41)
    outline = [(float(r * np.cos(a)), float(r * np.sin(a))) for r, a in zip(reach, turn, strict=True)]
    wheel = extruded(outline, dice.uniform(0.1, 0.3), 1.0)
    hub = lathe(rounded_disc(0.14, -0.25, 0.25, 0.02), 24)
    shape = resting(join([wheel, hub.painted(1)]), (0, dice.pick([0.0, 0.0, 90.0])))
    return Thing("Gear", shape, ("metal", "metal"), smooth=30)


def gem(dice: Dice) -> Thing:
    """Cut stone in glass, or a crystal of another stuff."""
    stone = brilliant(0.5) if dice.chance(0.6) else emerald_cut(0.5, 0.35)
    shape = tilted_gem(stone, dice.pick([0.0, 180.0, 41.0, 55.0]), dice.uniform(0, 360))
    return Thing("Gem", resting(shape), (dice.pick(["glass", "glass", "thing"]),), smooth=None)


def _piled(parts: list[tuple[Shape, float]], dice: Dice, sway: float) -> Shape:
    """Parts of given heights on top of each other, each shifted and turned a little."""
    out: list[Shape] = []
    level = 0.0
    for shape, height in parts:
        turned = resting(shape, (2, dice.uniform(-14, 14)))
        out.append(turned.moved((dice.uniform(-sway, sway), dice.uniform(-sway, sway), level)))
        level += height + 0.001
    return join(out)


def stack(dice: Dice) -> Thing:
    """Coins, plates, blocks or discs piled up."""
    count, kind = dice.whole(3, 9), dice.pick(["coins", "blocks", "pyramid"])
    parts: list[tuple[Shape, float]] = []
    for k in range(count):
        if kind == "coins":
            shape, high = lathe(rounded_disc(0.4, 0.0, 0.07, 0.01), 36), 0.07
        else:
            wide = 0.7 * (1 - k / (count + 1) if kind == "pyramid" else dice.uniform(0.7, 1.0))
            high = dice.uniform(0.1, 0.25)
            shape = box((wide, wide, high), bevel=0.01, scale=2.0)
        parts.append((shape.painted(k % 3), high))
    return Thing("Stack", _piled(parts, dice, 0.03), ("thing", "thing", "plain"), smooth=30)


def _book(thick: float, tall: float, deep: float) -> Shape:
    """Covers and a spine about pages that stand back from them; lies flat, spine to -x."""
    cover = 0.012
    pages = box((deep - 0.03, tall - 0.03, thick - 2 * cover), at=(0.005, 0, 0)).painted(1)
    lids = [box((deep, tall, cover), at=(0, 0, s * (thick - cover) / 2)) for s in (-1, 1)]
    spine = box((cover, tall, thick), at=(-(deep + cover) / 2, 0, 0))
    return join([pages, *lids, spine])


def books(dice: Dice) -> Thing:
    """A pile of books, or a row that stands."""
    if dice.chance(0.5):
        parts: list[tuple[Shape, float]] = []
        for k in range(dice.whole(1, 6)):
            thick = dice.uniform(0.06, 0.18)
            book = _book(thick, dice.uniform(0.7, 1.0), dice.uniform(0.5, 0.7))
            parts.append(
                (Shape(book.points, book.faces, book.uv, [2 * (k % 3) * (1 - s) + s for s in book.slots]), thick)
            )
        level = sum(high + 0.001 for _, high in parts)
        roles = ("thing", "paper", "plain", "paper", "cloth")
        return Thing("Books", _piled(parts, dice, 0.04), roles, smooth=None, top=(0, 0, level, 0.22))
    return book_row(dice, dice.uniform(0.6, 1.4))


def book_row(dice: Dice, length: float) -> Thing:
    """Books that stand side by side along x, spines to -y."""
    out: list[Shape] = []
    x = 0.0
    while x < length:
        thick, tall = dice.uniform(0.06, 0.16), dice.uniform(0.6, 0.9)
        book = _book(thick, tall, dice.uniform(0.45, 0.6))
        slot = 2 * dice.whole(0, 2)
        book = Shape(book.points, book.faces, book.uv, [1 if s else slot for s in book.slots])
        book = resting(book, (0, 90.0), (2, 90.0))  # on its lower edge, spine to the front
        depth = np.ptp(book.points[:, 1])
        out.append(book.moved((x + thick / 2, depth / 2, 0)))
        x += thick + 0.006
    return Thing("Book row", resting(join(out)), ("thing", "paper", "plain", "paper", "cloth"), smooth=None)


def crate(dice: Dice) -> Thing:
    """Open box of slats."""
    x, y, z, thick = 0.9, dice.uniform(0.5, 0.9), dice.uniform(0.3, 0.6), 0.03
    parts = [box((x, y, thick), at=(0, 0, thick / 2), scale=1.0)]
    for k in range(rows := dice.whole(1, 3)):
        high = z / rows * 0.85
        level = thick + z / rows * (k + 0.5)
        for s in (-1, 1):
            parts.append(box((x, thick, high), at=(0, s * (y + thick) / 2, level)))
            parts.append(box((thick, y, high), at=(s * (x - thick) / 2, 0, level)))
    return Thing("Crate", join(parts), ("wood",), smooth=None)


def house(dice: Dice) -> Thing:
    """Toy house: walls, gabled roof, door and windows as thin plates."""
    x, y, z, rise = 0.7, dice.uniform(0.6, 1.0), dice.uniform(0.4, 0.8), dice.uniform(0.2, 0.45)
    walls = box((x, y, z), at=(0, 0, z / 2), scale=2.0)
    gable = resting(extruded([(-x / 2 - 0.06, 0), (x / 2 + 0.06, 0), (0, rise)], y + 0.1, 2.0), (0, 90.0))
    plates = [box((0.12, 0.02, 0.25), at=(0, -y / 2 - 0.005, 0.125))]
    for s in (-0.22, 0.22):
        plates.append(box((0.12, 0.02, 0.12), at=(s, -y / 2 - 0.005, z * 0.6)))
        plates.append(box((0.02, 0.16, 0.12), at=(x / 2 + 0.005, s, z * 0.6)))
    shape = join([walls, gable.moved((0, 0, z)).painted(1), *[p.painted(2) for p in plates]])
    return Thing("House", shape, ("wall", "thing", dice.pick(["plain", "bulb", "mirror", "wood"])), smooth=None)


def picture_frame(dice: Dice) -> Thing:
    """Picture or mirror in a frame that leans back."""
    wide, tall, rim = dice.uniform(0.5, 0.9), dice.uniform(0.5, 1.0), dice.uniform(0.04, 0.1)
    parts = [box((wide, 0.02, tall), at=(0, 0, 0), scale=1.0 / max(wide, tall)).painted(1)]
    for s in (-1, 1):
        parts.append(box((wide + 2 * rim, 0.05, rim), at=(0, -0.01, s * (tall + rim) / 2), bevel=0.006))
        parts.append(box((rim, 0.05, tall), at=(s * (wide + rim) / 2, -0.01, 0), bevel=0.006))
    shape = resting(join(parts), (0, -dice.uniform(5, 18)))
    return Thing("Picture", shape, (dice.pick(["wood", "metal"]), dice.pick(["thing", "mirror"])), smooth=None)


def stairs(dice: Dice) -> Thing:
    count, wide = dice.whole(3, 7), dice.uniform(0.4, 0.8)
    parts = [box((wide, 0.14, 0.12 * (k + 1)), at=(0, 0.14 * k, 0.06 * (k + 1)), scale=2.0) for k in range(count)]
    return Thing("Stairs", resting(join(parts)), ("thing",), smooth=None)

"""A room, closed or with windows, a door or an open side: furniture, lamps, light through openings, camera inside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from building import area_light, flat_world, point_light, sun_light
from shapes import grid_uv
from solids import Shape, ball, box, grid, join, lathe

from factory import furniture, soft
from factory.dice import Dice
from factory.lighting import image_sky, tint
from factory.stage import Stage
from factory.thing import Thing
from factory.things import small
from factory.views import Draw, inside

ALONG: dict[Callable[[Dice], Thing], float] = {
    furniture.sofa: 1.5,
    furniture.bed: 0.8,
    furniture.cabinet: 1.5,
    furniture.bookcase: 1.5,
    furniture.fireplace: 0.4,
    furniture.table: 1.0,
    furniture.chair: 0.7,
    furniture.floor_lamp: 1.0,
}
FREE: dict[Callable[[Dice], Thing], float] = {
    furniture.table: 1.5,
    furniture.chair: 1.5,
    furniture.stool: 1.0,
    soft.pot_plant: 0.7,
    furniture.floor_lamp: 0.5,
}
THICK = 0.05
Hole = tuple[float, float, float, float]  # from, to along the wall, sill, lintel
Blocked = tuple[float, float, float, float, float]


def _wall(length: float, high: float, holes: list[Hole]) -> Shape:
    """Wall along x from -length / 2, its inner face at y = 0, with rectangular holes side by side."""
    parts: list[Shape] = []
    x = -length / 2

    def piece(a: float, b: float, low: float, top: float) -> None:
        if b - a > 1e-4 and top - low > 1e-4:
            parts.append(box((b - a, THICK, top - low), at=((a + b) / 2, THICK / 2, (low + top) / 2), scale=1.0))

    for a, b, sill, lintel in sorted(holes):
        piece(x, a, 0, high)
        piece(a, b, 0, sill)
        piece(a, b, lintel, high)
        x = b
    piece(x, length / 2, 0, high)
    return join(parts)


def _window_bars(hole: Hole) -> Shape:
    """Frame and cross of a window, in its wall's coordinates."""
    a, b, low, top = hole
    bar, y, x, z = 0.02, THICK * 0.5, (a + b) / 2, (low + top) / 2
    sides = [box((bar, 0.03, top - low), at=(px, y, z)) for px in (a + bar / 2, x, b - bar / 2)]
    rails = [box((b - a, 0.028, bar), at=(x, y, pz)) for pz in (low + bar / 2, z, top - bar / 2)]
    return join([*sides, *rails])


def _curtain(hole: Hole, high: float, dice: Dice) -> Shape:
    """A wavy sheet before a part of the window."""
    a, b, _, top = hole
    wide = (b - a) * dice.uniform(0.3, 0.6)
    t = np.linspace(0, 1, 60)
    y = -0.05 - 0.02 * np.sin(t * dice.whole(5, 9) * 2 * np.pi)
    rows = [np.stack([a - 0.05 + wide * t, y, 0 * t + z], axis=-1) for z in (0.03, min(top + 0.08, high - 0.01))]
    return grid(np.stack(rows), grid_uv(2, 60, 4.0, 4.0))


def _holes(dice: Dice, length: float, high: float) -> list[Hole]:
    """None, windows, or a door."""
    kind = dice.weighted({"none": 2.0, "window": 2.5, "windows": 1.0, "door": 0.8, "slit": 0.5})
    if kind == "none":
        return []
    if kind == "windows":
        wide = length * 0.25
        return [(s * length * 0.25 - wide / 2, s * length * 0.25 + wide / 2, high * 0.3, high * 0.82) for s in (-1, 1)]
    wide = {"window": dice.uniform(0.4, 1.0), "door": 0.4, "slit": 0.1}[kind]
    middle = dice.uniform(-0.4, 0.4) * (length - wide - 0.2)
    low, top = (0.0, 0.85 * high) if kind == "door" else (high * dice.uniform(0.2, 0.4), high * dice.uniform(0.7, 0.9))
    return [(middle - wide / 2, middle + wide / 2, low, top)]


def _footprint(thing: Thing, quarter: int) -> tuple[float, float]:
    """Half sizes along x and y after a number of quarter turns."""
    x, y = np.abs(thing.shape.points[:, :2]).max(0)
    return (float(y), float(x)) if quarter % 2 else (float(x), float(y))


class Room:
    """A box room: x in (-w, w), y in (-d, d), z in (0, h)."""

    def __init__(self, stage: Stage) -> None:
        self.stage, self.dice = stage, stage.dice
        self.w, self.d, self.h = (self.dice.uniform(a, b) for a, b in ((0.8, 1.4), (0.8, 1.3), (0.85, 1.2)))
        self.blocked: list[Blocked] = []
        self.holes: list[tuple[int, Hole]] = []  # wall, hole

    def shell(self) -> None:
        """Floor, ceiling and four walls; wall k faces inward after k quarter turns, wall 0 is the one at +y."""
        dice, stage = self.dice, self.stage
        kind = dice.weighted({"closed": 3.0, "open side": 1.0, "no ceiling": 1.0})
        size = (2 * self.w + 2 * THICK, 2 * self.d + 2 * THICK, THICK)
        stage.put(Thing("Floor", box(size, at=(0, 0, -THICK / 2), scale=1.0), ("ground",), smooth=None))
        if kind != "no ceiling":
            ceiling = box(size, at=(0, 0, self.h + THICK / 2), scale=1.0)
            stage.put(Thing("Ceiling", ceiling, ("ceiling",), smooth=None))
        gone = 2 if kind == "open side" else -1
        self.open = kind != "closed"
        for k in range(4):
            if k == gone:
                continue
            across = self.w if k % 2 == 0 else self.d
            out = self.d if k % 2 == 0 else self.w
            holes = _holes(dice, 2 * across, self.h)
            self.holes += [(k, hole) for hole in holes]
            parts = [_wall(2 * across + (2 * THICK if k % 2 else 0), self.h, holes)]
            roles = ["wall"]
            windows = [hole for hole in holes if hole[2] > 0]
            if windows and dice.chance(0.7):
                parts += [_window_bars(hole).painted(1) for hole in windows]
                roles.append("wood")
            turn = np.array([[np.cos(q := k * np.pi / 2), -np.sin(q), 0], [np.sin(q), np.cos(q), 0], [0, 0, 1]])
            shape = join(parts).moved((0, out, 0)).moved(turn=turn)
            stage.put(Thing("Wall", shape, tuple(roles), smooth=None))
            for hole in windows:
                if dice.chance(0.3):
                    sheet = _curtain(hole, self.h, dice).moved((0, out, 0)).moved(turn=turn)
                    stage.put(Thing("Curtain", sheet, (dice.pick(["cloth", "shade"]),), smooth=80))

    def _fits(self, x: float, y: float, hx: float, hy: float, gap: float = 0.02) -> bool:
        if abs(x) + hx > self.w - 0.01 or abs(y) + hy > self.d - 0.01:
            return False
        return not any(
            x - hx - gap < x1 and x + hx + gap > x0 and y - hy - gap < y1 and y + hy + gap > y0
            for x0, y0, x1, y1, _ in self.blocked
        )

    def _stand(self, thing: Thing, x: float, y: float, quarter: int) -> None:
        hx, hy = _footprint(thing, quarter)
        self.stage.put(thing, (x, y, 0.0), 90.0 * quarter)
        self.blocked.append((x - hx, y - hy, x + hx, y + hy, float(thing.size[2])))
        if thing.top is not None and self.dice.chance(0.8):
            self._on_top(thing, x, y)

    def _on_top(self, thing: Thing, x: float, y: float) -> None:
        """One to four small things on a level place."""
        assert thing.top is not None
        level, radius = thing.top[2], thing.top[3]
        keep, self.stage.taken = self.stage.taken, []
        sizes = [self.dice.uniform(0.25, 0.5) * radius for _ in range(self.dice.whole(1, 4))]
        for size in sizes:
            piece = small(self.dice).fitted(size, min(2.5 * size, self.h - level - 0.05))
            spot = self.stage.space(piece.radius, radius)
            if spot is not None:
                self.stage.put(piece, (x + spot[0], y + spot[1], level), self.dice.uniform(0, 360))
        self.stage.taken = keep

    def furnish(self) -> None:
        """Pieces along the walls, then free ones, a rug, pictures."""
        dice = self.dice
        for _ in range(dice.whole(4, 8)):
            thing = dice.weighted(ALONG)(dice)
            for _ in range(12):
                k = dice.whole(0, 3)
                hx, hy = _footprint(thing, k)
                across, out = (self.w, self.d) if k % 2 == 0 else (self.d, self.w)
                half, back = (hx, hy) if k % 2 == 0 else (hy, hx)
                if across - half < 0.05:
                    continue
                along, depth = dice.uniform(-(across - half - 0.02), across - half - 0.02), out - back - 0.02
                x, y = [(along, depth), (-depth, along), (along, -depth), (depth, along)][k]
                if self._fits(x, y, hx, hy):
                    self._stand(thing, x, y, k)
                    break
        for _ in range(dice.whole(2, 6)):
            thing = dice.weighted(FREE)(dice)
            if thing.name == "Pot plant":
                thing = thing.fitted(0.22, 0.6)
            for _ in range(12):
                x, y, k = dice.uniform(-self.w, self.w), dice.uniform(-self.d, self.d), dice.whole(0, 3)
                if self._fits(x, y, *_footprint(thing, k), 0.05):
                    self._stand(thing, x, y, k)
                    break
        if dice.chance(0.5):
            size = (dice.uniform(0.6, 1.1), dice.uniform(0.5, 0.9))
            rug = box((*size, 0.008), at=(0, 0, 0.0045), scale=1.0)
            self.stage.put(Thing("Rug", rug, ("cloth",), smooth=None), (0, 0, 0), 0.0)
        self.pictures()

    def pictures(self) -> None:
        """Framed pictures and mirrors on walls without holes."""
        dice = self.dice
        for k in range(4):
            if any(wall == k for wall, _ in self.holes) or dice.chance(0.5) or (k == 2 and self.open):
                continue
            out = self.d if k % 2 == 0 else self.w
            wide, tall, rim = dice.uniform(0.2, 0.5), dice.uniform(0.2, 0.4), 0.02
            frame = box((wide + 2 * rim, 0.02, tall + 2 * rim), bevel=0.004)
            sheet = box((wide, 0.004, tall), at=(0, -0.012, 0), scale=1 / wide).painted(1)
            z = self.h * 0.62
            turn = np.array([[np.cos(q := k * np.pi / 2), -np.sin(q), 0], [np.sin(q), np.cos(q), 0], [0, 0, 1]])
            shape = join([frame, sheet]).moved((dice.uniform(-0.3, 0.3), out - 0.012, z)).moved(turn=turn)
            roles = (dice.pick(["wood", "metal"]), dice.pick(["thing", "mirror", "thing"]))
            self.stage.put(Thing("Picture", shape, roles, smooth=None))

    def light(self) -> None:
        """Daylight through the openings, lamps in the room, or both."""
        dice = self.dice
        daylight = bool(self.holes or self.open) and dice.chance(0.75)
        if daylight:
            kind = dice.pick(["sun", "clouds", "sunset", "sun lamp"])
            if kind == "sun lamp":
                flat_world((0.5, 0.65, 1.0), 0.6)
                k = self.holes[0][0] if self.holes else 2
                toward = np.array([(0, -1), (1, 0), (0, 1), (-1, 0)][k], dtype=float)
                side = dice.uniform(-0.6, 0.6)
                way = (toward[0] + side * toward[1], toward[1] - side * toward[0], -dice.uniform(0.4, 1.0))
                sun_light("Sun", way, dice.log(4, 20), dice.log(0.3, 3), tint(dice, 0.3))
            else:
                image_sky(dice, kind)
        else:
            flat_world((0.1, 0.15, 0.3), dice.log(0.02, 0.3))
        if not daylight or dice.chance(0.4):
            for _ in range(dice.whole(1, 3)):
                self.lamp()

    def lamp(self) -> None:
        """A ceiling panel, a hanging lamp in its shade, a small bare bulb, or a lamp in a corner."""
        dice = self.dice
        x, y = dice.uniform(-0.6, 0.6) * self.w, dice.uniform(-0.6, 0.6) * self.d
        kind = dice.weighted({"panel": 1.0, "hanging": 1.5, "bulb": 1.0, "ball": 0.8, "spot": 0.7})
        power = dice.log(4, 16)
        if kind == "panel":
            size = dice.log(0.1, 0.6)
            area_light("Ceiling panel", (x, y, self.h - 0.01), (x, y, 0), power, (size, size), tint(dice))
        elif kind == "hanging":
            shade = lathe([(dice.uniform(0.08, 0.16), -0.05), (0.03, 0.05)], 32)
            cord = box((0.006, 0.006, 0.2), at=(0, 0, 0.13)).painted(1)
            self.stage.put(
                Thing("Hanging lamp", join([shade, cord]), (dice.pick(["shade", "metal", "plain"]), "plain")),
                (x, y, self.h - 0.235),
            )
            point_light("Hanging bulb", (x, y, self.h - 0.255), power, dice.log(0.006, 0.025), tint(dice))
        elif kind == "bulb":
            point_light("Bare bulb", (x, y, dice.uniform(0.55, 0.9) * self.h), power, dice.log(0.004, 0.03), tint(dice))
        elif kind == "ball":
            glow = Thing("Glowing ball", ball(dice.uniform(0.05, 0.12), 14, 28), ("bulb",))
            self.stage.put(glow, (x, y, self.h - 0.2))
        else:
            area_light("Wall washer", (x, y, self.h - 0.02), (2 * x, 2 * y, 0.2), power, (0.05, 0.05), tint(dice))


def build(stage: Stage) -> Draw:
    room = Room(stage)
    room.shell()
    room.furnish()
    room.light()
    low = np.array([-room.w + 0.15, -room.d + 0.15, 0.28])
    high = np.array([room.w - 0.15, room.d - 0.15, room.h * 0.78])
    return inside(low, high, room.blocked)

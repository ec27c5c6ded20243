"""The castle of `bricks`, cell by cell: which kind and colour of brick stands where. Data only, no Blender."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

Cell = tuple[int, int, int]
# Kind of brick and its colour; "slope" kinds name the side that falls off: 0 +x, 1 +y, 2 -x, 3 -y, and for
# corners the side that comes first going round.
Piece = tuple[str, str]


class Castle:
    """Cells filled so far; z counts brick layers above the baseplate."""

    def __init__(self) -> None:
        self.cells: dict[Cell, Piece] = {}
        self.random = np.random.default_rng(8)

    def put(self, x: int, y: int, z: int, colour: str, kind: str = "brick") -> None:
        self.cells[x, y, z] = (kind, colour)

    def clear(self, xs: Iterable[int], ys: Iterable[int], zs: Iterable[int]) -> None:
        for x in xs:
            for y in ys:
                for z in zs:
                    self.cells.pop((x, y, z), None)

    def stone(self, x: int, y: int, z: int, colour: str = "Light grey", odd: str = "Dark grey") -> None:
        """Wall cell; pairs of cells here and there take the odd colour."""
        chance = np.random.default_rng([1000 + x // 2, 1000 + y // 2, z]).random()
        self.put(x, y, z, odd if chance < 0.08 else colour)

    def ring(self, x0: int, y0: int, width: int, depth: int, z: int, thick: int, colour: str, odd: str) -> None:
        for x in range(x0, x0 + width):
            for y in range(y0, y0 + depth):
                if min(x - x0, y - y0, x0 + width - 1 - x, y0 + depth - 1 - y) < thick:
                    self.stone(x, y, z, colour, odd)

    def battlement(self, x0: int, y0: int, width: int, depth: int, z: int, colour: str) -> None:
        """Merlons of two cells, gaps of two, around a rectangle."""
        for x in range(x0, x0 + width):
            for y in range(y0, y0 + depth):
                edge = min(x - x0, y - y0, x0 + width - 1 - x, y0 + depth - 1 - y) == 0
                along = x - x0 if y in (y0, y0 + depth - 1) else y - y0
                length = width if y in (y0, y0 + depth - 1) else depth
                if edge and (min(along, length - 1 - along) // 2) % 2 == 0:
                    self.put(x, y, z, colour)

    def roof(self, x0: int, y0: int, width: int, depth: int, z: int, colour: str) -> int:
        """Hipped roof of slopes; returns the layer above its ridge."""
        while min(width, depth) > 1:
            for x in range(x0, x0 + width):
                for y in range(y0, y0 + depth):
                    sides = [x == x0 + width - 1, y == y0 + depth - 1, x == x0, y == y0]
                    if sum(sides) == 2:
                        first = next(i for i in range(4) if sides[i] and sides[(i + 1) % 4])
                        self.put(x, y, z, colour, f"corner{first}")
                    elif sum(sides) == 1:
                        self.put(x, y, z, colour, f"slope{sides.index(True)}")
                    elif min(x - x0, y - y0, x0 + width - 1 - x, y0 + depth - 1 - y) == 1:
                        self.put(x, y, z, colour)
            x0, y0, width, depth, z = x0 + 1, y0 + 1, width - 2, depth - 2, z + 1
        for x in range(x0, x0 + width):
            for y in range(y0, y0 + depth):
                self.put(x, y, z, colour)
        return z + 1

    def tower(self, x0: int, y0: int, size: int, layers: int, colour: str, odd: str, roof: str) -> int:
        """Square tower with arrow slits, a wider battlemented head and a pointed roof; returns its top layer."""
        for z in range(layers):
            self.ring(x0, y0, size, size, z, 2, colour, odd)
        middle = size // 2
        for z in range(3, layers - 2, 5):
            for w in (z, z + 1):
                for x, y in (
                    (x0 + middle, y0),
                    (x0 + middle, y0 + size - 1),
                    (x0, y0 + middle),
                    (x0 + size - 1, y0 + middle),
                ):
                    self.put(x, y, w, "Black")
        for x in range(x0 - 1, x0 + size + 1):
            for y in range(y0 - 1, y0 + size + 1):
                self.put(x, y, layers, "Dark grey")
        self.ring(x0 - 1, y0 - 1, size + 2, size + 2, layers + 1, 1, colour, colour)
        self.battlement(x0 - 1, y0 - 1, size + 2, size + 2, layers + 2, colour)
        for z in (layers + 1, layers + 2):
            self.ring(x0 + 1, y0 + 1, size - 2, size - 2, z, 1, "White", "White")
        return self.roof(x0, y0, size, size, layers + 3, roof)


def build_castle() -> tuple[Castle, list[tuple[float, float, float, int]]]:
    """The cells, and flag poles as (x, y, layer, design)."""
    castle = Castle()
    flags: list[tuple[float, float, float, int]] = []
    low, high = -15, 15  # the curtain wall's outer cells, high exclusive
    for z in range(7):
        castle.ring(low, low, high - low, high - low, z, 2, "Light grey", "Dark grey")
    for x in range(low, high):  # walkway
        for y in range(low, high):
            if min(x - low, y - low, high - 1 - x, high - 1 - y) < 3:
                castle.put(x, y, 7, "Dark grey")
    castle.battlement(low, low, high - low, high - low, 8, "Light grey")

    # Corner towers of different heights.
    for i, (x, y) in enumerate(((low - 3, low - 3), (high - 5, low - 3), (high - 5, high - 5), (low - 3, high - 5))):
        castle.clear(range(x - 1, x + 9), range(y - 1, y + 9), range(40))
        top = castle.tower(x, y, 8, (11, 13, 11, 15)[i], "Light grey", "Dark grey", ("Red", "Blue", "Red", "Blue")[i])
        flags.append((x + 4, y + 4, top, i % 2))

    # Gatehouse with an arched door in the front wall.
    castle.clear(range(-6, 6), range(low - 1, low + 5), range(40))
    for z in range(10):
        for x in range(-6, 6):
            for y in range(low - 2, low + 4):
                inside = min(x + 6, 5 - x, y - low + 2, low + 3 - y) >= 2
                opening = z < 6 and -3 <= x < 3 and not (z == 5 and x in (-3, 2))
                if not inside and not opening:
                    castle.stone(x, y, z, "Tan", "Brown")
    for z in range(6):  # portcullis
        for x in range(-3, 3):
            if (x + z) % 2 == 0 or z in (0, 3):
                castle.put(x, low + 1, z, "Dark grey")
    for x in range(-7, 7):
        for y in range(low - 3, low + 5):
            castle.put(x, y, 10, "Dark grey")
    castle.battlement(-7, low - 3, 14, 8, 11, "Tan")

    # The keep.
    for z in range(15):
        castle.ring(-5, -3, 11, 12, z, 2, "Tan", "Brown")
    for z in (4, 5, 10, 11):
        for a in (-3, 0, 3):
            castle.put(a, -3, z, "Black")
            castle.put(a, 8, z, "Black")
            castle.put(-5, a + 2, z, "Black")
            castle.put(5, a + 2, z, "Black")
    for z in range(4):
        for x in (-1, 0, 1):
            castle.put(x, -3, z, "Brown")
    for x in range(-6, 7):
        for y in range(-4, 10):
            castle.put(x, y, 15, "White")
    top = castle.roof(-6, -4, 13, 14, 16, "Red")
    flags.append((0.5, 2.5, top, 0))

    # Trees outside and in the courtyard.
    for x, y, size in (
        (-21, 4, 3),
        (20, -3, 4),
        (-20, -8, 4),
        (3, 21, 3),
        (-7, 20, 4),
        (20, 8, 3),
        (9, -8, 3),
        (-10, 9, 3),
    ):
        for z in range(2):
            castle.put(x, y, z, "Brown")
        for z in range(2, 2 + size + 2):
            reach = [1.5, 2.3, 2.1, 1.6, 1.1, 0.5][z - 2 if size > 3 else z - 1]
            for dx in range(-3, 4):
                for dy in range(-3, 4):
                    if np.hypot(dx, dy) <= reach:
                        castle.put(x + dx, y + dy, z, "Lime" if (dx * 3 + dy * 5 + z * 7) % 4 == 0 else "Green")

    # Bridge over the moat and a path.
    for y in range(-24, low - 3):
        for x in range(-3, 3):
            castle.put(x, y, 0, "Brown")
    return castle, flags

"""Where a scene is put together: its dice, its materials, and things set down without touching each other."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from solids import mesh_of, place

from factory.dice import Dice
from factory.finishes import Finishes
from factory.thing import Thing
from factory.things import small

Point = tuple[float, float, float]


class Stage:
    """One scene in the making."""

    def __init__(self, dice: Dice) -> None:
        self.dice = dice
        self.finish = Finishes(dice)
        self.taken: list[tuple[float, float, float]] = []
        self.count = 0

    def mesh(self, thing: Thing, again: float = 0.25) -> bpy.types.Mesh:
        """The thing's mesh, painted."""
        mesh = mesh_of(thing.name, thing.shape, smooth=thing.smooth)
        for role in thing.roles:
            mesh.materials.append(self.finish.draw(role, again))
        return mesh

    def put(self, thing: Thing, at: Point = (0, 0, 0), turn: float = 0.0) -> bpy.types.Object:
        """Paint the thing and set it down at ``at``, turned by degrees about Z."""
        self.count += 1
        body = place(f"{thing.name} {self.count}", self.mesh(thing), at=at, turn=(0, 0, turn))
        modifier: Any
        if thing.modifier == "bevel":
            modifier = body.modifiers.new("Bevel", "BEVEL")
            modifier.width, modifier.segments, modifier.harden_normals = 0.03 * float(thing.size.min()), 3, True
        elif thing.modifier == "subdivide":
            modifier = body.modifiers.new("Subdivision", "SUBSURF")
            modifier.levels = modifier.render_levels = 2
        return body

    def space(self, radius: float, reach: float, side: float | None = None) -> tuple[float, float] | None:
        """Centre of a free circle of ``radius`` in the disc of radius ``reach``, or in the rectangle of half width
        ``reach`` and half depth ``side``; taken from then on. None where forty throws found none."""
        for _ in range(40):
            if side is None:
                turn, far = self.dice.uniform(0, 2 * np.pi), max(reach - radius, 0) * np.sqrt(self.dice.uniform(0, 1))
                x, y = float(far * np.cos(turn)), float(far * np.sin(turn))
            else:
                wide, deep = max(reach - radius, 0), max(side - radius, 0)
                x, y = self.dice.uniform(-wide, wide), self.dice.uniform(-deep, deep)
            if all(np.hypot(x - a, y - b) > radius + r for a, b, r in self.taken):
                self.taken.append((x, y, radius))
                return x, y
        return None

    def scatter(
        self, things: list[Thing], sizes: list[float], level: float, reach: float, side: float | None = None
    ) -> float:
        """Set things of given radii on z = ``level``, the largest first; returns the height that they reach."""
        highest = level
        for thing, size in sorted(zip(things, sizes, strict=True), key=lambda pair: -pair[1]):
            fitted = thing.fitted(size, 2.6 * size)
            spot = self.space(fitted.radius * 1.03, reach, side)
            if spot is None:
                continue
            turn = self.dice.uniform(0, 360)
            self.put(fitted, (*spot, level), turn)
            highest = max(highest, level + float(fitted.size[2]))
            if fitted.top is not None and self.dice.chance(0.4):
                x, y, z, radius = fitted.top
                if radius < 0.025:
                    continue
                upper = small(self.dice).fitted(radius, 2 * radius)
                c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
                self.put(
                    upper, (spot[0] + c * x - s * y, spot[1] + s * x + c * y, level + z), self.dice.uniform(0, 360)
                )
                highest = max(highest, level + z + float(upper.size[2]))
        return highest

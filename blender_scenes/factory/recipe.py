"""From a seed to a scene: family, contents, camera, level of light."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import bpy
import numpy as np
from building import new_scene

from factory import meter
from factory.dice import Dice
from factory.families import many, outdoor, product, remix, room, shelf, table
from factory.stage import Stage
from factory.views import Draw, shoot

FAMILIES: dict[str, Any] = {
    "table": table,
    "room": room,
    "shelf": shelf,
    "outdoor": outdoor,
    "product": product,
    "many": many,
    "remix": remix,
}
WEIGHTS: dict[str, float] = {
    "table": 5.0,
    "room": 5.0,
    "shelf": 2.5,
    "outdoor": 3.0,
    "product": 3.0,
    "many": 2.5,
    "remix": 3.0,
}
ATTEMPTS = 6


def family_of(seed: int, without: Collection[str] = ()) -> str:
    """The family that a seed draws of those that are not ``without``."""
    return Dice(seed, 1).weighted({name: weight for name, weight in WEIGHTS.items() if name not in without})


def make(seed: int, family: str | None = None) -> str:
    """Replace the open file by the scene of ``seed``; returns its family.

    A seed whose scene shows nothing or has no light is drawn again, by its own dice.
    """
    family = family or family_of(seed)
    for attempt in range(ATTEMPTS):
        if _make(Dice(seed, 2, attempt), family):
            break
    else:
        raise RuntimeError(f"seed {seed} made no {family} that can be seen in {ATTEMPTS} attempts")
    scene = bpy.context.scene
    scene["factory_seed"], scene["factory_family"] = seed, family
    scene["factory_base"] = scene.get("factory_base", "")
    return family


def _make(dice: Dice, family: str) -> bool:
    """One attempt; whether its picture shows something."""
    new_scene()
    stage = Stage(dice)
    draw: Draw = FAMILIES[family].build(stage)
    scene = bpy.context.scene
    scene.render.film_transparent = dice.chance(0.25)
    bpy.context.view_layer.update()
    clear = shoot(dice, draw, 0.12 if family in ("room", "remix") else 0.2)
    view: Any = scene.view_settings
    view.view_transform = dice.weighted({"Standard": 4.0, "AgX": 2.0, "Filmic": 1.0})
    colours = meter.surfaces()
    wanted = 0.12 + 0.56 * float(dice.rng.beta(2.0, 2.4))
    if len(colours) < 0.1 * (meter.SIZE / meter.BLOCK) ** 2 or np.quantile(colours, 0.6) <= 1e-7 or clear < 0.2:
        return False
    meter.scale_light(meter.factor_for(colours, wanted))
    return True

"""A committed scene in another light, with other colours and from another side.

The base scene's name goes into the property ``factory_base``, so that an experiment that holds it out can leave
its remixes out too.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from building import FOLDER, node, wire
from mathutils import Vector

from factory.dice import Dice
from factory.lighting import RIGS, rig
from factory.stage import Stage
from factory.views import Draw, around, inside

BASES: dict[str, float] = {
    "demo": 0.7,
    "furniture": 1.0,
    "drums": 1.0,
    "foliage": 1.0,
    "food": 1.0,
    "bricks": 0.5,
    "materials": 1.0,
    "microphone": 1.0,
    "ship": 1.0,
    "interior": 1.0,
    "jewels": 1.0,
}


def open_base(name: str) -> None:
    """The committed scene without its cameras."""
    bpy.ops.wm.open_mainfile(filepath=str(FOLDER / f"{name}.blend"), load_ui=False, use_scripts=False)
    for body in [o for o in bpy.data.objects if o.type in ("CAMERA", "EMPTY") and not o.children]:
        bpy.data.objects.remove(body)


def _recolour(dice: Dice, made: Any) -> None:
    """Another hue, value or roughness for a Principled material; a Hue/Saturation node where a link feeds it."""
    shaders = [n for n in made.node_tree.nodes if n.type == "BSDF_PRINCIPLED"]
    for shader in shaders:
        if shader.inputs["Transmission Weight"].default_value > 0.5 and dice.chance(0.7):
            continue
        colour, roughness = shader.inputs["Base Color"], shader.inputs["Roughness"]
        if colour.is_linked:
            source = colour.links[0].from_socket
            shift = node(
                made,
                "HueSaturation",
                inputs={
                    "Hue": dice.uniform(0.0, 1.0) if dice.chance(0.5) else dice.uniform(0.4, 0.6),
                    "Saturation": dice.uniform(0.4, 1.3),
                    "Value": dice.uniform(0.6, 1.2),
                },
            )
            wire(made, source, shift.inputs["Color"])
            wire(made, shift.outputs["Color"], colour)
        elif dice.chance(0.7):
            colour.default_value = (*dice.colour(), 1.0)
        if not roughness.is_linked:
            roughness.default_value = min(max(roughness.default_value * dice.log(0.4, 2.0), 0.0), 1.0)
        if dice.chance(0.08) and not shader.inputs["Metallic"].is_linked:
            shader.inputs["Metallic"].default_value = 1.0


def _relight(dice: Dice, reach: float, target: tuple[float, float, float]) -> None:
    """A new rig, or the old lamps with other colours, powers and places."""
    if dice.chance(0.6):
        for body in [o for o in bpy.data.objects if o.type == "LIGHT"]:
            bpy.data.objects.remove(body)
        bpy.data.batch_remove([*bpy.data.worlds])
        rig(dice, reach, target, RIGS)
        return
    for lamp in bpy.data.lights:
        data: Any = lamp
        data.energy *= dice.log(0.3, 3.0)
        data.color = tuple(np.clip(np.array(data.color) * dice.rng.uniform(0.6, 1.0, 3), 0, 1))
    world = bpy.context.scene.world
    if world is not None and world.node_tree is not None:
        for background in [n for n in world.node_tree.nodes if n.type == "BACKGROUND"]:
            background.inputs["Strength"].default_value *= dice.log(0.3, 2.5)


def _bounds() -> tuple[np.ndarray, np.ndarray]:
    corners = [o.matrix_world @ Vector(c) for o in bpy.data.objects if o.type in ("MESH", "CURVE") for c in o.bound_box]
    points = np.array(corners)
    return points.min(0), points.max(0)


def build(stage: Stage) -> Draw:
    dice = stage.dice
    name = dice.weighted(BASES)
    open_base(name)
    bpy.context.scene["factory_base"] = name
    view: Any = bpy.context.scene.view_settings
    view.exposure = 0.0
    for made in bpy.data.materials:
        if made.node_tree is not None and dice.chance(0.6):
            _recolour(dice, made)
    low, high = _bounds()
    middle, reach = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    target = (float(middle[0]), float(middle[1]), float(low[2] + 0.4 * (high[2] - low[2])))
    _relight(dice, reach, target)
    bpy.data.orphans_purge(do_recursive=True)
    if name == "interior":
        return inside(np.array([-0.9, -1.5, 0.4]), np.array([0.8, 0.2, 0.85]), [(-1.1, -0.9, -0.55, 0.55, 0.7)])
    return around(target, reach * dice.uniform(0.4, 0.8), elevation=(10.0, 50.0))

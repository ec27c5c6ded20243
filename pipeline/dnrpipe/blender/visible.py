"""Freeze a scene at a frame where something can be seen."""

from __future__ import annotations

from collections import Counter

import bpy
import numpy as np

from dnrpipe.core.errors import NothingVisible, UserError

from .geometry.freeze import Frozen, freeze_scene

TRIES = 12  # later frames looked at when the current one is empty
FAR = 1e4  # beyond so many scene sizes float32 leaves steps of a thousandth of the scene: shadows and edges suffer
HUGE = 1e7


def freeze_visible(scene: bpy.types.Scene) -> Frozen:
    """`freeze_scene`; when nothing is visible, the first later frame of the range that shows something.

    The scene stays at the frame that was frozen; a warning names it. Raises NothingVisible when all frames are empty.
    """
    try:
        frozen = freeze_scene(scene)
    except UserError as nothing:
        frozen = _later(scene)
        if frozen is None:
            raise NothingVisible(f"{nothing} (it holds {_contents(scene)}){_remoteness(scene)}") from None
    frozen.warnings += _repair_warnings(frozen)
    return frozen


def _later(scene: bpy.types.Scene) -> Frozen | None:
    """Try up to TRIES frames spread over the range. None when all are empty or nothing is animated."""
    if not any(obj.animation_data for obj in scene.objects) and not bpy.data.actions:
        return None
    before = scene.frame_current
    frames = np.unique(np.linspace(scene.frame_start, scene.frame_end, TRIES).round().astype(int))
    for frame in frames[frames != before]:
        scene.frame_set(int(frame))
        try:
            frozen = freeze_scene(scene)
        except UserError:
            continue
        frozen.warnings.append(f"nothing is visible at frame {before}: frame {frame} is converted")
        return frozen
    scene.frame_set(before)
    return None


def _repair_warnings(frozen: Frozen) -> list[str]:
    """What was wrong with the geometry itself, one line each."""
    lines = []
    broken = frozen.repairs["non_finite_triangles"]
    if broken:
        lines.append(f"{broken} triangle(s) with corners that are not finite (NaN, infinite) are left out")
    points = np.array([[mesh.positions.min(0), mesh.positions.max(0)] for mesh in frozen.meshes], np.float64)
    size = np.linalg.norm(points[:, 1].max(0) - points[:, 0].min(0))
    distance = float(np.abs(points).max())
    if distance > HUGE or distance > FAR * max(float(size), 1e-30):
        lines.append(
            f"coordinates reach {distance:.3g} units, the scene is {size:.3g} wide: float32 leaves steps of"
            f" {distance * 2**-23:.2g}; move it to the origin"
        )
    return lines


def _remoteness(scene: bpy.types.Scene) -> str:
    """Why surfaces far from the origin vanish, or nothing."""
    places = np.abs([list(obj.matrix_world.translation) for obj in scene.objects] or [[0.0]])
    distance = float(places[np.isfinite(places)].max(initial=0))
    if distance <= HUGE:
        return ""
    return f"; objects lie {distance:.3g} units from the origin, where float32 cannot resolve them: move them there"


def _contents(scene: bpy.types.Scene) -> str:
    """What a scene without surfaces holds, in words."""
    faceless = {obj for obj in scene.objects if obj.type == "MESH" and not obj.data.polygons}
    kinds = Counter("mesh without faces" if obj in faceless else obj.type.lower() for obj in scene.objects)
    return ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())) or "no objects at all"

"""Open a scene file and freeze what renders show: the common beginning of `prepare` and `inspect`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from dnrpipe.core.errors import UserError
from dnrpipe.core.scene_records import Bounds

from ..findings import Findings
from ..geometry.freeze import Frozen
from ..geometry.frozen import FrozenMesh
from ..geometry.render_graph import render_layer
from ..visible import freeze_visible
from .framing import ensure_camera
from .light import ensure_light, has_light
from .missing import external_files, missing_files, note_missing
from .opening import open_scene
from .scripts import note_drivers


@dataclass
class Loaded:
    """An open scene with camera and light, and its frozen geometry.

    warnings: lines for the user. findings: what is missing or never executed. external: the outside files it was read
    from. missing: those that were not there. has_light: whether the file brought light of its own.
    """

    scene: bpy.types.Scene
    frozen: Frozen
    bounds: Bounds
    warnings: list[str]
    findings: Findings
    external: list[Path]
    missing: list[Path]
    has_light: bool


def load_scene(source: Path, *, strict: bool = False) -> Loaded:
    """Open ``source`` (see `open_scene`) and freeze it; a missing camera or light is added to the open file.

    Raises UserError for unusable input, and with ``strict`` for a scene with missing files; NothingVisible for a file
    without a surface, which stays open.
    """
    warnings = open_scene(source, strict=strict)
    external = external_files(source)
    missing = [reference.path for reference in missing_files()]
    scene: Any = bpy.context.scene
    try:
        frozen = freeze_visible(scene)
    except UserError as error:
        raise type(error)(f"{source}: {error}") from None
    bounds = scene_bounds(frozen.meshes)
    warnings += frozen.warnings
    world = render_layer(scene).world_override
    if world is not None:
        scene.world = world
        warnings.append(f"world '{world.name}' stands for the scene's own, as the view layer says")
    warnings += ensure_camera(scene, np.array(bounds.center), (mesh.extent() for mesh in frozen.meshes))
    lit = has_light(scene, frozen.meshes)
    warnings += ensure_light(scene, frozen.meshes)
    findings = frozen.findings
    note_missing(findings)
    note_drivers(findings)
    return Loaded(scene, frozen, bounds, warnings, findings, external, missing, lit)


def scene_bounds(meshes: list[FrozenMesh]) -> Bounds:
    """The box and the sphere that hold the meshes; of copies, their boxes."""
    extents = [mesh.extent() for mesh in meshes]
    low = np.min([points.min(0) for points in extents], axis=0)
    high = np.max([points.max(0) for points in extents], axis=0)
    center = (low + high) / 2
    radius = max(float(np.linalg.norm(points - center, axis=1).max()) for points in extents)
    return Bounds(min=low.tolist(), max=high.tolist(), center=center.tolist(), radius=radius)

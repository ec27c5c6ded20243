"""Evaluated scene -> world-space triangles, as a final render would see them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import bpy
import numpy as np

from dnrpipe.core.errors import UserError

from ..findings import Findings
from .frozen import FrozenMesh
from .instances import Placed, Shared, copy_matrices, share_instances
from .local_mesh import LocalMesh, read_local, slot_names
from .render_graph import render_layer, with_render_graph
from .simplify import fit_instances
from .strands import hair_systems, read_curves, read_points
from .world import REPAIRS, to_world

COARSE = math.radians(15)
"""Mean angle between shading normals and triangles, from which on what Cycles does at terminators shows."""
SURFACELESS = {"VOLUME", "GREASEPENCIL"}

LONGEST_STEM = 80  # characters of a name in file names: systems allow 255 bytes, and several names may be joined
MOST_IDS = 32_767  # Object.pass_index, which carries ids through Cycles, is a 16-bit number


@dataclass
class Frozen:
    """What `freeze` found. ``repairs`` counts dropped triangles and replaced normals, UVs and colours."""

    meshes: list[FrozenMesh]
    repairs: dict[str, int]
    warnings: list[str]
    findings: Findings = field(default_factory=Findings)
    lit_by: set[str] = field(default_factory=set)
    """Full names of lamps that renders see, and of the objects that instance lamps."""


def freeze_scene(scene: bpy.types.Scene) -> Frozen:
    """`freeze` the scene at its current frame with render visibility; the scene stays as it was.

    Raises:
        UserError: nothing in the scene is visible in renders.
    """
    layer = render_layer(scene)
    outcome = with_render_graph(scene, lambda engine, depsgraph: freeze(depsgraph))
    if not outcome.meshes:
        raise UserError(
            f"scene '{scene.name}', view layer '{layer.name}': no surface is visible in renders; "
            "unhide an object or enable its collection"
        )
    _show_lamps(scene, layer, outcome.lit_by)
    _override_materials(outcome, layer)
    fit_instances(outcome.meshes, outcome.repairs, outcome.findings)
    return outcome


def freeze(depsgraph: bpy.types.Depsgraph) -> Frozen:
    """Collect every visible surface of an evaluated depsgraph, instances included, in world space.

    Normals go through the inverse transpose; mirrored transforms keep counter-clockwise winding.
    Drops and counts triangles without area or with non-finite corners. Reads every evaluated mesh once; beyond a
    budget instances share it (see `instances`).
    """
    cache: dict[tuple[object, ...], tuple[LocalMesh, bytes] | None] = {}
    unique: dict[bytes, LocalMesh] = {}  # one mesh for all that evaluate to the same content
    placed: list[Placed] = []
    findings = Findings()
    coarse: list[str] = []
    lit_by: set[str] = set()
    for instance in depsgraph.object_instances:
        obj = instance.object
        if obj.type == "LIGHT":
            lit_by.add(obj.name_full if instance.parent is None else instance.parent.name_full)
            continue
        if not (instance.show_self or instance.show_particles):
            continue
        matrix = np.array(instance.matrix_world, np.float64)
        holder = obj if instance.parent is None else instance.parent
        seen = _seen_by_camera(obj, holder, depsgraph.view_layer, findings)
        persistent = tuple(instance.persistent_id) if instance.is_instance else ()
        for key, read in surfaces(obj, instance.show_self, instance.show_particles, findings):
            if key not in cache:
                local = read()
                cache[key] = None
                if local is not None and len(local.material_index):
                    offset = getattr(obj, "shadow_terminator_geometry_offset", 0) > 0
                    if offset and not local.strands and local.tilt() > COARSE:
                        coarse.append(obj.name_full)
                    digest = local.digest()
                    cache[key] = unique.setdefault(digest, local), digest
            if (found := cache[key]) is not None:
                placed.append(Placed(obj.name_full, persistent, matrix, *found, seen))
    _note_terminator(coarse, findings)
    repairs: dict[str, int] = dict.fromkeys(REPAIRS, 0)
    ids: dict[str, int] = {}
    taken: set[str] = set()
    meshes = []
    for shared in share_instances(placed):
        lead = shared.lead
        mesh = to_world(lead.name, lead.matrix, lead.mesh, repairs)
        if not mesh.triangles:
            continue
        mesh.object_id = ids.setdefault(lead.name, min(len(ids) + 1, MOST_IDS))
        mesh.name = _unique(lead.name, taken)
        mesh.camera_visible = lead.camera_visible
        mesh.copies = copy_matrices(shared)
        if shared.others:
            _note_sharing(shared, findings)
        meshes.append(mesh)
    if len(ids) > MOST_IDS:
        note = f"{len(ids):,} objects; from number {MOST_IDS:,} on they share one id"
        findings.add("approximated", "object ids", note)
    return Frozen(meshes, repairs, [], findings, lit_by)


def _seen_by_camera(
    obj: bpy.types.Object, holder: bpy.types.Object, layer: bpy.types.ViewLayer, findings: Findings
) -> bool:
    """Whether camera rays see an object, ``holder`` being what instances it (or itself), as Cycles decides.

    Holdouts, by themselves or by their collection, are a finding and stay surfaces.
    """
    own = holder.original
    if own.is_holdout or own.holdout_get(view_layer=layer):
        findings.add("ignored", "holdout object", "an ordinary surface", object=obj.name_full)
        return True
    return obj.visible_camera and holder.visible_camera and not own.indirect_only_get(view_layer=layer)


def _show_lamps(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, names: set[str]) -> None:
    """Show in the viewport the lamps that renders see: for scripts, Blender evaluates nothing else.

    Whole collections stay hidden: what else they hold may be heavy.
    """
    hidden = [obj for obj in layer.objects if obj.name_full in names and not obj.visible_get(view_layer=layer)]
    for obj in hidden:
        try:
            obj.hide_viewport = False
            obj.hide_set(False, view_layer=layer)
        except (AttributeError, RuntimeError):  # linked data keep their library's settings
            continue
        if not obj.visible_get(view_layer=layer) and obj.name not in scene.collection.objects:
            scene.collection.objects.link(obj)
            layer.update()
            obj.hide_set(False, view_layer=layer)
    if hidden:
        scene.frame_set(scene.frame_current, subframe=scene.frame_subframe)  # drivers of what was hidden


def _override_materials(frozen: Frozen, layer: bpy.types.ViewLayer) -> None:
    """The view layer's own material, where it has one, instead of all others."""
    if layer.material_override is None:
        return
    name = layer.material_override.name_full
    for mesh in frozen.meshes:
        mesh.materials = [name] * len(mesh.materials)
    frozen.findings.add("exact", "material override", f"'{name}' stands for every material, as the view layer says")


def surfaces(
    obj: bpy.types.Object, show_self: bool, show_particles: bool, findings: Findings
) -> Iterator[tuple[tuple[object, ...], Callable[[], LocalMesh | None]]]:
    """(cache key, reader) of each surface that an instance shows."""
    data = obj.data
    # Curves, text, surfaces and metaballs come a second time, as the mesh they evaluate to.
    if show_self and isinstance(data, bpy.types.Mesh):
        # Objects that share a mesh share the evaluated one too, where no modifier makes it their own.
        owner = obj.original.data.name_full if isinstance(obj.original.data, bpy.types.Mesh) else obj.name_full
        yield (owner, data.as_pointer(), *slot_names(obj)), lambda: read_local(obj)
    elif show_self and obj.type == "CURVES":
        yield (obj.name, data.as_pointer(), "curves"), lambda: read_curves(obj, findings)
    elif show_self and obj.type == "POINTCLOUD":
        yield (obj.name, data.as_pointer(), "points"), lambda: read_points(obj, findings)
    elif show_self and obj.type in SURFACELESS:
        findings.add("ignored", f"{obj.type.lower()} object", "has no surface: left out", object=obj.name)
    if show_particles and isinstance(data, bpy.types.Mesh):
        for name, read in hair_systems(obj, findings):
            yield (obj.name, data.as_pointer(), "hair", name), read


def _note_terminator(coarse: Sequence[str], findings: Findings) -> None:
    """Cycles starts shadow rays of smooth triangles a little off the surface (Shadow Terminator: Geometry Offset)."""
    if coarse:
        names = f"'{coarse[0]}'" if len(coarse) == 1 else f"{len(coarse)} objects, such as '{coarse[0]}'"
        note = f"{names}: shadows keep the edges of coarse smooth meshes, which Cycles' Geometry Offset softens"
        findings.add("approximated", "shadow terminator", note)


def _note_sharing(shared: Shared, findings: Findings) -> None:
    names = sorted({item.name for item in (shared.lead, *shared.others)} - {shared.lead.name})
    also = f"; they carry its object id, {len(names)} other object(s) too: {', '.join(names[:3])}" if names else ""
    findings.add(
        "approximated",
        "instances beyond the budget",
        f"{len(shared.others) + 1:,} instances share one place in the scene's atlas{also}",
        object=shared.lead.name,
    )


def _unique(name: str, taken: set[str]) -> str:
    """A file-safe name not yet in ``taken`` (compared without case: some file systems ignore it)."""
    stem = re.sub(r"[^A-Za-z0-9_.-]", "_", name).lstrip(".")[:LONGEST_STEM] or "object"
    candidate, number = stem, 1
    while candidate.lower() in taken:
        candidate = f"{stem}_{number:04d}"
        number += 1
    taken.add(candidate.lower())
    return candidate

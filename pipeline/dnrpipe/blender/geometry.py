"""Evaluated scene -> world-space triangles, as a final render would see them."""

from __future__ import annotations

import re
from dataclasses import dataclass

import bpy
import numpy as np

from dnrpipe.errors import UserError

from .frozen import FrozenMesh

# A triangle whose doubled area is below this fraction of its longest edge squared has no usable normal.
DEGENERATE = 1e-12
SURFACELESS = {"CURVES", "POINTCLOUD", "VOLUME", "GREASEPENCIL"}

UV_STEPS = 2**20  # artist's UVs are rounded to multiples of 1 / UV_STEPS


@dataclass
class Frozen:
    """What :func:`freeze` found. ``repairs`` counts dropped triangles and replaced normals."""

    meshes: list[FrozenMesh]
    repairs: dict[str, int]
    warnings: list[str]


@dataclass
class _Local:
    """One evaluated mesh in object space, as unindexed triangles."""

    positions: np.ndarray
    normals: np.ndarray
    material_index: np.ndarray
    materials: list[str | None]
    uv_layers: dict[str, np.ndarray]
    active_uv: str | None


class _FreezeEngine(bpy.types.RenderEngine):
    """A render engine that draws nothing.

    Blender hands a depsgraph in RENDER mode (hide_render, render levels of modifiers) to render engines
    only; the one that scripts get from ``evaluated_depsgraph_get`` has viewport visibility.
    """

    bl_idname = "DNRPIPE_FREEZE"
    bl_label = "dnrpipe freeze"
    outcome: Frozen | Exception | None = None

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        try:
            type(self).outcome = freeze(depsgraph)
        except Exception as error:  # Blender would print and swallow it; freeze_scene raises it again
            type(self).outcome = error


def render_layer(scene: bpy.types.Scene) -> bpy.types.ViewLayer:
    """The view layer that pictures are made of: the first one that is used for rendering."""
    return next((layer for layer in scene.view_layers if layer.use), scene.view_layers[0])


def freeze_scene(scene: bpy.types.Scene) -> Frozen:
    """:func:`freeze` the scene at its current frame with render visibility; the scene stays as it was.

    Raises:
        UserError: nothing in the scene is visible in renders.
    """
    render = scene.render
    kept = {
        name: getattr(render, name)
        for name in ("engine", "resolution_x", "resolution_y", "use_compositing", "use_sequencer", "use_simplify")
    }
    layer = render_layer(scene)
    used = layer.use
    camera = None
    if scene.camera is None:  # the render operator insists on one
        camera = bpy.data.cameras.new("dnrpipe.freeze")
        scene.camera = bpy.data.objects.new("dnrpipe.freeze", camera)
    bpy.utils.register_class(_FreezeEngine)
    _FreezeEngine.outcome = None
    try:
        layer.use = True
        render.engine = _FreezeEngine.bl_idname
        render.resolution_x = render.resolution_y = 8
        render.use_compositing = render.use_sequencer = render.use_simplify = False
        bpy.ops.render.render(scene=scene.name, layer=layer.name)
        outcome = _FreezeEngine.outcome
    finally:
        for name, value in kept.items():
            setattr(render, name, value)
        layer.use = used
        if camera is not None:
            scene.camera = None
            bpy.data.cameras.remove(camera)  # takes its object along
        bpy.utils.unregister_class(_FreezeEngine)
    if isinstance(outcome, Exception):
        raise outcome
    if outcome is None:
        raise RuntimeError(f"Blender did not evaluate scene '{scene.name}' for rendering")
    if not outcome.meshes:
        raise UserError(
            f"scene '{scene.name}', view layer '{layer.name}': no surface is visible in renders; "
            "unhide an object or enable its collection"
        )
    return outcome


def freeze(depsgraph: bpy.types.Depsgraph) -> Frozen:
    """Collect every visible surface of an evaluated depsgraph, instances included, in world space.

    Normals go through the inverse transpose; mirrored transforms keep counter-clockwise winding.
    Triangles without area or with non-finite corners are dropped and counted.
    """
    cache: dict[tuple[str, int], _Local | None] = {}
    found: list[tuple[str, tuple[int, ...], np.ndarray, _Local]] = []
    skipped: dict[str, set[str]] = {}
    unseen: set[str] = set()
    for instance in depsgraph.object_instances:
        obj = instance.object
        if not instance.show_self:
            continue
        # Curves, text, surfaces and metaballs come a second time, as the mesh they evaluate to.
        if not isinstance(obj.data, bpy.types.Mesh):
            if obj.type in SURFACELESS:
                skipped.setdefault(obj.type, set()).add(obj.name)
            continue
        key = (obj.name, obj.data.as_pointer() if obj.data else 0)
        if key not in cache:
            cache[key] = _read_local(obj)
        if not obj.visible_camera:
            unseen.add(obj.name)
        persistent = tuple(instance.persistent_id) if instance.is_instance else ()
        if (local := cache[key]) is not None:
            found.append((obj.name, persistent, np.array(instance.matrix_world, np.float64), local))
    warnings = [
        f"{len(names)} object(s) of type {kind} have no surface and are left out: {', '.join(sorted(names)[:5])}"
        for kind, names in sorted(skipped.items())
    ]
    if unseen:
        warnings.append(f"hidden from the camera in Cycles but treated as visible: {', '.join(sorted(unseen)[:5])}")
    # The depsgraph's order is not promised; names and persistent ids are.
    found.sort(key=lambda item: (item[0], item[1]))
    repairs = {"degenerate_triangles": 0, "non_finite_triangles": 0, "normals_replaced": 0, "uv_replaced": 0}
    ids: dict[str, int] = {}
    taken: set[str] = set()
    meshes = []
    for name, _, matrix, local in found:
        mesh = _to_world(name, matrix, local, repairs)
        if mesh.triangles:
            mesh.object_id = ids.setdefault(name, len(ids) + 1)
            mesh.name = _unique(name, taken)
            meshes.append(mesh)
    return Frozen(meshes, repairs, warnings)


def _read_local(obj: bpy.types.Object) -> _Local | None:
    mesh = obj.to_mesh()
    if mesh is None:  # a metaball that is drawn with another one of its family
        return None
    try:
        mesh.calc_loop_triangles()
        count = len(mesh.loop_triangles)
        loops = np.empty(3 * count, np.int32)
        polygons = np.empty(count, np.int32)
        mesh.loop_triangles.foreach_get("loops", loops)
        mesh.loop_triangles.foreach_get("polygon_index", polygons)
        corner_vertex = np.empty(len(mesh.loops), np.int32)
        mesh.loops.foreach_get("vertex_index", corner_vertex)
        vertices = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.vertices.foreach_get("co", vertices.ravel())
        normals = np.empty((len(mesh.loops), 3), np.float32)
        mesh.corner_normals.foreach_get("vector", normals.ravel())
        slot = np.empty(len(mesh.polygons), np.int32)
        mesh.polygons.foreach_get("material_index", slot)
        uv_layers = {}
        active = None
        for layer in mesh.uv_layers:
            uv = np.empty((len(mesh.loops), 2), np.float32)
            layer.uv.foreach_get("vector", uv.ravel())
            uv_layers[layer.name] = uv[loops]
            if layer.active_render:
                active = layer.name
        materials = [s.material.name if s.material else None for s in obj.material_slots] or [None]
        return _Local(
            positions=vertices[corner_vertex[loops]],
            normals=normals[loops],
            # Renderers use the last slot for indices beyond it.
            material_index=np.clip(slot[polygons], 0, len(materials) - 1),
            materials=materials,
            # Modifiers give the last bits of interpolated UVs either way from run to run: a texel's 1/256 at 4096².
            uv_layers={layer: np.round(uv * UV_STEPS) / np.float32(UV_STEPS) for layer, uv in uv_layers.items()},
            active_uv=active,
        )
    finally:
        obj.to_mesh_clear()


def _to_world(name: str, matrix: np.ndarray, local: _Local, repairs: dict[str, int]) -> FrozenMesh:
    linear = matrix[:3, :3]
    positions = local.positions.astype(np.float64) @ linear.T + matrix[:3, 3]
    # det(M) inv(M)^T = cofactor matrix: the inverse transpose without a division, so flat scales survive.
    columns = linear.T
    cofactor = np.stack(
        [np.cross(columns[1], columns[2]), np.cross(columns[2], columns[0]), np.cross(columns[0], columns[1])],
        axis=1,
    )
    mirrored = np.linalg.det(linear) < 0
    normals = local.normals.astype(np.float64) @ (-cofactor if mirrored else cofactor).T
    order = np.arange(len(positions)).reshape(-1, 3)
    if mirrored:
        order = order[:, [0, 2, 1]]
    corners = positions[order]
    with np.errstate(invalid="ignore", over="ignore"):
        edges = corners - np.roll(corners, 1, axis=1)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1)
        longest = (edges**2).sum(-1).max(-1) if len(edges) else np.zeros(0)
        finite = np.isfinite(corners).all((1, 2)) & np.isfinite(corners.astype(np.float32)).all((1, 2))
        solid = area > DEGENERATE * longest
    keep = finite & solid
    repairs["non_finite_triangles"] += int((~finite).sum())
    repairs["degenerate_triangles"] += int((finite & ~solid).sum())
    order = order[keep]
    flat = order.ravel()
    normals, replaced = _unit_normals(normals[flat], cross[keep] / area[keep, None])
    repairs["normals_replaced"] += replaced
    uv_layers = {layer: uv[flat] for layer, uv in local.uv_layers.items()}
    for uv in uv_layers.values():
        bad = ~np.isfinite(uv)
        repairs["uv_replaced"] += int(bad.any(1).sum())
        uv[bad] = 0
    return FrozenMesh(
        name=name,
        object_name=name,
        object_id=0,
        positions=positions[flat].astype(np.float32),
        normals=normals.astype(np.float32),
        material_index=np.ascontiguousarray(local.material_index[keep], np.int32),
        materials=list(local.materials),
        uv_layers=uv_layers,
        active_uv=local.active_uv,
        atlas=np.zeros((len(flat), 2), np.float32),
    )


def _unit_normals(normals: np.ndarray, face: np.ndarray) -> tuple[np.ndarray, int]:
    """Unit corner normals [3T, 3]; zero or non-finite ones become the face normal [T, 3]. And their count."""
    length = np.linalg.norm(normals, axis=1)
    bad = ~np.isfinite(length) | (length == 0)
    unit = normals / np.where(bad, 1, length)[:, None]
    unit[bad] = np.repeat(face, 3, axis=0)[bad]
    return unit, int(bad.sum())


def _unique(name: str, taken: set[str]) -> str:
    """A file-safe name not yet in ``taken`` (compared without case: some file systems ignore it)."""
    stem = re.sub(r"[^A-Za-z0-9_.-]", "_", name).lstrip(".") or "object"
    candidate, number = stem, 1
    while candidate.lower() in taken:
        candidate = f"{stem}_{number:04d}"
        number += 1
    taken.add(candidate.lower())
    return candidate

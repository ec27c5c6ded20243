"""The scene ``dnrpipe.gbuffer``: the frozen triangles with atlas UVs, set up for exact one-sample passes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import bpy
import numpy as np

from ..bundle.ply import weld
from ..geometry.frozen import ATLAS_LAYER, FrozenMesh
from ..geometry.local_mesh import new_mesh
from ..shading.textures import Value
from .cutouts import (
    CUT_LAYER,
    TRANSPARENT_BOUNCES,
    cut_coordinates,
    cutout_material,
    emission_material,
    is_absent,
    is_opaque,
    placed,
    soften,
)

GBUFFER_SCENE = "dnrpipe.gbuffer"
GBUFFER_LAYER = "G"
BOUNDS = "dnrpipe.bounds"
"""Custom property of the scene: centre x y z and radius of a sphere that holds it."""
PLACEMENTS = "dnrpipe.placement"


def add_gbuffer_scene(
    meshes: Sequence[FrozenMesh], opacities: Mapping[str | None, Value] | None = None
) -> bpy.types.Scene:
    """Add the G-buffer scene to the open file and return it. World space equals the original scene's.

    All instances with one object id are joined: Cycles' synchronisation costs time per object. Copies stay Blender
    instances of one mesh. Absent: what is hidden from the camera, and surfaces without opacity.

    Args:
        opacities: by material name; materials not listed are opaque.
    """
    cut = {name: placed(opacity) for name, opacity in (opacities or {}).items() if not is_opaque(opacity)}
    scene = bpy.data.scenes.new(GBUFFER_SCENE)
    scene.view_layers[0].name = GBUFFER_LAYER
    solid = emission_material("dnrpipe.override")
    materials = {name: cutout_material(str(name), opacity) for name, opacity in cut.items() if not is_absent(opacity)}
    groups: dict[tuple[int, str], list[FrozenMesh]] = {}
    for mesh in meshes:
        if mesh.camera_visible:
            groups.setdefault((mesh.object_id, mesh.name if len(mesh.copies) else ""), []).append(mesh)
    for (object_id, name), group in groups.items():
        data = _mesh(f"dnrpipe.{object_id}{name}", group, cut, solid, materials)
        if data is None:
            continue
        obj = _add(scene, data, object_id)
        if name:
            _add_copies(scene, obj, group[0].copies, object_id)
    configure_exact(scene)
    points = np.array([[points.min(0), points.max(0)] for points in (mesh.extent() for mesh in meshes)])
    low, high = points[:, 0].min(0), points[:, 1].max(0)
    scene[BOUNDS] = [*((low + high) / 2).tolist(), float(np.linalg.norm(high - low) / 2)]
    layer = scene.view_layers[0]
    if materials:
        scene.cycles.transparent_max_bounces = TRANSPARENT_BOUNCES
    else:
        layer.material_override = solid
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_uv = True
    layer.use_pass_position = layer.use_pass_object_index = True
    return scene


def gbuffer_bounds(scene: bpy.types.Scene) -> tuple[np.ndarray, float]:
    """Centre and radius of a sphere that holds the scene, scene units."""
    *center, radius = scene[BOUNDS]
    return np.array(center), float(radius)


def set_up_coverage(scene: bpy.types.Scene, samples: int) -> None:
    """Turn a G-buffer scene into one whose alpha is coverage: one-pixel box filter, ``samples`` samples.

    Persistent data ignores samples and filters that change later, so this comes before the first frame.
    """
    cycles, layer = scene.cycles, scene.view_layers[0]
    soften({slot.material for obj in scene.objects for slot in obj.material_slots if slot.material is not None})
    cycles.samples = samples
    # Pixels that are all in or all out stop after Cycles' first 16 samples: 64 cost as much as 17 then.
    cycles.use_adaptive_sampling = True
    cycles.adaptive_threshold = 0.001
    cycles.adaptive_min_samples = min(samples, 16)
    cycles.pixel_filter_type = "BOX"
    cycles.filter_width = 1.0
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_uv = False
    layer.use_pass_position = layer.use_pass_object_index = False


def configure_exact(scene: bpy.types.Scene) -> None:
    """One ray through every pixel centre, no shading, nothing left to chance."""
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.film_transparent = True
    render.use_persistent_data = True
    render.resolution_percentage = 100
    render.use_compositing = render.use_sequencer = render.use_simplify = False
    render.dither_intensity = 0.0
    cycles.device = "CPU"
    cycles.samples = 1
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.pixel_filter_type = "BLACKMAN_HARRIS"
    cycles.filter_width = 0.01
    cycles.max_bounces = 0
    cycles.transparent_max_bounces = 0
    cycles.seed = 0
    scene.view_layers[0].use_pass_combined = True


def _add(scene: bpy.types.Scene, data: bpy.types.Mesh, object_id: int) -> bpy.types.Object:
    obj = bpy.data.objects.new(data.name, data)
    obj.pass_index = object_id
    scene.collection.objects.link(obj)
    return obj


def _add_copies(scene: bpy.types.Scene, obj: bpy.types.Object, copies: np.ndarray, object_id: int) -> None:
    """Geometry nodes that instance ``obj`` with every matrix: tens of thousands of objects would take minutes."""
    points = bpy.data.meshes.new(f"{obj.name}.copies")
    points.vertices.add(len(copies))
    attribute = points.attributes.new(PLACEMENTS, "FLOAT4X4", "POINT")
    # Attributes hold matrices column by column.
    attribute.data.foreach_set("value", copies.transpose(0, 2, 1).astype(np.float32).ravel())
    holder = _add(scene, points, object_id)
    tree = bpy.data.node_groups.new(f"{obj.name}.copies", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    source = tree.nodes.new("GeometryNodeObjectInfo")
    source.transform_space = "ORIGINAL"
    source.inputs["Object"].default_value = obj
    source.inputs["As Instance"].default_value = True
    scatter = tree.nodes.new("GeometryNodeInstanceOnPoints")
    place = tree.nodes.new("GeometryNodeSetInstanceTransform")
    read = tree.nodes.new("GeometryNodeInputNamedAttribute")
    read.data_type = "FLOAT4X4"
    read.inputs["Name"].default_value = PLACEMENTS
    tree.links.new(start.outputs[0], scatter.inputs["Points"])
    tree.links.new(source.outputs["Geometry"], scatter.inputs["Instance"])
    tree.links.new(scatter.outputs[0], place.inputs["Instances"])
    tree.links.new(read.outputs["Attribute"], place.inputs["Transform"])
    tree.links.new(place.outputs[0], end.inputs[0])
    holder.modifiers.new("copies", "NODES").node_group = tree


def _mesh(
    name: str,
    group: Sequence[FrozenMesh],
    cut: Mapping[str | None, Value],
    solid: bpy.types.Material,
    materials: Mapping[str | None, bpy.types.Material],
) -> bpy.types.Mesh | None:
    """The meshes of a group as one, with atlas UVs and corner normals; None when nothing of it is there."""
    names = list(materials)
    slot = np.concatenate([_slots(mesh, cut, names) for mesh in group])
    corners = np.repeat(slot >= 0, 3)
    if not corners.any():
        return None
    welded = weld(
        np.concatenate([mesh.positions for mesh in group])[corners],
        np.concatenate([mesh.normals for mesh in group])[corners],
        None,
    )
    data = new_mesh(name, welded.vertices[:, :3], welded.faces)
    atlas = np.concatenate([mesh.atlas for mesh in group])[corners]
    data.uv_layers.new(name=ATLAS_LAYER).uv.foreach_set("vector", np.ascontiguousarray(atlas).ravel())
    # "Free" custom normals (since 4.5): plain vectors, not the two angles in 16 bits of older files.
    attribute = data.attributes.new("custom_normal", "FLOAT_VECTOR", "POINT")
    attribute.data.foreach_set("vector", np.ascontiguousarray(welded.vertices[:, 3:6]).ravel())
    data.materials.append(solid)
    if (slot > 0).any():
        placement = np.concatenate([cut_coordinates(mesh, cut) for mesh in group])[corners]
        data.uv_layers.new(name=CUT_LAYER).uv.foreach_set("vector", np.ascontiguousarray(placement).ravel())
        for material in materials.values():
            data.materials.append(material)
        data.polygons.foreach_set("material_index", slot[slot >= 0].astype(np.int32))
    data.update()
    return data


def _slots(mesh: FrozenMesh, cut: Mapping[str | None, Value], names: Sequence[str | None]) -> np.ndarray:
    """Per triangle, int [T]: 0 solid, 1 + k the k-th cut-out material, -1 absent."""
    table = [0 if name not in cut else 1 + names.index(name) if name in names else -1 for name in mesh.materials]
    return np.array(table)[mesh.material_index]

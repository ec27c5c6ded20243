"""The scene ``dnrpipe.gbuffer``: the frozen triangles with atlas UVs, set up for exact one-sample passes."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from dnrpipe.errors import UserError

from .frozen import FrozenMesh

GBUFFER_SCENE = "dnrpipe.gbuffer"
GBUFFER_LAYER = "G"
ATLAS_LAYER = "dnrpipe.atlas"
PASS_INDEX_LIMIT = 32_767  # Object.pass_index is a 16-bit number


def add_gbuffer_scene(meshes: Sequence[FrozenMesh]) -> bpy.types.Scene:
    """Add the G-buffer scene to the open file and return it. World space equals the original scene's.

    All instances with one object id are joined: Cycles' synchronisation costs time per object.
    Raises UserError when there are more objects than Blender can number.
    """
    count = max(mesh.object_id for mesh in meshes)
    if count > PASS_INDEX_LIMIT:
        raise UserError(f"the scene has {count} objects; at most {PASS_INDEX_LIMIT} can be told apart, join some")
    scene = bpy.data.scenes.new(GBUFFER_SCENE)
    scene.view_layers[0].name = GBUFFER_LAYER
    material = _override_material()
    groups: dict[int, list[FrozenMesh]] = {}
    for mesh in meshes:
        groups.setdefault(mesh.object_id, []).append(mesh)
    for object_id, group in groups.items():
        obj = bpy.data.objects.new(f"dnrpipe.{object_id}", _mesh(f"dnrpipe.{object_id}", group))
        obj.data.materials.append(material)
        obj.pass_index = object_id
        scene.collection.objects.link(obj)
    configure_exact(scene)
    layer = scene.view_layers[0]
    layer.material_override = material
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_uv = True
    layer.use_pass_position = layer.use_pass_object_index = True
    return scene


def set_up_coverage(scene: bpy.types.Scene, samples: int) -> None:
    """Turn a G-buffer scene into one whose alpha is coverage: one-pixel box filter, ``samples`` samples.

    Persistent data ignores samples and filters that change later, so this comes before the first frame.
    """
    cycles, layer = scene.cycles, scene.view_layers[0]
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


def _override_material() -> bpy.types.Material:
    """Emission: the cheapest shader, and the only kind whose Normal pass is the geometry's, not a BSDF's."""
    material = bpy.data.materials.new("dnrpipe.override")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    emission = tree.nodes.new("ShaderNodeEmission")
    tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    material.cycles.emission_sampling = "NONE"  # else every triangle becomes a light, with a light tree to build
    return material


def _mesh(name: str, group: Sequence[FrozenMesh]) -> bpy.types.Mesh:
    positions = np.concatenate([mesh.positions for mesh in group])
    normals = np.concatenate([mesh.normals for mesh in group])
    atlas = np.concatenate([mesh.atlas for mesh in group])
    corners = len(positions)
    data = bpy.data.meshes.new(name)
    data.vertices.add(corners)
    data.loops.add(corners)
    data.polygons.add(corners // 3)
    data.vertices.foreach_set("co", positions.ravel())
    data.loops.foreach_set("vertex_index", np.arange(corners, dtype=np.int32))
    data.polygons.foreach_set("loop_start", np.arange(0, corners, 3, dtype=np.int32))
    data.update(calc_edges=True)
    data.uv_layers.new(name=ATLAS_LAYER).uv.foreach_set("vector", atlas.ravel())
    # "Free" custom normals (since 4.5): plain vectors, not the two angles in 16 bits of older files.
    attribute = data.attributes.new("custom_normal", "FLOAT_VECTOR", "POINT")
    attribute.data.foreach_set("vector", normals.ravel())
    data.update()
    return data

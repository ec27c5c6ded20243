"""The test scene and its preparation, for subprocesses (bpy is process-global state).

``python tests/blender_scene.py build OUT.blend`` builds it; ``... freeze SOURCE FOLDER`` opens any scene
file and writes FOLDER/{geometry.npz, source.blend, report.json} with dnrpipe's own functions.

Sphere, cube and plane with rotations; a mirrored and a sheared object; an instanced collection; custom
normals; a render-hidden object; a subdivision that exists in renders only; degenerate triangles.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import mathutils
import numpy as np

from dnrpipe.blender.cameras import camera_animation, scene_cameras
from dnrpipe.blender.geometry.atlas import build_atlas
from dnrpipe.blender.geometry.freeze import freeze_scene
from dnrpipe.blender.geometry.frozen import save_geometry
from dnrpipe.blender.passes.gbuffer_scene import add_gbuffer_scene
from dnrpipe.blender.reading.light import ensure_light, has_light
from dnrpipe.blender.reading.opening import open_scene
from dnrpipe.blender.reading.packing import pack_everything, save_blend
from dnrtrain.atomic import write_json


def add(name: str, data: bpy.types.ID, matrix: mathutils.Matrix, collection: bpy.types.Collection) -> bpy.types.Object:
    obj = bpy.data.objects.new(name, data)
    obj.matrix_world = matrix
    collection.objects.link(obj)
    return obj


def primitive(operator: str, **options: object) -> bpy.types.Mesh:
    getattr(bpy.ops.mesh, operator)(**options)
    obj = bpy.context.object
    data = obj.data
    bpy.data.objects.remove(obj)
    return data


def coloured(name: str, colour: tuple[float, float, float]) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1)
    return material


def build(path: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    root = scene.collection
    euler, move, diagonal = mathutils.Euler, mathutils.Matrix.Translation, mathutils.Matrix.Diagonal

    sphere = primitive("primitive_uv_sphere_add", segments=24, ring_count=12, radius=0.6)
    sphere.shade_smooth()
    sphere.materials.append(coloured("red", (0.8, 0.1, 0.1)))
    rotation = euler((0.3, 0.5, 0.2)).to_matrix().to_4x4()
    add("sphere", sphere, move((-1, 0, 0.7)) @ rotation @ diagonal((1, 0.7, 1.2, 1)), root)

    cube = primitive("primitive_cube_add", size=0.9)
    cube.materials.append(coloured("green", (0.1, 0.7, 0.2)))
    cube.materials.append(coloured("blue", (0.1, 0.2, 0.8)))
    cube.polygons[0].material_index = 1
    add("cube/one", cube, move((0.6, -0.4, 0.6)) @ euler((0.4, 0.2, 0.9)).to_matrix().to_4x4(), root)

    plane = primitive("primitive_plane_add", size=4)
    add("plane", plane, euler((0.02, 0.03, 0)).to_matrix().to_4x4(), root)

    cone = primitive("primitive_cone_add", vertices=16, radius1=0.4, depth=0.8)
    cone.shade_smooth()
    # Custom normals that differ from the surface's own: bent upwards.
    bent = np.empty((len(cone.loops), 3), np.float32)
    cone.corner_normals.foreach_get("vector", bent.ravel())
    bent += (0, 0, 0.7)
    cone.normals_split_custom_set((bent / np.linalg.norm(bent, axis=1, keepdims=True)).tolist())
    mirrored = move((0.5, 1.1, 0.5)) @ euler((0.2, 0, 0.4)).to_matrix().to_4x4() @ diagonal((-1, 1.3, 0.8, 1))
    add("mirrored", cone, mirrored, root)

    group = bpy.data.collections.new("group")
    add("member", cone, move((0, 0, 0.2)), group)
    add("text", bpy.data.curves.new("text", "FONT"), move((0, 0.3, 0)) @ diagonal((0.3, 0.3, 0.3, 1)), group)
    for i in range(3):
        instancer = add(f"instancer{i}", None, move((-1.4 + i, -1.3, 0.4)) @ diagonal((0.6, 0.6, 0.6, 1)), root)
        instancer.instance_type = "COLLECTION"
        instancer.instance_collection = group

    subdivided = primitive("primitive_cube_add", size=0.7)
    obj = add("subdivided", subdivided, move((-0.6, 1.3, 0.5)), root)
    modifier = obj.modifiers.new("s", "SUBSURF")
    modifier.levels, modifier.render_levels = 0, 2

    hidden = add("hidden", primitive("primitive_cube_add", size=0.5), move((0, 0, 1.5)), root)
    hidden.hide_render = True

    broken = bpy.data.meshes.new("broken")
    nan = float("nan")
    vertices = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (nan, 0, 0)]
    broken.from_pydata(vertices, [], [(0, 1, 2), (0, 1, 3), (0, 1, 4)])
    add("broken", broken, move((1.1, 0.6, 0.3)) @ diagonal((0.4, 0.4, 0.4, 1)), root)

    light = bpy.data.lights.new("sun", "SUN")
    light.energy = 3
    add("sun", light, euler((0.6, 0.3, 0)).to_matrix().to_4x4(), root)
    camera = bpy.data.cameras.new("camera")
    camera.lens, camera.shift_x = 40, 0.1
    scene.camera = add("camera", camera, move((4, -4, 3)) @ diagonal((2, 2, 2, 1)), root)
    scene.camera.keyframe_insert("location", frame=1)
    scene.camera.location.x += 1
    scene.camera.keyframe_insert("location", frame=10)
    scene.frame_end = 10
    scene.frame_set(1)
    # Things that must not leak into passes.
    scene.render.use_border = scene.render.use_crop_to_border = True
    scene.render.border_max_x = 0.3
    scene.render.use_simplify = True
    scene.render.simplify_subdivision_render = 0
    scene.render.use_stamp = True
    scene.timeline_markers.new("m", frame=1).camera = scene.camera
    # A registered text block is a script that Blender runs on opening, where scripts are allowed.
    script = bpy.data.texts.new("evil.py")
    script.write(f"open({path + '.executed'!r}, 'w').close()\n")
    script.use_module = True
    bpy.ops.wm.save_as_mainfile(filepath=path)


def freeze(source: str, folder: str) -> None:
    scene_dir = Path(folder)
    warnings = open_scene(source)
    scene = bpy.context.scene
    before = len(bpy.data.objects)
    frozen = freeze_scene(scene)
    assert len(bpy.data.objects) == before
    atlas = build_atlas(frozen.meshes)
    assert len(bpy.data.objects) == before
    save_geometry(scene_dir / "geometry.npz", frozen.meshes)
    report = {
        "warnings": warnings + frozen.warnings + ensure_light(scene, frozen.meshes),
        "repairs": frozen.repairs,
        "atlas": atlas.data(),
        "cameras": [camera.data() for camera in scene_cameras(scene)],
        "animation": [camera.data() for camera in camera_animation(scene)],
        "has_light": has_light(scene, frozen.meshes),
        "packing": pack_everything(),
    }
    add_gbuffer_scene(frozen.meshes)
    save_blend(scene_dir / "source.blend")
    write_json(scene_dir / "report.json", report)


if __name__ == "__main__":
    {"build": build, "freeze": freeze}[sys.argv[1]](*sys.argv[2:])

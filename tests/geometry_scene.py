"""Cut-outs, hidden objects, instances and hair, for subprocesses (bpy and mitsuba are process-global state).

``python tests/geometry_scene.py prepare FOLDER`` builds the scene and writes FOLDER/{scene.xml, source.blend,
report.json}; ``... passes FOLDER`` renders FOLDER/view.exr; ``... trace FOLDER`` writes FOLDER/trace.npz: alpha [H, W]
as the ray tracer's camera sees it.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

SIZE = 64
LATTICE = 64  # squared: more instances than get a place of their own


def build() -> None:
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene

    def material(name: str, alpha: float = 1.0) -> bpy.types.Material:
        made = bpy.data.materials.new(name)
        made.use_nodes = True
        made.node_tree.nodes["Principled BSDF"].inputs["Alpha"].default_value = alpha
        return made

    def put(name: str, of: Any, location: tuple[float, float, float], kind: str, **options: Any) -> bpy.types.Object:
        getattr(bpy.ops.mesh, f"primitive_{kind}_add")(**options)
        obj = bpy.context.object
        obj.name, obj.location = name, location
        obj.data.materials.append(of)
        return obj

    leaf = material("leaf")
    y, x = np.mgrid[:32, :32]
    pixels = np.ones((32, 32, 4), np.float32)
    pixels[..., 3] = (x - 12) ** 2 + (y - 18) ** 2 < 80
    image = bpy.data.images.new("leaf", 32, 32, alpha=True)
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    nodes, links = leaf.node_tree.nodes, leaf.node_tree.links
    texture, mapping, place = (nodes.new(f"ShaderNode{kind}") for kind in ("TexImage", "Mapping", "TexCoord"))
    texture.image = image
    mapping.inputs["Scale"].default_value = (2, 2, 1)
    mapping.inputs["Rotation"].default_value = (0, 0, 0.3)
    links.new(place.outputs["UV"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    links.new(texture.outputs["Alpha"], nodes["Principled BSDF"].inputs["Alpha"])

    solid = material("solid")
    sheet = put("sheet", leaf, (0, 0, 0.6), "plane", size=2.5)
    sheet.rotation_euler = (1.3, 0, 0.2)
    put("ball", solid, (0.4, 1.5, 0.6), "uv_sphere", radius=0.7)
    put("ghost", material("ghost", 0.0), (0.9, -1, 0.9), "cube", size=0.6)
    put("unseen", solid, (-0.9, -1, 0.9), "cube", size=0.6).visible_camera = False

    pebble = put("pebble", solid, (0, 0, -5), "cube", size=0.07)
    ground = put("ground", solid, (0, 0, -0.9), "grid", x_subdivisions=LATTICE - 1, y_subdivisions=LATTICE - 1, size=4)
    tree = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    info = tree.nodes.new("GeometryNodeObjectInfo")
    info.inputs["Object"].default_value = pebble
    info.inputs["As Instance"].default_value = True
    scatter, turn = tree.nodes.new("GeometryNodeInstanceOnPoints"), tree.nodes.new("FunctionNodeRandomValue")
    turn.data_type = "FLOAT_VECTOR"
    scatter.inputs["Scale"].default_value = (1, -1, 2)  # mirrored
    tree.links.new(start.outputs[0], scatter.inputs["Points"])
    tree.links.new(info.outputs["Geometry"], scatter.inputs["Instance"])
    tree.links.new(turn.outputs[0], scatter.inputs["Rotation"])
    tree.links.new(scatter.outputs[0], end.inputs[0])
    ground.modifiers.new("scatter", "NODES").node_group = tree

    head = put("head", solid, (-1.3, 0.6, 0.4), "uv_sphere", radius=0.2, segments=8, ring_count=6)
    head.modifiers.new("hair", "PARTICLE_SYSTEM")
    hair = head.particle_systems[0].settings
    hair.type, hair.count, hair.hair_length, hair.root_radius = "HAIR", 40, 0.4, 2.0
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)


def prepare(folder: Path) -> None:
    import bpy

    from dnrpipe.blender.baking.pending import convert_materials
    from dnrpipe.blender.bundle.export import export_bundle
    from dnrpipe.blender.geometry.atlas import build_atlas
    from dnrpipe.blender.geometry.freeze import freeze_scene
    from dnrpipe.blender.passes.gbuffer_scene import add_gbuffer_scene
    from dnrpipe.blender.reading.packing import save_blend

    build()
    frozen = freeze_scene(bpy.context.scene)
    atlas = build_atlas(frozen.meshes)
    materials = export_bundle(frozen.meshes, convert_materials(frozen.meshes, folder, frozen.findings, None))
    add_gbuffer_scene(frozen.meshes, {name: converted.opacity for name, converted in materials.items()})
    save_blend(folder / "source.blend")
    meshes = {mesh.name: [mesh.triangles, len(mesh.copies), mesh.object_id] for mesh in frozen.meshes}
    report = {"meshes": meshes, "atlas": atlas.data(), "findings": [finding.data() for finding in frozen.findings]}
    (folder / "report.json").write_text(json.dumps(report))


def view() -> dict[str, Any]:
    eye, target = np.array([0.3, -5.0, 1.6]), np.array([0.0, 0.0, 0.2])
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = eye
    lens = {"fl_x": 1.3 * SIZE, "fl_y": 1.3 * SIZE, "cx": SIZE / 2, "cy": SIZE / 2}
    return {"name": "view", "width": SIZE, "height": SIZE, **lens, "c2w": pose.tolist()}


def passes(folder: Path) -> None:
    from dnrpipe.blender.passes.worker import Worker

    worker = Worker(
        {
            "scene_dir": str(folder),
            "raster_engine": "cycles-direct",
            "raster_samples": 1,
            "coverage_samples": 64,
            "threads": 1,
        }
    )
    worker({"view": view(), "output": str(folder / "view.exr"), "raster": False, "fingerprint": "test"})


def trace(folder: Path) -> None:
    from dnrpipe.raytrace.engine import Engine
    from dnrtrain.contract import View

    seen = View.model_validate(view())
    bundle = folder / "scene.xml"
    engine = Engine("llvm_ad_rgb", 1, [bundle])
    integrator, _ = engine.integrator(bundle, "path", 16)  # what is passed through counts as a bounce
    image, _ = engine.frame(bundle, integrator, engine.sensor(seen), seen, 64, 0)
    np.savez(folder / "trace.npz", alpha=image[..., 3])


if __name__ == "__main__":
    {"prepare": prepare, "passes": passes, "trace": trace}[sys.argv[1]](Path(sys.argv[2]))

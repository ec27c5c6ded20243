"""The census: what is in a scene, as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

bpy = pytest.importorskip("bpy")

from dnrpipe.blender.census import take_census  # noqa: E402
from dnrpipe.blender.findings import Findings  # noqa: E402
from dnrpipe.blender.geometry.freeze import freeze_scene  # noqa: E402
from dnrpipe.blender.passes.camera import describe  # noqa: E402
from dnrpipe.core.scene_records import Census  # noqa: E402


def _census(scene: Any) -> Census:
    return take_census(scene, Findings(), freeze_scene(scene).meshes)


@pytest.fixture
def scene(tmp_path: Path) -> Any:
    """A cube instanced by a collection, a glass ball, a hidden lamp, a lamp with a noisy lit floor."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.object
    glass = bpy.data.materials.new("Glass")
    glass.use_nodes = True
    glass.node_tree.nodes["Principled BSDF"].inputs["Transmission Weight"].default_value = 1.0
    glass.node_tree.nodes["Principled BSDF"].inputs["Roughness"].default_value = 0.02
    cube.data.materials.append(glass)
    folder = bpy.data.collections.new("Parts")
    scene.collection.objects.unlink(cube)
    folder.objects.link(cube)
    for i in range(3):
        empty = bpy.data.objects.new(f"Instance {i}", None)
        empty.instance_type, empty.instance_collection = "COLLECTION", folder
        empty.location.x = 3 * i
        scene.collection.objects.link(empty)
    bpy.ops.mesh.primitive_plane_add()
    noisy = bpy.data.materials.new("Noisy")
    noisy.use_nodes = True
    tree = noisy.node_tree
    noise = tree.nodes.new("ShaderNodeTexNoise")
    tree.links.new(noise.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    tree.nodes["Principled BSDF"].inputs["Emission Strength"].default_value = 2.0
    bpy.context.object.data.materials.append(noisy)
    for name, hidden in (("Lamp", False), ("Off", True)):
        data = bpy.data.lights.new(name, "AREA")
        data.energy, data.size = 50, 2.0
        body = bpy.data.objects.new(name, data)
        body.hide_render = hidden
        scene.collection.objects.link(body)
    return scene


def test_counts_instances_triangles_and_lamps(scene: Any) -> None:
    report = _census(scene)
    assert report.instances == 4
    assert report.triangles == 3 * 12 + 2
    assert report.objects == {"EMPTY": 3, "LIGHT": 1, "MESH": 1}
    assert [(lamp.name, lamp.type, lamp.size) for lamp in report.lights] == [("Lamp", "AREA", (2.0, 2.0))]
    assert report.world is None
    assert Census.model_validate(json.loads(json.dumps(report.data(), allow_nan=False))) == report


def test_lists_features_by_material(scene: Any) -> None:
    report = _census(scene)
    assert report.transmission == ["Glass"]
    assert report.emission == report.procedural_textures == ["Noisy"]
    assert report.subsurface == report.volumes == report.hair == report.transparency == []
    assert report.materials["Glass"].bsdfs == ["Principled BSDF"]
    assert report.materials["Glass"].min_roughness == pytest.approx(0.02)


def test_only_nodes_that_reach_the_output_count(scene: Any) -> None:
    tree = bpy.data.materials["Noisy"].node_tree
    tree.nodes.new("ShaderNodeBsdfGlass")  # linked to nothing
    tree.nodes.new("ShaderNodeVolumeScatter")
    entry = _census(scene).materials["Noisy"]
    assert not entry.refractive and not entry.volume and "Glass BSDF" not in entry.nodes
    assert entry.glossy and entry.min_roughness == pytest.approx(0.5) and entry.objects == ["Plane"]


def test_says_what_effects_need_to_know(scene: Any) -> None:
    report = _census(scene)
    glass = report.materials["Glass"]
    assert glass.refractive and glass.ior == pytest.approx(1.5) and glass.objects == ["Cube"]
    assert not glass.thin_film and not glass.roughness_linked
    principled = bpy.data.materials["Glass"].node_tree.nodes["Principled BSDF"]
    principled.inputs["Thin Film Thickness"].default_value = 300
    noise = bpy.data.materials["Glass"].node_tree.nodes.new("ShaderNodeTexNoise")
    bpy.data.materials["Glass"].node_tree.links.new(noise.outputs["Fac"], principled.inputs["Roughness"])
    glass = _census(scene).materials["Glass"]
    assert glass.thin_film and glass.roughness_linked and glass.min_roughness is None


def test_cameras_with_depth_of_field_and_moving_objects_are_named(scene: Any) -> None:
    camera = bpy.data.objects.new("Close-up", bpy.data.cameras.new("Close-up"))
    scene.collection.objects.link(camera)
    camera.data.dof.use_dof, camera.data.dof.aperture_fstop = True, 2.0
    camera.data.dof.focus_object = bpy.data.objects["Plane"]
    camera.location = (0, 0, 5)
    bpy.context.view_layer.update()
    bpy.data.objects["Plane"].keyframe_insert("location", frame=1)
    scene.render.use_motion_blur = True
    findings = Findings()
    report = take_census(scene, findings, freeze_scene(scene).meshes)
    assert report.depth_of_field == ["Close-up"] and report.motion == ["Plane"]
    assert [(f.kind, f.object) for f in findings] == [("ignored", "Plane")]
    lens = describe(camera, scene.render).dof
    assert lens == {"aperture_radius": pytest.approx(50 / 4000), "focus_distance": pytest.approx(5.0)}


def test_a_dark_world_gives_no_light(scene: Any) -> None:
    world = bpy.data.worlds.new("Night")
    world.use_nodes = True
    scene.world = world
    lit = _census(scene).world
    assert lit is not None and lit.emits
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
    dark = _census(scene).world
    assert dark is not None and not dark.emits


def test_missing_image_is_a_finding(scene: Any, tmp_path: Path) -> None:
    path = tmp_path / "lost.png"
    path.write_bytes(b"x")
    image = bpy.data.images.load(str(path))
    image.use_fake_user = True
    path.unlink()
    findings = Findings()
    report = take_census(scene, findings, freeze_scene(scene).meshes)
    assert [image.name for image in report.images if image.missing] == ["lost.png"]
    assert report.findings == list(findings)
    assert report.findings[0].kind == "missing"


def test_findings_are_deduplicated_and_ordered() -> None:
    findings = Findings()
    findings.add("ignored", "hair", "left out", object="Fur")
    findings.add("baked", "world", "rendered")
    findings.add("ignored", "hair", "left out", object="Fur")
    assert len(findings) == 2
    assert [finding.feature for finding in findings] == ["hair", "world"]
    assert next(iter(findings)).data() == {
        "kind": "ignored",
        "object": "Fur",
        "material": None,
        "feature": "hair",
        "note": "left out",
    }

"""The census: what is in a scene, as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

bpy = pytest.importorskip("bpy")

from dnrpipe.blender.census import take_census  # noqa: E402
from dnrpipe.blender.findings import Findings  # noqa: E402


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
    report = take_census(scene, Findings())
    assert report["instances"] == 4
    assert report["triangles"] == 3 * 12 + 2
    assert report["objects"] == {"EMPTY": 3, "LIGHT": 1, "MESH": 1}
    assert [(lamp["name"], lamp["type"], lamp["size"]) for lamp in report["lights"]] == [("Lamp", "AREA", [2.0, 2.0])]
    assert report["world"] is None
    assert json.loads(json.dumps(report, allow_nan=False)) == report


def test_lists_features_by_material(scene: Any) -> None:
    report = take_census(scene, Findings())
    assert report["transmission"] == ["Glass"]
    assert report["emission"] == report["procedural_textures"] == ["Noisy"]
    assert report["subsurface"] == report["volumes"] == report["hair"] == report["transparency"] == []
    assert report["materials"]["Glass"]["bsdfs"] == ["Principled BSDF"]
    assert report["materials"]["Glass"]["min_roughness"] == pytest.approx(0.02)


def test_missing_image_is_a_finding(scene: Any, tmp_path: Path) -> None:
    path = tmp_path / "lost.png"
    path.write_bytes(b"x")
    image = bpy.data.images.load(str(path))
    image.use_fake_user = True
    path.unlink()
    findings = Findings()
    report = take_census(scene, findings)
    assert [entry["name"] for entry in report["images"] if entry["missing"]] == ["lost.png"]
    assert report["findings"] == findings.to_list()
    assert findings.to_list()[0]["kind"] == "missing"


def test_findings_are_deduplicated_and_ordered() -> None:
    findings = Findings()
    findings.add("ignored", "hair", "left out", object="Fur")
    findings.add("baked", "world", "rendered")
    findings.add("ignored", "hair", "left out", object="Fur")
    assert len(findings) == 2
    assert [entry["feature"] for entry in findings.to_list()] == ["hair", "world"]
    assert findings.to_list()[0] == {
        "kind": "ignored",
        "object": "Fur",
        "material": None,
        "feature": "hair",
        "note": "left out",
    }

"""`dnrpipe export-gltf`: read back by Blender's own importer, in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from e2e_harness import run

from dnrpipe.cli import _main

pytestmark = [pytest.mark.slow, pytest.mark.e2e]

READER = """
import json, sys
import bpy
import addon_utils
import numpy as np
bpy.ops.wm.read_factory_settings(use_empty=True)
addon_utils.enable("io_scene_gltf2")
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
corners, image = [], None
for item in bpy.context.scene.objects:
    if item.type != "MESH":
        continue
    mesh = item.data
    world = np.array(item.matrix_world)
    place = np.empty(3 * len(mesh.vertices)); mesh.vertices.foreach_get("co", place)
    vertex = np.empty(len(mesh.loops), int); mesh.loops.foreach_get("vertex_index", vertex)
    uv = np.empty(2 * len(mesh.loops)); mesh.uv_layers[0].data.foreach_get("uv", uv)
    normal = np.empty(3 * len(mesh.loops)); mesh.corner_normals.foreach_get("vector", normal)
    place = place.reshape(-1, 3)[vertex] @ world[:3, :3].T + world[:3, 3]
    corners.append(np.concatenate([place, uv.reshape(-1, 2), normal.reshape(-1, 3)], axis=1))
for found in bpy.data.images:
    if found.size[0] > 0:
        image = list(found.size)
np.savez(sys.argv[2], corners=np.concatenate(corners), image=np.array(image or []))
"""


def _imported(path: Path, folder: Path) -> dict[str, np.ndarray]:
    script, target = folder / "reader.py", folder / "read.npz"
    script.write_text(READER)
    subprocess.run([sys.executable, script, path, target], check=True, capture_output=True, timeout=300)
    with np.load(target) as data:
        return dict(data)


def test_blender_reads_the_scene_back(tiny: Path, tmp_path: Path) -> None:
    """The same corners, atlas coordinates and normals as the geometry that the G-buffers are rendered from."""
    out = tmp_path / "scene.glb"
    answer = json.loads(run("export-gltf", str(tiny), "--out", str(out), "--json", folder=tmp_path).stdout)
    read = _imported(out, tmp_path)
    assert read["image"].tolist() == answer["texture"] == [128, 128]
    from dnrpipe.export.meshes import read_meshes

    meshes = read_meshes(tiny / "scene")
    ours = np.concatenate([np.concatenate([m.positions, m.atlas, m.normals], axis=1)[m.faces.ravel()] for m in meshes])
    assert len(ours) == 3 * answer["triangles"] == len(read["corners"])
    order = [np.lexsort(np.round(table[:, :5], 3).T) for table in (ours, read["corners"])]
    ours, theirs = ours[order[0]], read["corners"][order[1]]
    assert np.median(np.abs(ours - theirs).max(axis=1)) < 1e-4
    # Rounding may swap a few neighbours in the order; as sets they agree.
    assert np.allclose(np.sort(ours[:, :5], axis=0), np.sort(theirs[:, :5], axis=0), atol=1e-4)
    bounds = json.loads((tiny / "scene" / "summary.json").read_text())["bounds"]
    assert np.allclose(theirs[:, :3].min(axis=0), bounds["min"], atol=1e-3)
    assert np.allclose(theirs[:, :3].max(axis=0), bounds["max"], atol=1e-3)


def test_file_follows_the_format(tiny: Path, tmp_path: Path) -> None:
    """Lengths, alignment, Y up and finite unit normals, read without our writer."""
    out = tmp_path / "plain.glb"
    assert _main(["export-gltf", str(tiny), "--out", str(out), "--no-light"]) == 0
    raw = out.read_bytes()
    assert raw[:4] == b"glTF" and int.from_bytes(raw[8:12], "little") == len(raw) and len(raw) % 4 == 0
    length = int.from_bytes(raw[12:16], "little")
    document = json.loads(raw[20 : 20 + length])
    body = raw[28 + length :]
    assert document["buffers"][0]["byteLength"] == len(body) == int.from_bytes(raw[20 + length : 24 + length], "little")
    assert "images" not in document
    tops = []
    for mesh in document["meshes"]:
        attributes = mesh["primitives"][0]["attributes"]
        for name, width in (("NORMAL", 3), ("TEXCOORD_0", 2)):
            accessor = document["accessors"][attributes[name]]
            view = document["bufferViews"][accessor["bufferView"]]
            assert view["byteOffset"] % 4 == 0
            values = np.frombuffer(body, "<f4", accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
            if name == "NORMAL":
                assert np.allclose(np.linalg.norm(values, axis=1), 1, atol=1e-3)
            else:
                assert values.min() >= 0 and values.max() <= 1
        tops.append(document["accessors"][attributes["POSITION"]]["max"][1])
    assert max(tops) == pytest.approx(json.loads((tiny / "scene" / "summary.json").read_text())["bounds"]["max"][2])


def test_refusals(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _main(["export-gltf", str(tiny), "--out", str(tmp_path / "x.obj")]) == 2
    assert "ends in .glb" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []

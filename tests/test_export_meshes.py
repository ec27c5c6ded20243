"""The bundle's meshes without Blender and Mitsuba: instances, units, what the camera does not see, and their glTF."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dnrpipe.blender.bundle.ply import weld, write_ply
from dnrpipe.core.errors import UserError
from dnrpipe.export.folder import claim, finish
from dnrpipe.export.gltf import Y_UP, glb
from dnrpipe.export.meshes import BundleMesh, read_meshes, read_ply

TRIANGLE = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 1]], np.float32)
PLACED = np.array([[0, -1, 0, 6], [1, 0, 0, 8], [0, 0, 1, 10], [0, 0, 0, 1]], float)


def _bundle(folder: Path, unit: float) -> Path:
    """A mesh of its own, an instanced one, a lamp and a mesh that the camera does not see."""
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (3, 1))
    place = np.array([[0.1, 0.2, 0], [0.3, 0.2, 0], [0.1, 0.6, 0]], np.float32)
    write_ply(folder / "meshes" / "t.ply", [weld(TRIANGLE * np.float32(unit), normals, None, [("atlas", place)])])
    shape = '<shape type="ply" id="{}"><string name="filename" value="meshes/t.ply"/><ref id="mat-Wood"/></shape>'
    matrix = PLACED.copy()
    matrix[:3, 3] *= unit
    text = " ".join(map(str, matrix.ravel()))
    (folder / "scene.xml").write_text(
        f'<scene version="3.0.0"><default name="unit_scale" value="{unit}"/>'
        + shape.format("mesh-one")
        + shape.format("unseen-two")
        + shape.format("light-three")
        + f'<shape type="shapegroup" id="group-g">{shape.format("mesh-part")}</shape>'
        + '<shape type="instance" id="instance-group-g-0"><ref id="group-g"/><transform name="to_world">'
        + f'<matrix value="{text}"/></transform></shape>'
        + '<shape type="instance" id="unseen-instance-group-g-1"><ref id="group-g"/><transform name="to_world">'
        + f'<matrix value="{text}"/></transform></shape></scene>'
    )
    return folder


@pytest.mark.parametrize("unit", [1.0, 4096.0])
def test_instances_units_and_what_is_hidden(tmp_path: Path, unit: float) -> None:
    one, part = read_meshes(_bundle(tmp_path, unit))
    assert (one.name, part.name, one.material) == ("mesh-one", "mesh-part", "Wood")
    assert np.allclose(one.positions[one.faces[0]], TRIANGLE) and one.uv is None
    assert one.placements.shape == (1, 4, 4) and np.array_equal(one.placements[0], np.eye(4))
    assert np.allclose(part.placements, PLACED[None])


def test_damaged_bundles_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is missing"):
        read_meshes(tmp_path)
    folder = _bundle(tmp_path, 1.0)
    mesh = folder / "meshes" / "t.ply"
    mesh.write_bytes(mesh.read_bytes()[:-5])
    with pytest.raises(UserError, match=r"t\.ply"):
        read_ply(mesh)
    (folder / "scene.xml").write_text("<scene")
    with pytest.raises(UserError, match="damaged"):
        read_meshes(folder)


def _document(raw: bytes) -> tuple[dict, bytes]:
    length = int.from_bytes(raw[12:16], "little")
    return json.loads(raw[20 : 20 + length]), raw[28 + length :]


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_a_placed_corner_lands_where_it_was_turned_up(count: int, seed: int) -> None:
    """node matrix · POSITION = Y_UP · placement · position, for any affine placement."""
    rng = np.random.default_rng(seed)
    placement = np.eye(4)
    placement[:3] = rng.normal(size=(3, 4))
    positions = rng.normal(size=(3 * count, 3)).astype(np.float32)
    mesh = BundleMesh(
        "m", "x", positions, np.zeros_like(positions), rng.random((3 * count, 2), np.float32), None,
        np.arange(3 * count, dtype=np.int32).reshape(-1, 3), placement[None],
    )  # fmt: skip
    document, body = _document(glb([mesh], None))
    matrix = np.array(document["nodes"][0]["matrix"]).reshape(4, 4).T
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    view = document["bufferViews"][accessor["bufferView"]]
    local = np.frombuffer(body, "<f4", 9 * count, view["byteOffset"]).reshape(-1, 3)
    ones = np.ones((3 * count, 1))
    found = np.concatenate([local, ones], axis=1) @ matrix.T
    expected = np.concatenate([positions, ones], axis=1) @ (Y_UP @ placement).T
    assert np.allclose(found, expected, atol=1e-5)
    assert np.allclose(local.min(axis=0), accessor["min"]) and np.allclose(local.max(axis=0), accessor["max"])
    normal = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]]
    start = document["bufferViews"][normal["bufferView"]]["byteOffset"]
    assert np.allclose(np.linalg.norm(np.frombuffer(body, "<f4", 9 * count, start).reshape(-1, 3), axis=1), 1)


def test_a_folder_is_taken_over_from_its_own_kind_only(tmp_path: Path) -> None:
    out = tmp_path / "out"
    claim(out, "nerf")
    (out / "a").write_text("1")
    (out / "mine").write_text("2")
    finish(out, "nerf", [out / "a"])
    with pytest.raises(UserError, match="another kind"):
        claim(out, "web")
    claim(out, "nerf")
    finish(out, "nerf", [])
    assert not (out / "a").exists() and (out / "mine").exists()  # what no export wrote stays
    marker = out / ".dnrpipe-export"
    marker.write_text("nerf\n../victim\n")
    (tmp_path / "victim").write_text("3")
    finish(out, "nerf", [])
    assert (tmp_path / "victim").exists()  # a marker of someone else's cannot reach outside

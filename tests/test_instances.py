"""Sharing of instances, welded PLY files, chart atlas, texel density."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("bpy")

from dnrpipe.blender.bundle.ply import weld, write_ply
from dnrpipe.blender.findings import Findings
from dnrpipe.blender.geometry.atlas import measure_atlas, texel_density
from dnrpipe.blender.geometry.charts import chart_atlas, count_pieces
from dnrpipe.blender.geometry.frozen import FrozenMesh, load_geometry, save_geometry
from dnrpipe.blender.geometry.instances import Placed, copy_matrices, share_instances
from dnrpipe.blender.geometry.local_mesh import LocalMesh
from dnrpipe.blender.geometry.simplify import fit_instances


def ball(rings: int = 12) -> np.ndarray:
    """Corners [3T, 3] of a unit sphere, counter-clockwise from outside."""
    u = np.linspace(0, np.pi, rings + 1)
    v = np.linspace(0, 2 * np.pi, 2 * rings + 1)[:-1]
    grid = np.stack(
        [np.sin(u)[:, None] * np.cos(v), np.sin(u)[:, None] * np.sin(v), np.cos(u)[:, None] * np.ones_like(v)], -1
    )
    a, b = grid[:-1], grid[1:]
    c, d = np.roll(b, -1, 1), np.roll(a, -1, 1)
    corners = np.concatenate([np.stack([a, b, c], 2)[:, :].reshape(-1, 3, 3), np.stack([a, c, d], 2).reshape(-1, 3, 3)])
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return corners[area > 1e-9].reshape(-1, 3).astype(np.float32)


def frozen(positions: np.ndarray, **fields: Any) -> FrozenMesh:
    count = len(positions) // 3
    normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    return FrozenMesh("mesh", "mesh", 1, positions, normals, np.zeros(count, np.int32), [None], **fields)


def placed(count: int, mesh: LocalMesh, digest: bytes, name: str) -> list[Placed]:
    rng = np.random.default_rng(0)
    result = []
    for i in range(count):
        matrix = np.eye(4)
        matrix[:3, :3] = rng.normal(size=(3, 3))
        matrix[:3, 3] = rng.normal(size=3)
        result.append(Placed(name, (i,), matrix, mesh, digest))
    return result


def local(triangles: int) -> LocalMesh:
    return LocalMesh(np.zeros((3 * triangles, 3)), np.zeros((3 * triangles, 3)), np.zeros(triangles, int), [None])


def test_few_instances_stay_apart_and_many_share() -> None:
    few, many = placed(5, local(10), b"few", "few"), placed(50, local(1000), b"many", "many")
    shared = share_instances([*many, *few], extra_triangles=1000, extra_meshes=100)
    assert [(item.lead.name, len(item.others)) for item in shared] == [("few", 0)] * 5 + [("many", 49)]
    assert {item.lead.persistent for item in shared[:5]} == {(i,) for i in range(5)}
    crowd = share_instances([*many, *few], extra_triangles=10**9, extra_meshes=3)
    assert [len(item.others) for item in crowd] == [4, 49]


def test_copies_take_the_lead_to_the_others_and_flat_ones_stay_apart() -> None:
    items = placed(9, local(10), b"x", "x")
    items[4].matrix[:3, 2] = 0
    shared = share_instances(items, extra_triangles=0)
    assert sorted(len(item.others) for item in shared) == [0, 7]
    group = max(shared, key=lambda item: len(item.others))
    point = np.array([0.3, -0.2, 0.9, 1])
    for matrix, other in zip(copy_matrices(group), group.others, strict=True):
        assert matrix @ group.lead.matrix @ point == pytest.approx(other.matrix @ point, rel=1e-9)


def test_copies_survive_the_file_and_count_in_the_extent(tmp_path: Path) -> None:
    far = np.eye(4)
    far[:3, 3] = (10, 0, 0)
    mesh = frozen(ball(), copies=far[None], camera_visible=False, active_color="c")
    mesh.colors = {"c": np.random.default_rng(0).random((len(mesh.positions), 4)).astype(np.float32)}
    mesh.atlas = np.zeros((len(mesh.positions), 2), np.float32)
    save_geometry(tmp_path / "geometry.npz", [mesh])
    (again,) = load_geometry(tmp_path / "geometry.npz")
    assert (again.copies == mesh.copies).all() and not again.camera_visible
    assert (again.colors["c"] == mesh.colors["c"]).all()
    assert again.extent().max(0) == pytest.approx([11, 1, 1], abs=0.02)


def test_welded_file_holds_the_same_triangles_and_their_copies(tmp_path: Path) -> None:
    positions = ball()
    normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    uv = np.random.default_rng(0).random((len(positions) // 3, 2)).astype(np.float32).repeat(3, 0)
    stretch = np.diag([1.0, 2.0, -3.0, 1.0])
    part = weld(positions, normals, uv, [("color0", positions)], stretch[None])
    write_ply(tmp_path / "x.ply", [part])
    assert len(weld(positions, normals, None).vertices) < len(positions) / 4
    raw = (tmp_path / "x.ply").read_bytes()
    header, body = raw.split(b"end_header\n", 1)
    assert b"color0_r" in header and b"property float t" in header
    vertices = np.frombuffer(body[: 2 * len(part.vertices) * 44], "<f4").reshape(-1, 11)
    faces = np.frombuffer(body[vertices.nbytes :], np.dtype([("n", "u1"), ("v", "<i4", 3)]))
    corners = vertices[faces["v"].ravel()]
    count = len(positions)
    assert (corners[:count, :3] == positions).all() and (corners[:count, 6:8] == uv).all()
    assert corners[count:, :3] == pytest.approx(positions * (1, 2, -3))
    # The gradient of (x, y/2, -z/3)'s sphere, not the stretched normal.
    outward = positions / (1, 2, -3)
    assert corners[count:, 3:6] == pytest.approx(outward / np.linalg.norm(outward, axis=1, keepdims=True), abs=1e-5)


def test_charts_cover_a_crowd_without_overlap() -> None:
    rng = np.random.default_rng(1)
    meshes = [frozen((ball(16) * rng.uniform(0.5, 2)).astype(np.float32)) for _ in range(30)]
    assert count_pieces(meshes) == 30
    chart_atlas(meshes, np.ones(30))
    corners = np.concatenate([mesh.atlas for mesh in meshes])
    assert corners.min() >= 0 and corners.max() < 1
    numbers = measure_atlas(meshes, 512)
    assert numbers["overlap"] < 0.002
    assert numbers["occupancy"] > 0.5


def test_small_parts_keep_charts_of_their_own_until_they_are_too_many() -> None:
    """A plate of knobs, whose parts share grid cells: joined, they overlap and leave most of the atlas empty."""
    places = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0)), axis=-1).reshape(-1, 1, 2)
    knobs = np.repeat(0.4 * ball(6)[None], len(places), axis=0)
    knobs[..., :2] += places
    meshes = [frozen(knobs.reshape(-1, 3).astype(np.float32))]
    chart_atlas(meshes, np.ones(1))
    apart = measure_atlas(meshes, 512)
    assert apart["occupancy"] > 0.45 and apart["overlap"] < 0.002
    chart_atlas(meshes, np.ones(1), most=100)
    joined = measure_atlas(meshes, 512)
    assert meshes[0].atlas.min() >= 0 and meshes[0].atlas.max() < 1
    assert joined["occupancy"] < apart["occupancy"] - 0.1 or joined["overlap"] > 0.01


def test_a_big_ground_leaves_texels_to_small_things() -> None:
    small, ground = frozen(ball()), frozen(100 * ball())
    density = texel_density([small, small, ground])
    assert density[0] == 1
    # 10,000 times the area: a tenth of the texels per area.
    assert density[2] == pytest.approx(10_000 ** (-1 / 8), rel=1e-3)


def test_heavy_crowds_are_simplified_to_the_budget_and_reported() -> None:
    copies = np.repeat(np.eye(4)[None], 200, 0)
    heavy, light = frozen(ball(24), copies=copies), frozen(ball(4), copies=copies)
    before, unchanged = heavy.triangles, light.triangles
    findings = Findings()
    fit_instances(
        [heavy, light],
        dict.fromkeys(("degenerate_triangles", "non_finite_triangles", "normals_replaced"), 0),
        findings,
        budget=40_000,
    )
    assert light.triangles == unchanged
    assert heavy.triangles * 200 + unchanged * 200 < 44_000 and before * 200 > 400_000
    assert len(heavy.copies) == 200
    assert np.linalg.norm(heavy.positions, axis=1) == pytest.approx(1, abs=0.1)
    (finding,) = findings
    assert finding.feature == "heavy instances" and f"{before:,}" in finding.note

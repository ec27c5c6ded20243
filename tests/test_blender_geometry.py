"""Opening scene files, freezing them, and the atlas."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dnrpipe.blender.geometry.frozen import FrozenMesh, load_geometry, save_geometry
from dnrpipe.core.errors import UserError

pytest.importorskip("bpy")
HELPER = Path(__file__).with_name("blender_scene.py")


def helper(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(HELPER), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="session")
def frozen_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with test.blend and what the helper made of it."""
    folder = tmp_path_factory.mktemp("frozen")
    built = helper("build", folder / "test.blend")
    assert built.returncode == 0, built.stderr
    done = helper("freeze", folder / "test.blend", folder)
    assert done.returncode == 0, done.stderr
    return folder


def by_name(folder: Path) -> dict[str, FrozenMesh]:
    return {mesh.name: mesh for mesh in load_geometry(folder / "geometry.npz")}


@pytest.mark.slow
def test_freeze_collects_what_a_render_sees(frozen_scene: Path) -> None:
    meshes = by_name(frozen_scene)
    assert not any("hidden" in name for name in meshes)
    instances = [m for m in meshes.values() if m.object_name == "member"]
    assert len(instances) == 3
    assert len({m.object_id for m in instances}) == 1
    assert len({tuple(m.positions.mean(0).round(3)) for m in instances}) == 3
    assert sum(m.object_name == "text" for m in meshes.values()) == 3
    # Render level 2 of the subdivision (6 * 4² quads), although simplify would hold it at 0.
    assert meshes["subdivided"].triangles == 2 * 6 * 16
    assert "cube_one" in meshes
    assert meshes["cube_one"].object_name == "cube/one"
    assert meshes["cube_one"].materials == ["green", "blue"]
    assert np.bincount(meshes["cube_one"].material_index).tolist() == [10, 2]
    assert meshes["plane"].materials == [None]
    assert meshes["sphere"].active_uv == "UVMap"
    ids = {m.object_name: m.object_id for m in meshes.values()}
    assert sorted(ids.values()) == list(range(1, len(ids) + 1))


@pytest.mark.slow
def test_winding_is_outward_even_when_mirrored(frozen_scene: Path) -> None:
    meshes = by_name(frozen_scene)
    for name in ("sphere", "cube_one", "mirrored", "subdivided"):
        corners = meshes[name].positions.astype(np.float64).reshape(-1, 3, 3)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outward = corners.mean(1) - corners.mean((0, 1))
        assert ((cross * outward).sum(1) > 0).all(), name
        normals = meshes[name].normals
        assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-5
    # Smooth normals of an ellipsoid under rotation and scale: the gradient of |M^-1 (x - c)|².
    sphere = meshes["sphere"]
    agree = (sphere.normals * np.repeat(_face_normals(sphere), 3, axis=0)).sum(1)
    assert agree.min() > 0.9


def _face_normals(mesh: FrozenMesh) -> np.ndarray:
    corners = mesh.positions.astype(np.float64).reshape(-1, 3, 3)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return cross / np.linalg.norm(cross, axis=1, keepdims=True)


@pytest.mark.slow
def test_repairs_are_counted(frozen_scene: Path) -> None:
    report = json.loads((frozen_scene / "report.json").read_text())
    assert report["repairs"]["non_finite_triangles"] == 1
    assert report["repairs"]["degenerate_triangles"] >= 1
    assert by_name(frozen_scene)["broken"].triangles == 1
    for mesh in by_name(frozen_scene).values():
        assert np.isfinite(mesh.positions).all()


@pytest.mark.slow
def test_embedded_scripts_are_never_run(frozen_scene: Path) -> None:
    assert not (frozen_scene / "test.blend.executed").exists()


@pytest.mark.slow
def test_cameras_are_rigid_and_animation_is_found(frozen_scene: Path) -> None:
    report = json.loads((frozen_scene / "report.json").read_text())
    (camera,) = report["cameras"]
    rotation = np.array(camera["c2w"])[:3, :3]
    assert camera["active"]
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert camera["shift_x"] == pytest.approx(0.1)
    assert [frame["frame"] for frame in report["animation"]] == list(range(1, 11))
    assert report["animation"][-1]["c2w"][0][3] == pytest.approx(camera["c2w"][0][3] + 1)
    assert report["has_light"]


def _doubled_areas(corners: np.ndarray) -> float:
    """Twice the area of triangles [3T, 2 or 3]."""
    solid = np.zeros((len(corners), 3))
    solid[:, : corners.shape[1]] = corners
    a, b, c = solid.reshape(-1, 3, 3).transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


@pytest.mark.slow
def test_atlas_gives_every_surface_its_own_place(frozen_scene: Path) -> None:
    report = json.loads((frozen_scene / "report.json").read_text())
    meshes = load_geometry(frozen_scene / "geometry.npz")
    atlas = np.concatenate([mesh.atlas for mesh in meshes])
    assert atlas.min() >= 0
    assert atlas.max() < 1
    assert report["atlas"]["overlap"] < 0.002
    assert report["atlas"]["occupancy"] > 0.5
    # Texels per unit as planned: coarser by area^(1/8), so that a ground does not take them all.
    density = np.array([np.sqrt(_doubled_areas(mesh.atlas) / _doubled_areas(mesh.positions)) for mesh in meshes])
    planned = np.array([_doubled_areas(mesh.positions) for mesh in meshes]) ** (-1 / 8)
    assert np.ptp(density / planned) < 0.05 * (density / planned).max()


@pytest.mark.slow
def test_freezing_again_gives_the_same_bytes(frozen_scene: Path, tmp_path: Path) -> None:
    done = helper("freeze", frozen_scene / "test.blend", tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "geometry.npz").read_bytes() == (frozen_scene / "geometry.npz").read_bytes()


@pytest.mark.slow
def test_obj_with_relative_texture(shared_assets: Path, tmp_path: Path) -> None:
    done = helper("freeze", shared_assets / "spot" / "spot.obj", tmp_path)
    assert done.returncode == 0, done.stderr
    (mesh,) = load_geometry(tmp_path / "geometry.npz")
    assert mesh.triangles == 5856
    assert mesh.uv_layers
    report = json.loads((tmp_path / "report.json").read_text())
    assert not any("missing" in warning for warning in report["warnings"])
    assert any("no light" in warning for warning in report["warnings"])


@pytest.mark.slow
def test_missing_images_are_named(shared_assets: Path, tmp_path: Path) -> None:
    copy = tmp_path / "multiuvs.blend"
    copy.write_bytes((shared_assets / "multiuvs" / "multiuvs.blend").read_bytes())
    done = helper("freeze", copy, tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert any("checker.png" in warning and "missing" in warning for warning in report["warnings"])


def _damaged(folder: Path, kind: str) -> tuple[Path, str]:
    """A bad file and what the message must say."""
    if kind == "absent":
        return folder / "absent.blend", "no such file"
    if kind == "format":
        (folder / "scene.max").write_bytes(b"x")
        return folder / "scene.max", "cannot read '.max' files"
    if kind == "text":
        (folder / "text.blend").write_text("not a blend file")
        return folder / "text.blend", "is not a Blender file"
    if kind == "empty":
        (folder / "empty.blend").write_bytes(b"")
        return folder / "empty.blend", "is empty"
    if kind == "truncated":
        built = helper("build", folder / "whole.blend")
        assert built.returncode == 0, built.stderr
        data = (folder / "whole.blend").read_bytes()
        (folder / "cut.blend").write_bytes(data[: len(data) * 2 // 3])
        return folder / "cut.blend", "damaged or truncated"
    (folder / "nothing.obj").write_text("# no faces\n")
    return folder / "nothing.obj", "nothing was imported"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["absent", "format", "text", "empty", "truncated", "nothing"])
def test_unusable_files_are_refused_in_one_line(tmp_path: Path, kind: str) -> None:
    path, message = _damaged(tmp_path, kind)
    done = helper("freeze", path, tmp_path)
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 1
    assert last.startswith("dnrpipe.core.errors.UserError: ")
    assert message in last
    assert path.name in last


def test_geometry_file_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    mesh = FrozenMesh(
        name="a",
        object_name="a/b",
        object_id=3,
        positions=rng.normal(size=(6, 3)).astype(np.float32),
        normals=rng.normal(size=(6, 3)).astype(np.float32),
        material_index=np.array([0, 1], np.int32),
        materials=["wood", None],
        uv_layers={"first": np.zeros((6, 2), np.float32), "Größe": np.ones((6, 2), np.float32)},
        active_uv="Größe",
        atlas=np.full((6, 2), 0.5, np.float32),
    )
    save_geometry(tmp_path / "g.npz", [mesh])
    (again,) = load_geometry(tmp_path / "g.npz")
    assert again.materials == mesh.materials
    assert again.active_uv == "Größe"
    assert list(again.uv_layers) == ["first", "Größe"]
    for name in ("positions", "normals", "material_index", "atlas"):
        assert np.array_equal(getattr(again, name), getattr(mesh, name))


def test_damaged_geometry_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        load_geometry(tmp_path / "g.npz")
    (tmp_path / "g.npz").write_bytes(b"PK nonsense")
    with pytest.raises(UserError, match="damaged"):
        load_geometry(tmp_path / "g.npz")


def test_overlap_is_measured() -> None:
    measure_atlas = pytest.importorskip("dnrpipe.blender.geometry.atlas").measure_atlas
    square = np.array([[0, 0], [0.5, 0], [0.5, 0.5], [0, 0], [0.5, 0.5], [0, 0.5]], np.float32)
    positions = np.concatenate([square, np.zeros((6, 1), np.float32)], axis=1)

    def mesh(offset: float) -> FrozenMesh:
        index = np.zeros(2, np.int32)
        return FrozenMesh("m", "m", 1, positions, positions, index, [None], atlas=square + np.float32(offset))

    apart = measure_atlas([mesh(0), mesh(0.5)], 64)
    assert apart["overlap"] == 0
    # Centres on the shared diagonal are strictly inside neither triangle: 2 * 32 of 2 * 32².
    assert apart["occupancy"] == pytest.approx(0.5, abs=0.02)
    assert apart["texels_per_unit"]["median"] == pytest.approx(64)
    assert measure_atlas([mesh(0), mesh(0)], 64)["overlap"] == 1
    half = measure_atlas([mesh(0), mesh(0.25)], 64)
    assert half["overlap"] == pytest.approx(0.25 / 1.75, abs=0.02)

"""View sampling, splits, scene cameras, NeRF camera files."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.scene_records import CAMERA, sphere_summary

from dnrpipe.core.cameras import depth_range, make_cameras, orbit_views, split_views
from dnrpipe.core.errors import UserError
from dnrpipe.core.settings import CameraSettings
from dnrtrain.contract import ContractError, View, parse_transforms, read_cameras, write_cameras

CENTER, RADIUS = (1.0, -2.0, 0.5), 1.5
SUMMARY = sphere_summary(CENTER, RADIUS)


def _camera(**changes) -> dict:
    return {**CAMERA, "active": True, **changes}


def _project(view: View, point: np.ndarray) -> np.ndarray:
    x, y, z = (np.linalg.inv(view.matrix) @ np.append(point, 1.0))[:3]
    return np.array([view.cx + view.fl_x * x / -z, view.cy - view.fl_y * y / -z])


@pytest.mark.parametrize("source", ["dome", "sphere"])
@pytest.mark.parametrize("size", [(128, 128), (160, 90), (90, 160)])
def test_every_view_holds_the_bounding_sphere(source: str, size: tuple[int, int]) -> None:
    cameras = CameraSettings(source=source, train=30, val=3, test=7, width=size[0], height=size[1])
    views = make_cameras(SUMMARY, cameras)
    assert [len(views[s]) for s in ("train", "val", "test")] == [30, 3, 7]
    center = np.array(SUMMARY.bounds.center)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3))
    points = center + 1.5 * points / np.linalg.norm(points, axis=1, keepdims=True)
    below = 0
    for view in views["train"]:
        below += view.position[2] < center[2]
        pixels = np.array([_project(view, p) for p in points])
        assert (pixels > -1e-6).all()
        assert (pixels < np.array(size) + 1e-6).all()
    assert (below > 0) == (source == "sphere")


def test_splits_share_no_view_and_do_not_move_each_other() -> None:
    few = make_cameras(SUMMARY, CameraSettings(train=10, val=5, test=5, width=64, height=64))
    more = make_cameras(SUMMARY, CameraSettings(train=10, val=5, test=50, width=64, height=64))
    assert few["train"] == more["train"]
    positions = np.array([v.position for views in few.values() for v in views])
    distances = np.linalg.norm(positions[:, None] - positions[None], axis=-1) + np.eye(len(positions))
    assert distances.min() > 1e-3
    other = make_cameras(SUMMARY, CameraSettings(train=10, val=5, test=5, width=64, height=64, seed=1))
    assert other["train"] != few["train"]


def test_scene_camera_shift_and_fit_follow_blender() -> None:
    camera = _camera(shift_x=0.1, shift_y=-0.2)
    landscape = CameraSettings(source="scene", width=200, height=100, test=0, val=0)
    view = make_cameras(sphere_summary(CENTER, RADIUS, cameras=[camera]), landscape)["train"][0]
    assert view.fl_x == pytest.approx(35 / 36 * 200)
    assert (view.cx, view.cy) == pytest.approx((100 - 20, 50 - 40))
    portrait = landscape.model_copy(update={"width": 100, "height": 200})
    view = make_cameras(sphere_summary(CENTER, RADIUS, cameras=[camera]), portrait)["train"][0]
    assert view.fl_x == pytest.approx(35 / 36 * 200)
    vertical = _camera(sensor_fit="VERTICAL")
    view = make_cameras(sphere_summary(CENTER, RADIUS, cameras=[vertical]), landscape)["train"][0]
    assert view.fl_x == pytest.approx(35 / 24 * 100)


def test_missing_sources_are_refused(tmp_path: Path) -> None:
    for source, word in (("scene", "no perspective camera"), ("animation", "does not move")):
        with pytest.raises(UserError, match=word):
            make_cameras(SUMMARY, CameraSettings(source=source))
    with pytest.raises(UserError, match="no such camera file"):
        make_cameras(SUMMARY, CameraSettings(source=str(tmp_path / "none.json")))


@given(st.integers(1, 60), st.integers(0, 30), st.integers(0, 30))
@settings(max_examples=50)
def test_dealing_out_given_views_loses_and_doubles_none(count: int, val: int, test: int) -> None:
    views = orbit_views(SUMMARY, CameraSettings(width=16, height=16), count)
    dealt = split_views(views, CameraSettings(val=val, test=test))
    names = [v.name for split in ("train", "val", "test") for v in dealt[split]]
    assert sorted(names) == sorted(v.name for v in views)
    assert len(dealt["train"]) >= math.ceil(count * 0.6)


def test_depth_range_holds_the_scene() -> None:
    views = make_cameras(SUMMARY, CameraSettings(train=20, width=64, height=64))["train"]
    near, far = depth_range(views, SUMMARY)
    for view in views:
        distance = np.linalg.norm(view.position - np.array(SUMMARY.bounds.center))
        assert near <= distance - 1.5 + 1e-9
        assert far >= distance + 1.5 - 1e-9


def test_camera_files_survive_a_round_trip(tmp_path: Path) -> None:
    views = make_cameras(SUMMARY, CameraSettings(train=5, width=64, height=48))["train"]
    write_cameras(tmp_path / "train.json", views, "train")
    assert read_cameras(tmp_path / "train.json") == views


def _transforms(tmp_path: Path, frames: list[dict], **shared) -> Path:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**shared, "frames": frames}))
    return path


def test_nerf_synthetic_files_are_read(tmp_path: Path) -> None:
    frames = [{"file_path": "./train/r_0", "transform_matrix": np.eye(4).tolist()}]
    path = _transforms(tmp_path, frames, camera_angle_x=0.6911112070083618)
    (view,) = parse_transforms(path, (800, 800))
    assert view.name == "r_0"
    assert view.fl_x == pytest.approx(1111.1110311937682)
    assert (view.cx, view.cy) == (400, 400)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"transform_matrix": [[float("nan")] * 4] * 4}, "NaN"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, "not a rotation"),
        ({"transform_matrix": np.eye(3).tolist()}, "4x4"),
        ({"fl_x": float("inf")}, "finite"),
        ({"w": 0}, "greater than"),
        ({"k1": 0.1}, "distortion"),
    ],
)
def test_broken_frames_are_refused_in_one_line(tmp_path: Path, change: dict, word: str) -> None:
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist(), "fl_x": 50.0, "w": 64, "h": 64}
    path = _transforms(tmp_path, [frame, frame | change])
    with pytest.raises(ContractError) as caught:
        parse_transforms(path)
    assert word in str(caught.value)
    assert "frame 1" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", '{"frames": []}', '{"frames": 3}', "\x00\xff"])
def test_files_that_are_no_camera_files(tmp_path: Path, text: str) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(text)
    with pytest.raises(ContractError):
        parse_transforms(path)


def test_camera_files_must_have_one_size(tmp_path: Path) -> None:
    frame = {"transform_matrix": np.eye(4).tolist(), "fl_x": 50.0, "w": 64, "h": 64}
    sizes = _transforms(tmp_path, [frame, frame | {"w": 32}])
    with pytest.raises(UserError, match="several image sizes"):
        make_cameras(SUMMARY, CameraSettings(source=str(sizes)))
    stretched = _transforms(tmp_path, [frame | {"fl_y": 60.0}])
    (view,) = make_cameras(SUMMARY, CameraSettings(source=str(stretched)))["train"]
    assert (view.fl_x, view.fl_y) == (50.0, 60.0)


BLENDER = """
import json, sys
import bpy
from mathutils import Euler, Matrix
from dnrpipe.blender.passes.camera import apply_view, describe
from dnrpipe.core.cameras import _scene_view
from dnrpipe.core.settings import CameraSettings
scene, worst = bpy.context.scene, 0.0
own, other = (bpy.data.objects.new(name, bpy.data.cameras.new(name)) for name in ("own", "other"))
for camera in (own, other):
    scene.collection.objects.link(camera)
own.matrix_world = Matrix.Translation((1, 2, 3)) @ Euler((0.3, 0.1, 2)).to_matrix().to_4x4()
data, render = own.data, scene.render
data.lens, data.sensor_width, data.sensor_height, data.shift_x, data.shift_y = 28, 30, 20, 0.1, -0.2
def seen(camera, size):
    depsgraph = bpy.context.evaluated_depsgraph_get()
    scales = {"scale_x": render.pixel_aspect_x, "scale_y": render.pixel_aspect_y}
    return camera.calc_matrix_camera(depsgraph, x=size[0], y=size[1], **scales)
for size in ((120, 80), (80, 120), (100, 100)):
    for data.sensor_fit in ("AUTO", "HORIZONTAL", "VERTICAL"):
        for aspect in ((1, 1), (2, 1), (1, 1.5)):
            render.pixel_aspect_x, render.pixel_aspect_y = aspect
            view = _scene_view(describe(own, render), *size)
            wanted = seen(own, size)
            apply_view(view, other, render, (data.clip_start, data.clip_end))
            found = seen(other, size)
            worst = max(worst, *(abs(a - b) for x, y in zip(wanted, found) for a, b in zip(x, y)))
            worst = max(worst, abs(view.fl_x * 2 / size[0] - wanted[0][0]), abs(view.fl_y * 2 / size[1] - wanted[1][1]))
            worst = max(worst, *(abs(a - b) for x, y in zip(own.matrix_world, view.c2w) for a, b in zip(x, y)))
print(worst)
"""


def test_a_camera_of_blender_and_its_view_see_the_same() -> None:
    """Blender's own projection, for every sensor fit and pixel aspect, off-centre; and back again."""
    pytest.importorskip("bpy")
    done = subprocess.run([sys.executable, "-c", BLENDER], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.splitlines()[-1]) < 1e-5


def test_names_are_safe_and_unique() -> None:
    cameras = [_camera(name=name) for name in ("Cam 1", "Cam.1", "Cam_1", "Камера")]
    views = make_cameras(
        sphere_summary(CENTER, RADIUS, cameras=cameras), CameraSettings(source="scene", test=0, val=0)
    )["train"]
    names = [view.name for view in views]
    assert names == ["Cam_1", "Cam.1", "Cam_1-2", "______"]


def test_a_split_may_be_empty(tmp_path: Path) -> None:
    write_cameras(tmp_path / "val.json", [], "val")
    assert read_cameras(tmp_path / "val.json") == []


@pytest.mark.parametrize("frame", ["text", 3, None, {"file_path": "a"}])
def test_frames_that_are_no_frames(tmp_path: Path, frame: object) -> None:
    path = _transforms(tmp_path, [frame], fl_x=50, w=64, h=64)  # type: ignore[list-item]
    with pytest.raises(ContractError, match="frame 0: has no 'transform_matrix'"):
        parse_transforms(path)


def test_ray_directions_point_at_their_pixels() -> None:
    view = make_cameras(SUMMARY, CameraSettings(train=1, width=20, height=10))["train"][0]
    rays = view.ray_directions()
    for row, column in ((0, 0), (9, 19), (4, 7)):
        pixel = _project(view, view.position + 3 * rays[row, column])
        assert pixel == pytest.approx([column + 0.5, row + 0.5], abs=1e-3)

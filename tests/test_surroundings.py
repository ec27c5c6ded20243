"""Rooms are filmed from inside, animated cameras beside their path, things on a table from a dome."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from dnrpipe.blender.prepare import prepare  # noqa: E402
from dnrpipe.core.cameras import automatic_source, make_cameras  # noqa: E402
from dnrpipe.core.errors import UserError  # noqa: E402
from dnrpipe.core.scene_records import SceneSummary  # noqa: E402
from dnrpipe.core.settings import CameraSettings  # noqa: E402

FEW = CameraSettings(train=30, val=4, test=8, width=32, height=32)


def _scene(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Any:
    """An empty file with boxes (centre, size) and a camera at (1, 1, 1.6) that looks along +Y."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    for centre, size in boxes:
        bpy.ops.mesh.primitive_cube_add(size=1, location=centre, scale=size)
    camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    camera.location, camera.rotation_euler = (1, 1, 1.6), (np.pi / 2, 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    return scene


def _summary(folder: Path) -> SceneSummary:
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
    summary = prepare(folder / "scene.blend", folder / "scene")
    assert isinstance(summary, SceneSummary)
    return summary


def _places(views: dict[str, list[Any]]) -> np.ndarray:
    return np.array([view.matrix[:3, 3] for split in views.values() for view in split])


ROOM = ((0, 0, 1.5), (6, 6, 3))
WARDROBE = ((-2, 2, 1), (1, 1, 2))


def test_a_room_is_filmed_from_inside(tmp_path: Path) -> None:
    _scene(ROOM, WARDROBE)
    summary = _summary(tmp_path)
    assert summary.surroundings is not None and summary.surroundings.enclosed == 1
    assert automatic_source(summary) == (
        "inside",
        "inside, as the scene's own camera meets surfaces in 100% of all directions",
    )
    views = make_cameras(summary, FEW)
    assert {split: len(found) for split, found in views.items()} == {"train": 30, "val": 4, "test": 8}
    places = _places(views)
    assert len(np.unique(places, axis=0)) == 42
    assert (np.abs(places[:, :2]) < 3).all() and (places[:, 2] > 0).all() and (places[:, 2] < 3).all()
    inside_wardrobe = (np.abs(places[:, 0] + 2) < 0.5) & (np.abs(places[:, 1] - 2) < 0.5) & (places[:, 2] < 2)
    assert not inside_wardrobe.any()
    assert np.ptp(places, axis=0).min() > 1.5  # all about the room
    assert make_cameras(summary, FEW) == views
    assert make_cameras(summary, FEW.model_copy(update={"seed": 1})) != views
    more = make_cameras(summary, FEW.model_copy(update={"train": 50}))
    assert more["test"] == views["test"] and more["train"][:30] == views["train"]
    dome = _places(make_cameras(summary, FEW.model_copy(update={"source": "dome"})))
    assert (np.linalg.norm(dome - summary.bounds.center, axis=1) > summary.bounds.radius).all()
    with pytest.raises(UserError, match=r"600 standpoints for cameras\.train, 601 are wanted"):
        make_cameras(summary, FEW.model_copy(update={"train": 601}))


def test_things_on_a_table_are_filmed_from_a_dome(tmp_path: Path) -> None:
    _scene(((0, 3, 0), (20, 20, 0.1)), ((0, 3, 0.5), (1, 1, 1)))
    summary = _summary(tmp_path)
    source, why = automatic_source(summary)
    assert source == "dome" and "% of all directions" in why
    assert make_cameras(summary, FEW) == make_cameras(summary, FEW.model_copy(update={"source": "dome"}))


def test_an_animated_camera_is_followed(tmp_path: Path) -> None:
    scene = _scene(ROOM)
    scene.frame_end = 20
    for frame, x in ((1, -2), (20, 2)):
        scene.camera.location.x = x
        scene.camera.keyframe_insert("location", frame=frame)
    summary = _summary(tmp_path)
    assert summary.surroundings is not None and summary.surroundings.moves
    assert automatic_source(summary)[0] == "inside"
    views = make_cameras(summary, FEW)
    places = _places(views)
    on_path = np.stack([np.clip(places[:, 0], -2, 2), np.ones(len(places)), np.full(len(places), 1.6)], axis=1)
    assert np.linalg.norm(places - on_path, axis=1).max() < 1.5
    assert np.ptp(places[:, 0]) > 2.5
    # They look where the camera looks, +Y, at what it sees.
    ahead = np.array([-view.matrix[:3, 2] for view in views["train"]])
    assert (ahead[:, 1] > 0).all()


def test_a_scene_without_camera_of_its_own_has_a_dome(tmp_path: Path) -> None:
    scene = _scene(((0, 0, 0), (1, 1, 1)))
    bpy.data.objects.remove(scene.camera)
    summary = _summary(tmp_path)
    assert automatic_source(summary)[0] == "dome"


def test_standpoints_are_asked_for_where_there_are_none(tmp_path: Path) -> None:
    scene = _scene(((0, 0, -50), (1, 1, 1)))
    scene.camera.rotation_euler = (np.pi, 0, 0)
    summary = _summary(tmp_path).model_copy(update={"surroundings": None})
    with pytest.raises(UserError, match=r"--cameras inside: .* use --cameras dome"):
        make_cameras(summary, FEW.model_copy(update={"source": "inside"}))

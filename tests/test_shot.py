"""The frames of a shot: their cameras, and what changes over them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from tests import shot_scenes  # noqa: E402

from dnrpipe.blender.motion import changes  # noqa: E402
from dnrpipe.blender.shot import Worker  # noqa: E402
from dnrpipe.blender.tasks import ShotTask  # noqa: E402
from dnrpipe.core.cameras import shot_views  # noqa: E402
from dnrpipe.core.errors import UserError  # noqa: E402
from dnrpipe.core.shot_records import ShotFacts, parse_frames  # noqa: E402


def ask(source: Path, frames: str | None = None, camera: str | None = None) -> ShotFacts:
    """The worker's answer, as it travels."""
    task = ShotTask(source=source, frames=None if frames is None else parse_frames(frames), camera=camera)
    return ShotFacts.model_validate(json.loads(json.dumps(Worker({})(task.data()))))


@pytest.mark.parametrize(
    ("text", "frames"),
    [("7", [7]), ("1-4", [1, 2, 3, 4]), ("1-6/2", [1, 3, 5]), ("-2-1", [-2, -1, 0, 1]), ("9, 1-2,2", [1, 2, 9])],
)
def test_frames_as_a_user_writes_them(text: str, frames: list[int]) -> None:
    assert list(parse_frames(text)) == frames


@pytest.mark.parametrize("text", ["", "a", "5-1", "1-9/0", "1-", "1,,2", "1-9999999", "-2000000"])
def test_frames_that_are_none(text: str) -> None:
    with pytest.raises(UserError, match="--frames"):
        parse_frames(text)


def test_views_of_a_shot_are_those_that_blender_renders(tmp_path: Path) -> None:
    """Against Blender's own projection and marker switch, in frames outside the file's range too."""
    shot = ask(shot_scenes.cameras(tmp_path), "-3-6")
    assert [camera.frame for camera in shot.cameras] == list(range(-3, 7))
    assert [camera.name for camera in shot.cameras] == ["wide"] * 7 + ["close"] * 3
    assert (shot.frame_start, shot.frame_end, shot.resolution) == (1, 5, (160, 90))
    assert shot.fps == pytest.approx(29.97, abs=1e-2)
    scene: Any = bpy.context.scene
    for size in ((160, 90), (70, 90)):
        views = shot_views(shot, *size)
        assert [view.name for view in views][::9] == ["frame-0003", "frame00006"]
        assert len({view.fl_x for view in views}) == 4
        for camera, view in zip(shot.cameras, views, strict=True):
            scene.frame_set(camera.frame)
            graph = bpy.context.evaluated_depsgraph_get()
            seen = scene.camera.evaluated_get(graph)
            assert seen.name == camera.name
            assert view.fl_x == pytest.approx(1.5 * view.fl_y)
            project = np.array(seen.calc_matrix_camera(graph, x=size[0], y=size[1], scale_x=1.0, scale_y=1.5))
            point = np.array([0.3, -0.2, -5.0, 1.0])
            x, y = (project @ point)[:2] / (project @ point)[3]
            expected = ((x + 1) / 2 * size[0], (1 - y) / 2 * size[1])
            found = view.cx + view.fl_x * point[0] / 5, view.cy - view.fl_y * point[1] / 5
            assert found == pytest.approx(expected, abs=1e-3)
            assert view.position == pytest.approx(list(seen.matrix_world.translation), abs=1e-5)


def test_any_camera_by_name(tmp_path: Path) -> None:
    path = shot_scenes.cameras(tmp_path)
    assert {camera.name for camera in ask(path, camera="close").cameras} == {"close"}
    assert [camera.frame for camera in ask(path).cameras] == [1, 2, 3, 4, 5]
    with pytest.raises(UserError, match=r"no camera 'none'.*'close', 'flat', 'wide'") as raised:
        ask(path, camera="none")
    assert str(path) in str(raised.value)
    with pytest.raises(UserError, match="'flat' is orthographic"):
        ask(path, camera="flat")


def test_only_the_rolling_sphere_is_named(tmp_path: Path) -> None:
    """Its camera moves too, on an empty of its own."""
    shot = ask(shot_scenes.rolling(tmp_path))
    (change,) = shot.changes
    assert (change.name, change.kind, change.surfaces, change.frames) == ("ball", "moves", ("ball",), (3, 4, 5))
    assert (shot.converted, shot.still, shot.changing(2), shot.changing(3)) == (1, [1, 2], [], ["ball"])


def test_frames_that_show_nothing_are_refused_by_number(tmp_path: Path) -> None:
    path = shot_scenes.vanishing(tmp_path)
    assert ask(path, "1-2").changing(1) == []
    with pytest.raises(UserError, match=r"vanishing\.blend: no surface is visible in frames 3-4, 6; leave them out"):
        ask(path, "1-6")


def test_a_shot_of_which_only_the_cameras_move_evaluates_nothing(tmp_path: Path) -> None:
    shot = ask(shot_scenes.cameras(tmp_path))
    assert shot.changes == [] and shot.examined == 0 and shot.still == [1, 2, 3, 4, 5]


def test_what_changes_is_named_with_its_kind_and_frames(tmp_path: Path) -> None:
    shot = ask(shot_scenes.menagerie(tmp_path))
    assert shot.examined == 4
    assert {(change.name, change.kind): change.frames for change in shot.changes} == {
        ("bending", "deforms"): (3, 4),
        ("blinking", "appears or disappears"): (2,),
        ("child", "moves"): (2, 3, 4),
        ("copies", "moves"): (4,),
        ("driven", "moves"): (2, 3, 4),
        ("falling", "moves"): (2, 3, 4),
        ("lamp", "light changes"): (4,),
        ("nodes", "deforms"): (3, 4),
        ("painted", "changes its material"): (3, 4),
        ("shaped", "deforms"): (3, 4),
        ("sign", "moves"): (3, 4),
        ("sky", "world changes"): (2, 3, 4),
        ("waving", "deforms"): (2, 3, 4),
    }
    assert next(change.surfaces for change in shot.changes if change.name == "copies") == ("member",)


def test_frames_that_there_is_no_time_for_count_as_their_neighbours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Never fewer changes than all frames have; keys are among the frames that are looked at."""
    path = shot_scenes.rolling(tmp_path)
    every = ask(path, "-20-40")
    monkeypatch.setattr(changes, "SECONDS", 0.0)
    monkeypatch.setattr(changes, "LEAST", 6)
    some = ask(path, "-20-40")
    assert every.examined == 61 and some.examined < 10
    assert set(every.changes[0].frames) <= set(some.changes[0].frames) and some.still


def test_a_camera_that_a_simulation_carries_falls_with_it(tmp_path: Path) -> None:
    heights = [camera.c2w[2][3] for camera in ask(shot_scenes.menagerie(tmp_path), camera="rider").cameras]
    assert heights[0] == pytest.approx(9) and heights == sorted(heights, reverse=True) and heights[3] < 8.99

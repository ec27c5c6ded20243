"""Bundles of a scene at other frames than the one that is converted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy")
pytest.importorskip("mitsuba")

from tests import shot_scenes

from dnrpipe.blender.baking.earlier import Earlier
from dnrpipe.blender.geometry.frozen import FrozenMesh
from dnrpipe.core.cameras import shot_views
from dnrpipe.core.console import Console
from dnrpipe.core.scene_files import read_summary
from dnrpipe.core.settings import Settings
from dnrpipe.core.workspace import Source, Workspace, file_sha256
from dnrpipe.export.meshes import read_ply
from dnrpipe.raytrace.variants import choose_variant
from dnrpipe.stages.prepare import convert_scene
from dnrpipe.stages.shot_scene import convert_frames, look_at_shot, scene_at
from dnrpipe.stages.stage import Run
from dnrpipe.workers.view_tasks import only_answer
from dnrtrain.contract import View
from dnrtrain.exr import read_exr

PLACES = {2: (0.0, 0.0, 1.0), 5: (2.0, 0.0, 1.0)}
"""The ball's centre by frame."""


@pytest.fixture(scope="module")
def rolled(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A workspace of the rolling sphere and the fading block, with its bundles at frames 2 and 5."""
    folder = tmp_path_factory.mktemp("rolled")
    source = shot_scenes.fading(folder)
    workspace = Workspace.create(folder / "rolling.dnr", Source(path=str(source), sha256=file_sha256(source)))
    settings = Settings.model_validate({"passes": {"bake_size": 256, "workers": 1}})
    run = Run(workspace, settings, Console(quiet=True), "raytrace", "raytrace-0")
    convert_scene(run)
    convert_frames(run, list(PLACES))
    return run


def _pixel(view: View, point: tuple[float, ...]) -> tuple[int, int]:
    """(row, column) in which a point of the world lies."""
    x, y, z = (np.linalg.inv(view.matrix) @ (*point, 1.0))[:3]
    return int(view.cy - view.fl_y * y / -z), int(view.cx + view.fl_x * x / -z)


def _traced(run: Run, bundle: Path, view: View) -> np.ndarray:
    """RGB [H, W, 3], linear."""
    choice = choose_variant()
    task = {"view": view.model_dump(mode="json"), "output": str(run.workspace.root / f"{view.name}.exr"), "spp": 16}
    task |= {"max_depth": 3, "seed": 1, "fingerprint": "f"}
    common = {"bundle": str(bundle), "variant": choice.variant, "threads": 1}
    module, environment = "dnrpipe.raytrace.tracer", choice.environment
    only_answer("trace", module, common, task, log=run.log, console=run.console, environment=environment)
    channels, _ = read_exr(Path(task["output"]))
    return np.stack([channels[name] for name in "RGB"], axis=-1)


def test_the_ball_is_where_it_has_rolled(rolled: Run) -> None:
    source = Path(rolled.workspace.manifest.source.path)
    views = shot_views(look_at_shot(source, list(PLACES), None, rolled.log), 64, 36)
    for frame, view in zip(PLACES, views, strict=True):
        picture = _traced(rolled, scene_at(rolled.workspace, frame) / "scene.xml", view)
        for where, place in PLACES.items():
            red, green, _ = picture[_pixel(view, place)]
            assert (red > 5 * green and red > 0.01) == (where == frame), (frame, where, red, green)


def test_bakes_serve_again_where_they_hold(rolled: Run) -> None:
    """Roughness and bumps by noise stick to the ball and are not baked again; the block's roughness has keys."""
    workspace = rolled.workspace
    files = sorted((workspace.root / "bakes").glob("*.npy"), key=lambda path: path.stat().st_mtime_ns)
    values = [np.load(path).astype(np.float32) for path in files]
    assert sorted(value.shape[1] for value in values[:3]) == [1, 1, 3]
    (now,) = values[3:]
    (before,) = (value for value in values[:3] if value.shape == now.shape)
    assert now == pytest.approx(0.1 * before, abs=1e-3)
    first, second = (scene_at(workspace, frame) / "textures" for frame in PLACES)
    own = {path.name for path in (workspace.scene / "textures").iterdir()}
    assert {path.name for path in first.iterdir()} == own != {path.name for path in second.iterdir()}


def test_objects_keep_their_numbers(rolled: Run) -> None:
    """Though at frame 5 an object has come that would have the first one; it has one of its own."""

    def numbers(folder: Path) -> dict[str, int]:
        found = {}
        for path in (folder / "meshes").glob("*.ply"):
            (number,) = np.unique(read_ply(path)[0]["atlas_z"])
            found[path.stem.split("-")[0]] = int(number)
        return found

    names = {name: int(number) for number, name in read_summary(rolled.workspace.scene).object_names.items()}
    assert names == {"ball": 1, "block": 2, "floor": 3}
    assert numbers(scene_at(rolled.workspace, 2)) == names
    assert numbers(scene_at(rolled.workspace, 5)) == {"ball": 1, "block": 2, "arch": 4}


def test_what_comes_in_different_frames_has_different_numbers() -> None:
    def mesh(name: str, number: int = 0) -> FrozenMesh:
        corners = np.eye(3, dtype=np.float32)
        return FrozenMesh(name, name, number, corners, corners, np.zeros(1, np.int32), [None])

    earlier = Earlier([mesh("ball", 1), mesh("floor", 2)])
    frames = [[mesh("ball"), mesh("arch")], [mesh("ball"), mesh("tower"), mesh("not in the file")]]
    for meshes in frames:
        earlier.take_numbers(meshes, ["arch", "ball", "floor", "tower"])
    assert [[mesh.object_id for mesh in meshes] for meshes in frames] == [[1, 3], [1, 4, 5]]


def test_a_frame_like_the_converted_one_has_its_bundle(rolled: Run) -> None:
    own, frame = rolled.workspace.scene, scene_at(rolled.workspace, 2)
    files = [path.relative_to(frame) for path in frame.rglob("*") if path.is_file() and path.name != "prepared.json"]
    assert len(files) == 6 and all((own / name).read_bytes() == (frame / name).read_bytes() for name in files)


def test_frames_that_are_there_are_not_converted_again(rolled: Run) -> None:
    path = scene_at(rolled.workspace, 5) / "scene.xml"
    before = path.stat().st_mtime_ns
    convert_frames(rolled, [5])
    assert path.stat().st_mtime_ns == before

"""`dnrpipe export-nerf`: read back as the readers do, without our own code for cameras."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from e2e_harness import image, run

from dnrpipe.cli import _main
from dnrtrain.contract import read_cameras
from dnrtrain.exr import read_exr

pytestmark = [pytest.mark.slow, pytest.mark.e2e]


@pytest.fixture(scope="module")
def exported(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("nerf") / "out"
    answer = json.loads(run("export-nerf", str(tiny), "--out", str(out), "--json", folder=tiny.parent).stdout)
    assert (answer["train"], answer["test"]) == (3, 2)
    return out


def _frames(folder: Path, split: str) -> tuple[dict, list[dict]]:
    data = json.loads((folder / f"transforms_{split}.json").read_text())
    return data, data["frames"]


def _surface(workspace: Path, split: str, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels that show a surface, and where that is in the world, [4, P]: by the passes, else by the base image."""
    passes = workspace / "passes" / split / f"{name}.exr"
    surface, _ = read_exr(passes if passes.exists() else workspace / "base" / split / f"{name}.exr")
    row, column = np.nonzero(surface["mask"] > 0.5)
    if passes.exists():
        points = np.stack([surface[f"position.{c}"][row, column] for c in "XYZ"])
    else:
        view = next(v for v in read_cameras(workspace / "cameras" / f"{split}.json") if v.name == name)
        rays = view.ray_directions()[row, column].T
        points = view.position[:, None] + rays * surface["depth.Z"][row, column] / -(view.matrix[:3, 2] @ rays)
    return row, column, np.concatenate([points, np.ones((1, len(row)))])


@pytest.mark.parametrize("split", ["train", "test"])
def test_points_of_the_surface_fall_on_their_pixels(tiny: Path, exported: Path, split: str) -> None:
    """As NeRF-Synthetic's readers do it: focal length from camera_angle_x, centre of the picture, OpenGL's axes."""
    data, frames = _frames(exported, split)
    assert {Path(frame["file_path"]).name for frame in frames} == {
        path.stem for path in (tiny / "raytraced" / split).glob("*.exr")
    }
    for frame in frames:
        picture = image(exported / (frame["file_path"].replace("./", "") + ".png"))
        height, width = picture.shape[:2]
        assert picture.shape[2] == 4
        focal = 0.5 * width / math.tan(0.5 * data["camera_angle_x"])
        row, column, world = _surface(tiny, split, Path(frame["file_path"]).name)
        x, y, z, _ = np.linalg.inv(np.array(frame["transform_matrix"])) @ world
        assert (z < 0).all()
        assert np.abs(focal * x / -z + width / 2 - (column + 0.5)).max() < 0.01
        assert np.abs(-focal * y / -z + height / 2 - (row + 0.5)).max() < 0.01
        assert len(row) > 100


def test_pictures_are_the_ray_traced_views_over_any_background(tiny: Path, exported: Path) -> None:
    """Straight alpha in display space: over white they are what evaluation compares with."""
    for path in (exported / "images" / "test").glob("*.png"):
        rgba = image(path)
        white = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
        assert np.abs(white - image(tiny / "evaluation" / f"{path.stem}.truth.png")).max() < 2.5 / 255
        assert 0.05 < (rgba[..., 3] > 0.5).mean() < 0.95


def test_nerfstudio_finds_every_file_and_split(exported: Path) -> None:
    data = json.loads((exported / "transforms.json").read_text())
    paths = [frame["file_path"] for frame in data["frames"]]
    assert all((exported / path).is_file() for path in [*paths, data["ply_file_path"]])
    assert set(data["train_filenames"]) | set(data["test_filenames"]) == set(paths)
    assert not set(data["train_filenames"]) & set(data["test_filenames"])
    assert data["w"] == data["h"] == 64


def test_our_own_cameras_option_reads_it(tiny: Path, exported: Path) -> None:
    """The same rays as the workspace's own cameras."""
    ours = {view.name: view for view in read_cameras(tiny / "cameras" / "test.json")}
    for view in read_cameras(exported / "transforms_test.json"):
        assert np.allclose(view.ray_directions(), ours[view.name].ray_directions(), atol=1e-6)
        assert np.allclose(view.position, ours[view.name].position)


def test_points_lie_on_the_surface_and_have_its_colours(tiny: Path, exported: Path) -> None:
    raw = (exported / "points3d.ply").read_bytes()
    head, body = raw.split(b"end_header\n", 1)
    count = int(head.split(b"element vertex ")[1].split()[0])
    names = [line.split()[-1].decode() for line in head.splitlines() if line.startswith(b"property")]
    table = np.frombuffer(body, [(name, "<f4" if len(name) < 3 else "u1") for name in names])
    assert len(table) == count > 300
    bounds = json.loads((tiny / "scene" / "summary.json").read_text())["bounds"]
    for i, axis in enumerate("xyz"):
        assert table[axis].min() >= bounds["min"][i] - 1e-3 and table[axis].max() <= bounds["max"][i] + 1e-3
    assert table["red"].std() > 5


def test_normalised_scene_is_in_the_unit_sphere(tiny: Path, tmp_path: Path) -> None:
    assert _main(["export-nerf", str(tiny), "--out", str(tmp_path / "u"), "--normalise"]) == 0
    frame = json.loads((tiny / "scene" / "frame.json").read_text())
    data, frames = _frames(tmp_path / "u", "test")
    ours = {view.name: view for view in read_cameras(tiny / "cameras" / "test.json")}
    for entry in frames:
        place = np.array(entry["transform_matrix"])[:3, 3] * frame["radius"] + frame["center"]
        assert np.allclose(place, ours[Path(entry["file_path"]).name].position)
    assert math.isclose(data["dnrpipe"]["scale"], 1 / frame["radius"])


def test_folders_of_the_user_are_left_alone(
    tiny: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    for target, words in ((tmp_path / "mine", "not empty"), (tmp_path / "mine" / "thesis.txt", "is a file")):
        assert _main(["export-nerf", str(tiny), "--out", str(target)]) == 2
        said = capsys.readouterr().err
        assert words in said and len(said.splitlines()) == 1
    stale = exported / "images" / "train" / "gone.png"
    stale.write_bytes(b"")
    marker = exported / ".dnrpipe-export"
    marker.write_text(marker.read_text() + "images/train/gone.png\n")
    assert _main(["export-nerf", str(tiny), "--out", str(exported)]) == 0
    assert not stale.exists() and (tmp_path / "mine" / "thesis.txt").read_text() == "x"

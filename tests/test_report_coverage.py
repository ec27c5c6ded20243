"""The report's maps on the atlas, against a scene where one knows what is seen."""

from __future__ import annotations

import base64
import io
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent / "trainer"))
import synthetic

from dnrpipe.report.coverage import UNSEEN, coverage_maps


def pixels(uri: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.split(",", 1)[1]))).convert("RGBA"))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory):
    root = tmp_path_factory.mktemp("covered")
    views = synthetic.dome(8, 32)
    files, _ = synthetic.write_scene(root, views)
    folder = root / "passes" / "train"
    folder.mkdir(parents=True)
    for file, view in zip(files, views, strict=True):
        file.rename(folder / f"{view.name}.exr")
    return root, views


def test_all_chosen_leaves_nothing_uncovered(scene) -> None:
    root, views = scene
    maps = coverage_maps(root, views, [view.name for view in views])
    assert maps is not None and maps.uncovered == 0.0 and maps.mean_angle < 1.0
    assert maps.most <= len(views) and maps.views_read == len(views)
    seen = pixels(maps.seen.uri)
    assert not (seen[..., :3] == UNSEEN).all(axis=-1).any()
    assert 0 < (seen[..., 3] > 0).mean() < 1  # the atlas is not full


def test_one_chosen_view_leaves_red_and_far_off_surface(scene) -> None:
    root, views = scene
    one = coverage_maps(root, views, [views[0].name])
    two = coverage_maps(root, views, [views[0].name, views[4].name])
    assert one is not None and two is not None and one.most == 1
    assert 0.0 < two.uncovered < one.uncovered < 1.0
    red = [(pixels(maps.seen.uri)[..., :3] == UNSEEN).all(axis=-1).mean() for maps in (one, two)]
    assert red[0] > red[1] > 0.0
    assert two.mean_angle < one.mean_angle


def test_v_points_up(scene) -> None:
    """What lies at high V is drawn in the upper half."""
    from dnrtrain.exr import read_exr

    root, views = scene
    there = np.zeros((64, 64), bool)
    for view in views:
        channels, _ = read_exr(root / "passes" / "train" / f"{view.name}.exr")
        hit = channels["mask"] > 0.5
        there[(channels["uv.V"][hit] * 64).astype(int), (channels["uv.U"][hit] * 64).astype(int)] = True
    maps = coverage_maps(root, views, [views[0].name])
    assert maps is not None
    assert (there != there[::-1]).any()
    assert ((pixels(maps.seen.uri)[2::4, 2::4, 3] > 0) == there[::-1]).all()


def test_absent_where_passes_are_not_there(scene, tmp_path: Path) -> None:
    _, views = scene
    assert coverage_maps(tmp_path, views, [views[0].name]) is None
    assert coverage_maps(tmp_path, views[1:], [views[0].name]) is None

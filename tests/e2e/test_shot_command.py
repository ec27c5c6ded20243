"""`dnrpipe shot` as a user runs it: frames with their layers, what moves by name, an interruption, bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from e2e_harness import image, run

pytest.importorskip("bpy")

from tests import shot_scenes

from dnrpipe.core.scene_files import read_summary
from dnrpipe.stages.shots.frame_tasks import LAYERS
from dnrtrain.exr import read_exr, read_metadata

pytestmark = [pytest.mark.slow, pytest.mark.e2e]


def test_a_ball_rolls_and_the_frames_are_right(tmp_path: Path) -> None:
    scene = shot_scenes.rolling(tmp_path)
    light = ("--set", "base.light_size=256", "--set", "base.light_spp=32")
    words = ("shot", str(scene), "--frames", "1-5", "--size", "48x27", "--way", "neural", *light)
    told = run(*words, folder=tmp_path).stdout
    assert "ball moves in frames 3-5: path-traced there" in told
    shot = tmp_path / "rolling.shot.dnr" / "shots" / "wide"
    record = json.loads((shot / "shot.json").read_text())
    assert record["moving_frames"] == [3, 4, 5] and list(record["moving"]) == ["ball"]
    assert record["still_way"]["name"] == "neural" and record["moving_way"]["name"] == "path"
    assert record["check"]["psnr"] > 30 and (shot / "wide.mp4").stat().st_size > 0
    ways = [(read_metadata(path) or {})["way"] for path in sorted((shot / "frames").glob("*.exr"))]
    assert ways == ["neural", "neural", "path", "path", "path"]

    first, _ = read_exr(shot / "frames" / "00001.exr")
    last, _ = read_exr(shot / "frames" / "00005.exr")
    assert set(first) == set(last) == set(LAYERS)
    names = read_summary(tmp_path / "rolling.shot.dnr" / "scene").object_names
    ball = next(int(number) for number, name in names.items() if name == "ball")
    columns = [np.flatnonzero((layers["object.Id"] == ball).any(axis=0)).mean() for layers in (first, last)]
    assert columns[1] > columns[0] + 4  # it rolled to the right
    shown = image(shot / "pictures" / "00005.png")
    inside = last["object.Id"] == ball
    assert shown[inside, 0].mean() > 2 * shown[inside, 2].mean()  # red, where the frame's numbers say that it is

    before = {path.name: path.stat().st_mtime_ns for path in (shot / "frames").glob("*.exr")}
    second, _ = read_exr(shot / "frames" / "00002.exr")
    (shot / "frames" / "00002.exr").unlink()
    for name in ("00003.png", "00004.png"):  # of frames with moving things one that is not checked, and one that is
        (shot / "pictures" / name).unlink()
    pixels = first["R"]
    answer = json.loads(run(*words, "--json", folder=tmp_path).stdout)
    assert answer["chosen"]["way"]["name"] == "neural" and answer["check"]["frames"] == record["check"]["frames"]
    after = {path.name: path.stat().st_mtime_ns for path in (shot / "frames").glob("*.exr")}
    assert {name for name in before if after[name] != before[name]} == {"00002.exr", "00003.exr", "00004.exr"}
    np.testing.assert_array_equal(read_exr(shot / "frames" / "00001.exr")[0]["R"], pixels)
    # Rendered while the first was written, or by itself.
    np.testing.assert_array_equal(read_exr(shot / "frames" / "00002.exr")[0]["R"], second["R"])


@pytest.mark.robustness
@pytest.mark.parametrize(("size", "gib"), [("1920x1080", 4), ("3840x2160", 8.5)], ids=["1920x1080", "3840x2160"])
def test_large_frames_fit_in_memory(tmp_path: Path, size: str, gib: float) -> None:
    """Base image, network and files of a frame, the frame next to it, and the path-traced ones of the check."""
    scene = shot_scenes.rolling(tmp_path)
    words = ("shot", str(scene), "--frames", "1-2", "--size", size, "--way", "neural", "--set", "base.light_size=2048")
    answer = json.loads(run(*words, "--json", folder=tmp_path).stdout)
    assert answer["check"]["psnr"] > 30
    rows = [json.loads(line) for line in (tmp_path / "rolling.shot.dnr" / "costs.jsonl").read_text().splitlines()]
    peaks = {row["name"]: row["peak_mb"] for row in rows if row.get("width") == int(size.split("x")[0])}
    assert {"frames/frame00001"} <= set(peaks) and max(peaks.values()) < 1024 * gib, peaks


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--size", "10"), "--size 10: expected WIDTHxHEIGHT"),
        (("--frames", "5-1"), "--frames 5-1"),
        (("--camera", "nobody"), "nobody"),
        (("--target-psnr", "nan"), "--target-psnr nan: expected a number above 0"),
        (("--target-lpips", "-1"), "--target-lpips -1: expected"),
        (("--time", "5m", "--target-psnr", "30"), "give --time or a target"),
    ],
)
def test_bad_input_is_told_in_one_line(tmp_path: Path, words: tuple[str, ...], told: str) -> None:
    scene = shot_scenes.rolling(tmp_path)
    done = run("shot", str(scene), *words, folder=tmp_path, check=False)
    assert done.returncode == 2 and told in done.stderr and "Traceback" not in done.stderr

"""dnrpipe frontier: accounts, the front, break-even, words and plots; and the whole of it, small."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dnrpipe.core.errors import UserError
from dnrpipe.core.settings import resolve
from dnrpipe.studies.frontier.frontier_report import markdown, verdict
from dnrpipe.studies.frontier.measure_frontier import Sweep, numbers
from dnrpipe.studies.frontier.point_costs import break_evens, pareto, settle_frames, total_seconds
from dnrpipe.studies.frontier.records import BaselinePoint, FrontierResults, Point, read_frontier


def point(name: str, upfront: float, frame_ms: float, psnr: float, kind: Any = "ours") -> Point:
    return Point(
        name=name,
        kind=kind,
        views=6,
        spp=16,
        steps=150,
        upfront=upfront,
        frame_ms=frame_ms,
        psnr=psnr,
        ssim=psnr / 40,
        lpips_vgg=1 / psnr,
        flip=None,
    )


def baseline(spp: int, ms: float, psnr: float, denoised: bool) -> BaselinePoint:
    name = f"{spp} spp {'clean16' if denoised else 'raw'}"
    metrics: dict[str, Any] = {"psnr": psnr, "ssim": psnr / 40, "lpips_vgg": 1 / psnr, "flip": None}
    return BaselinePoint(name=name, spp=spp, denoised=denoised, ms=ms, **metrics)


BASELINES = [
    baseline(1, 10, 18, False),
    baseline(4, 100, 28, True),
    baseline(16, 200, 30, True),
    baseline(64, 800, 33, True),
]


def results() -> FrontierResults:
    points = [point("small", 30.0, 50.0, 29.0), point("large", 90.0, 50.0, 31.0), point("poor", 95.0, 50.0, 28.0)]
    points.append(point("base image alone", 10.0, 40.0, 27.0, "base"))
    return FrontierResults(
        schema_version=1, scene="toy", resolution="64x64", command="dnrpipe frontier", commit=None, date="2026-11-22",
        machine={"processor": "x"}, cores=2, test_views=3, evaluation_spp=64, frames=[1, 2000],
        points=break_evens(points, BASELINES), baselines=BASELINES,
    )  # fmt: skip


def front(found: FrontierResults, frames: int, metric: Any = "psnr") -> list[str]:
    return pareto(found.everything.values(), frames, metric)


def test_a_file_has_the_keys_that_it_always_had_and_reads_back(tmp_path: Path) -> None:
    found = results()
    data = found.data()
    assert {"schema", "points", "rungs"} <= data.keys() and "baselines" not in data
    assert {"rival_ms", "break_even", "upfront", "frame_ms"} <= data["points"][0].keys()
    assert data["rungs"][0]["ms"] == 10 and "masked" not in data["rungs"][0]
    (tmp_path / "results.json").write_text(json.dumps(data))
    assert read_frontier(tmp_path / "results.json") == found
    (tmp_path / "results.json").write_text(json.dumps(data | {"points": [{"name": "x"}]}))
    with pytest.raises(UserError, match="damaged"):
        read_frontier(tmp_path / "results.json")


def test_few_frames_are_path_traced_and_many_are_neural() -> None:
    found = results()
    assert not {"small", "large"} & set(front(found, 1)[:3])
    assert "small" in front(found, 2000)
    assert "poor" not in front(found, 2000)
    assert "Do not train" in verdict(found, 1)
    assert "Do not train" not in verdict(found, 2000)


@given(st.floats(1.0, 500.0), st.floats(1.0, 300.0), st.floats(18.0, 33.0))
def test_from_the_break_even_on_training_is_cheaper_at_equal_quality(upfront: float, ms: float, psnr: float) -> None:
    one = point("x", upfront, ms, psnr)
    (one,) = break_evens([one], BASELINES)
    traced, even = one.baseline_ms, one.break_even
    assert traced is not None
    if even is None:
        assert traced <= ms
        return
    assert total_seconds(one, even) <= even * traced / 1000 + 1e-6
    if even > 1:
        assert total_seconds(one, even - 1) > (even - 1) * traced / 1000 - 1e-6


def test_points_of_one_model_share_its_least_disturbed_frame() -> None:
    points = [
        point(kind, 1.0, 0.0, 30.0, kind).model_copy(update={"network_ms": network, "base_ms": base})
        for kind, network, base in (
            ("ours", 14.0, 50.0),
            ("all", 90.0, 50.0),
            ("paper", 20.0, 0.0),
            ("base", 0.0, 50.0),
        )
    ]
    assert [point.frame_ms for point in settle_frames(points)] == [64.0, 64.0, 20.0, 50.0]


def test_a_point_beyond_all_baselines_has_no_break_even() -> None:
    (one,) = break_evens([point("x", 1.0, 1.0, 40.0)], BASELINES)
    assert one.baseline_ms is None
    assert one.break_even is None


def test_the_front_of_a_metric_where_lower_is_better_is_turned_round() -> None:
    found = results()
    assert front(found, 2000, "lpips_vgg") == front(found, 2000, "psnr")
    assert front(found, 2000, "flip") == []


def test_the_report_names_front_rivals_and_break_even() -> None:
    text = markdown(results())
    assert "## 2000 frames" in text
    assert "| large | 6 | 16 | 150 | 90.0 | 50.0 | 31.00 |" in text
    assert "N* = upfront" in text


def test_sweeps_have_a_row_of_every_combination_and_the_rivals() -> None:
    settings = resolve("draft", {}, environment={})
    rows = Sweep((6, 25), (16, 128), (150, 600)).rows(settings)
    ours = [row for row in rows if row.changes.get("select") == {"policy": "farthest"} and not row.everything]
    assert len(ours) == 8
    assert {(row.budget, row.spp) for row in ours} == {(6, 16), (6, 128), (25, 16), (25, 128)}
    epochs = {row.budget: row.changes["finetune"]["step2"]["epochs"] for row in ours if "600 steps" in row.name}
    assert epochs == {6: 100, 25: 24}
    assert {"all candidates", "paper", "base image alone", "6 random views"} <= {row.name for row in rows}
    assert len(Sweep((6,), (16,), (150,), ()).rows(settings)) == 2  # that one, and the base image


def test_lists_of_numbers() -> None:
    assert numbers("25,6,6", "--budgets", (1,), 40) == (6, 25)
    assert numbers(None, "--budgets", (6, 12, 25), 10) == (6, 10)
    for text in ("", "0", "a", "-1", "41", "1.5"):
        with pytest.raises(UserError, match="--budgets"):
            numbers(text, "--budgets", (6,), 40)


@pytest.mark.robustness
def test_a_scene_is_swept_and_measured_once(
    tmp_path: Path, demo_blend: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from dnrpipe.cli import _main
    from dnrtrain.exr import read_exr

    monkeypatch.chdir(tmp_path)
    (tmp_path / "dnrpipe.toml").write_text(
        "cameras = {train = 6, val = 0, test = 2, width = 32, height = 32}\n"
        'passes = {raster = "cycles-direct", coverage_samples = 16, bake_size = 64}\n'
        "raytrace = {spp = 8, evaluation_spp = 16, evaluation_baseline = false, max_depth = 3}\n"
        "base = {light_size = 32, light_spp = 4, samples = 1}\n"
        "model = {texture_size = 32, width = 8, depth = 2}\n"
        'finetune = {step2 = {epochs = 2, start = "fresh"}}\n'
    )
    arguments = [
        "--budgets",
        "2,3",
        "--spp",
        "4,8",
        "--iterations",
        "6",
        "--also",
        "random,all,cycles",
        "--ladder",
        "1,4",
    ]
    arguments += ["--frames", "10,100", "--jobs", "1"]
    assert _main(["frontier", str(demo_blend), *arguments, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    folder = tmp_path / "demo.dnr" / "frontier"
    kinds = [one["kind"] for one in found["points"]]
    assert kinds.count("ours") == 4
    assert {"random", "all", "base"} <= set(kinds)
    assert all(one["upfront"] > 0 for one in found["points"])
    assert {one["views"] for one in found["points"] if one["kind"] == "all"} == {6}
    cycles = {rung["name"]: rung for rung in found["rungs"] if rung["name"].startswith("Cycles")}
    assert len(found["rungs"]) == 8 + len(cycles)
    assert set(cycles) == {f"Cycles {n} spp {how}" for n in (1, 4) for how in ("raw", "denoised-fast", "denoised")}
    assert all(rung["ms"] > 0 for rung in cycles.values())
    # Against 16 samples of its own: more samples and the denoiser both help.
    assert cycles["Cycles 4 spp raw"]["psnr"] > cycles["Cycles 1 spp raw"]["psnr"] > 12
    assert cycles["Cycles 1 spp denoised"]["psnr"] > cycles["Cycles 1 spp raw"]["psnr"]
    assert all(np.isfinite(one["psnr"]) for one in [*found["points"], *found["rungs"]])
    rows = list(csv.DictReader((folder / "results.csv").open()))
    assert len(rows) == len(found["points"]) + len(found["rungs"])
    assert {(folder / f"frontier-{n}.png").exists() for n in (10, 100)} == {True}
    cells = {path: path.stat().st_mtime_ns for path in (folder / "cells").rglob("*.json")}
    few, _ = read_exr(tmp_path / "demo.dnr" / "raytraced" / "train-4spp" / _name(tmp_path))
    many, _ = read_exr(tmp_path / "demo.dnr" / "raytraced" / "train" / _name(tmp_path))
    assert not np.array_equal(few["R"], many["R"])
    assert _main(["frontier", *arguments, "-q"]) == 0
    assert cells == {path: path.stat().st_mtime_ns for path in (folder / "cells").rglob("*.json")}
    assert _main(["report", "-q"]) == 0
    assert "Quality against seconds" in (tmp_path / "demo.dnr" / "report" / "report.html").read_text()


def _name(folder: Path) -> str:
    return sorted(path.name for path in (folder / "demo.dnr" / "raytraced" / "train-4spp").glob("*.exr"))[0]

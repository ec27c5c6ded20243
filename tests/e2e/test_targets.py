"""Ray tracing to a noise level and within a time, from the command line: reached, kept, resumed, told."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from e2e_harness import command, environment, run

from dnrpipe.core.ledger import Ledger, traced_views
from dnrtrain.exr import read_exr, read_metadata

pytestmark = [pytest.mark.slow, pytest.mark.e2e]


@pytest.fixture
def copy(tiny: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiny, tmp_path / "demo.dnr"))


def _views(workspace: Path, split: str = "train") -> dict[str, dict]:
    return {path.stem: read_metadata(path) or {} for path in sorted((workspace / "raytraced" / split).glob("*.exr"))}


def _pixels(workspace: Path) -> dict[str, bytes]:
    folder = workspace / "raytraced" / "train"
    return {path.name: np.stack(list(read_exr(path)[0].values())).tobytes() for path in sorted(folder.glob("*.exr"))}


def test_a_noise_target_is_reached_kept_and_deepened(copy: Path) -> None:
    """Killed on the way and run again: the same pixels; then lower noise from the same samples, and back to a count."""
    whole = copy.with_name("whole.dnr")
    shutil.copytree(copy, whole)
    said = run("raytrace-selected", "--noise", "4%", folder=whole).stdout
    assert "before the denoiser" in said
    process = subprocess.Popen(
        command("raytrace-selected", "--noise", "4%", "-w", str(copy), "--quiet"),
        cwd=copy.parent,
        env=environment(),
        stderr=subprocess.DEVNULL,
    )
    samples = copy / "raytraced" / "train" / "samples"
    while process.poll() is None and not list(samples.glob("[!.]*.npz")):
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert list(samples.glob("[!.]*.npz"))
    run("raytrace-selected", "--noise", "4%", folder=copy)
    assert _pixels(copy) == _pixels(whole)
    views = _views(copy)
    assert all(view["noise_target"] == 0.04 and view["ended_by"] == "target" for view in views.values())
    assert all(view["raw_noise"] + view["raw_noise_error"] <= 0.04 for view in views.values())
    assert "up to date" in run("raytrace-selected", folder=copy).stdout

    booked = Ledger(copy / "costs.jsonl")
    before = {record.name: record.seconds for record in traced_views(booked.read(), "training")}
    run("raytrace-selected", "--noise", "2.5%", folder=copy)
    deeper = _views(copy)
    assert all(deeper[name]["spp"] > views[name]["spp"] for name in views)
    assert all(deeper[name]["seconds"] > views[name]["seconds"] for name in views)
    records = {record.name: record for record in traced_views(booked.read(), "training")}
    for name, view in deeper.items():
        record = records[f"train/{name}"]
        assert record.spp == view["spp"]
        assert record.detail["raw_noise"] == view["raw_noise"]
        assert before[f"train/{name}"] < record.seconds == pytest.approx(view["seconds"], rel=1e-6)

    run("raytrace-selected", "--spp", "32", folder=copy)
    assert {view["spp"] for view in _views(copy).values()} == {32}
    assert all("ended_by" not in view for view in _views(copy).values())


def test_a_time_is_shared_over_the_views(copy: Path) -> None:
    """All views are traced, none past the time by much; a limit that is too low for a target is told."""
    done = run("raytrace-selected", "--time", "12s", "--json", folder=copy)
    assert json.loads(done.stdout)["raytrace"]["ran"]
    views = _views(copy)
    assert all(view["ended_by"] == "time" and view["spp"] >= 24 for view in views.values())
    run_id = Ledger(copy / "costs.jsonl").read()[-1].run
    records = [r for r in Ledger(copy / "costs.jsonl").read() if r.run == run_id and r.spp and r.unit == "view"]
    assert sum(record.wall_seconds for record in records) <= 1.1 * 12
    capped = run("raytrace-selected", "--noise", "0.1%", "--spp", "48", folder=copy)
    assert "raise raytrace.max_spp" in capped.stderr
    assert all(view["ended_by"] == "limit" for view in _views(copy).values())


def test_references_to_a_noise_level_and_the_ceiling_they_set(copy: Path) -> None:
    said = run("evaluate", "--set", "raytrace.evaluation_noise=3%", folder=copy).stdout
    metrics = json.loads((copy / "evaluation" / "metrics.json").read_text())
    assert metrics["reference_noise_target"] == 0.03
    for row in metrics["views"]:
        traced = _views(copy, "test")[row["name"]]
        assert traced["raw_noise"] <= 0.03
        assert row["reference_noise"] == traced["noise"]
        assert row["ceiling_psnr"] == pytest.approx(-20 * np.log10(traced["noise_rmse"]))
    assert f"(ceiling {metrics['mean']['ceiling_psnr']:.1f} dB)" in said
    assert "up to date" in run("evaluate", folder=copy).stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--time", "soon"], "--time soon: expected a time above 0, e.g. 90s"),
        (["--set", "raytrace.noise=much"], "raytrace.noise"),
    ],
)
def test_bad_targets_are_one_line_and_change_nothing(tiny: Path, arguments: list[str], words: str) -> None:
    before = (tiny / "manifest.json").read_bytes()
    done = run("raytrace-selected", *arguments, folder=tiny, check=False)
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert (tiny / "manifest.json").read_bytes() == before

"""``--budget 0``: frames from the shipped corrector, without a traced view and without training."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from e2e_harness import image, run

from dnrpipe.stages.worth import views_worth
from dnrtrain.checkpoint import load_model, read_record

pytestmark = [pytest.mark.slow, pytest.mark.e2e]


def test_no_view_is_selected_and_frames_come_out(tiny: Path, tmp_path: Path) -> None:
    workspace = tmp_path / "demo.dnr"
    shutil.copytree(tiny, workspace)
    for folder in ("passes", "raytraced", "base", "checkpoints", "renders", "evaluation"):
        shutil.rmtree(workspace / folder, ignore_errors=True)
    (workspace / "selection.json").unlink()
    manifest = json.loads((workspace / "manifest.json").read_text())
    manifest["stages"] = {}
    (workspace / "manifest.json").write_text(json.dumps(manifest))
    baked = ["--set", "model.base=baked"]
    run("prepare", "--set", "select.budget=0", *baked, folder=tmp_path)
    assert not list((workspace / "passes").rglob("*.exr"))  # base images bring G-buffers of their own
    run("render", "--orbit", "2", "--movie", "none", folder=tmp_path)
    run("export-onnx", folder=tmp_path)
    assert len(list((workspace / "renders").rglob("frame_*.png"))) == 2 and (tmp_path / "demo.onnx").is_file()
    chosen = ["--set", "select.budget=2", "--set", "model.guides=camera"]
    run("select", *chosen, folder=tmp_path)  # passes are drawn now
    assert len(list((workspace / "passes" / "train").glob("*.exr"))) > 2
    refused = run("render", folder=tmp_path, check=False)
    assert refused.returncode == 2 and "raytrace-selected" in refused.stderr
    told = run("select", "--budget", "auto", folder=tmp_path).stdout
    selection = json.loads((workspace / "selection.json").read_text())
    found = selection["details"]["worth"]
    most = len(list((workspace / "passes" / "train").glob("*.exr")))
    assert len(selection["views"]) == found["views"] == views_worth(found["gain"], found["seconds"], 0.3 / 60, most)
    assert f"{found['gain']:+.2f} dB" in told and found["seconds"] > 0


def test_no_view_is_traced_and_frames_come_out(tiny: Path, tmp_path: Path) -> None:
    workspace = tmp_path / "demo.dnr"
    shutil.copytree(tiny, workspace)
    for folder in ("raytraced/train", "base", "checkpoints", "renders"):
        shutil.rmtree(workspace / folder, ignore_errors=True)
    refused = run("select", "--budget", "0", "--set", "model.base=path", folder=tmp_path, check=False)
    assert refused.returncode == 2 and "--set model.base=baked" in refused.stderr
    for stage in ("select", "raytrace-selected", "finetune", "evaluate"):
        run(stage, *(["--budget", "0", "--set", "model.base=baked"] if stage == "select" else []), folder=tmp_path)
    run("render", "--orbit", "2", "--movie", "none", folder=tmp_path)
    assert not (workspace / "raytraced" / "train").exists() and not (workspace / "checkpoints" / "step1").exists()
    record = read_record(workspace / "checkpoints" / "step2")
    assert record is not None and record.views == record.history == []
    assert load_model(workspace / "checkpoints" / "step2").settings.aggregator == "none"
    frames = sorted((workspace / "renders").rglob("frame_*.png"))
    assert len(frames) == 2 and all(image(path).std() > 0.05 for path in frames)
    trust = json.loads((workspace / "manifest.json").read_text())["stages"]["finetune"]["detail"]["trust"]
    base, ours = trust["psnr"]
    assert 0 <= trust["share"] <= 1 and 15 < base <= ours
    assert load_model(workspace / "checkpoints" / "step2").settings.trust == trust["share"]
    metrics = json.loads((workspace / "evaluation" / "metrics.json").read_text())
    assert metrics["mean"]["psnr"] > 20
    status = json.loads(run("status", "--json", folder=tmp_path).stdout)
    assert {row["state"] for row in status["stages"]} == {"done"}

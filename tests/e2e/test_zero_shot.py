"""``--budget 0``: frames from the shipped corrector, without a traced view and without training."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from e2e_harness import image, run

from dnrtrain.checkpoint import load_model, read_record

pytestmark = [pytest.mark.slow, pytest.mark.e2e]


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
    metrics = json.loads((workspace / "evaluation" / "metrics.json").read_text())
    assert metrics["mean"]["psnr"] > 20
    status = json.loads(run("status", "--json", folder=tmp_path).stdout)
    assert {row["state"] for row in status["stages"]} == {"done"}

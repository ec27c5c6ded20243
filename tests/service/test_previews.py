"""Pictures of a held-out view while `finetune` runs, as a job and on the command line."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image
from tests.service.harness import Server, empty_workspace

from dnrpipe.core.event_stream import VARIABLE
from dnrpipe.core.ledger import Ledger
from dnrpipe.service.client import Refused
from dnrpipe.service.models import JobRequest


def copy_of(server: Server, trained: str, name: str) -> Path:
    """The trained workspace under another name; its references are on disk."""
    target = server.root / f"{name}.dnr"
    shutil.copytree(server.root / f"{trained}.dnr", target, ignore=shutil.ignore_patterns("preview", ".lock*"))
    return target


def finetune(workspace: Path, *settings: str) -> tuple[list[dict[str, Any]], str]:
    """`dnrpipe finetune` of three epochs -> (its preview events, what it wrote to standard error)."""
    told = workspace.parent / f"{workspace.stem}.events"
    command = [sys.executable, "-m", "dnrpipe.cli", "finetune", "-w", str(workspace), "--set", "device=cpu"]
    for setting in ("finetune.step2.epochs=3", *settings):
        command += ["--set", setting]
    environment = {**os.environ, VARIABLE: str(told)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    events = [json.loads(line) for line in told.read_text().splitlines()]
    return [event for event in events if event["kind"] == "preview"], done.stderr


def weights(workspace: Path) -> str:
    return hashlib.sha256((workspace / "checkpoints" / "step2" / "model.safetensors").read_bytes()).hexdigest()


def image(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), np.float64) / 255


def test_of_a_job(server: Server, trained: str) -> None:
    """First and last epoch at least; beside it the reference that evaluation traced. Only a base image is rendered."""
    workspace = copy_of(server, trained, "shown")
    booked = len(Ledger(workspace / "costs.jsonl").read())
    with server.client() as client:
        with pytest.raises(Refused, match="no picture") as refused:
            client.preview("shown")
        assert refused.value.status == 404
        settings: dict[str, Any] = {"finetune.step2.epochs": 3}
        job = client.submit(JobRequest(command="finetune", workspace="shown", settings=settings))
        told = [event for event in client.events(job.id) if event.kind == "preview"]
        assert client.job(job.id).state == "done", client.log(job.id).text
        found = client.preview("shown")
    assert [event.data["epoch"] for event in told][:1] == [1] and told[-1].data["epoch"] == 3
    assert (found.split, found.epoch, found.epochs, found.truth) == ("test", 3, 3, True)
    assert found.psnr == told[-1].data["psnr"] and abs(found.time - told[-1].time) < 5
    assert told[-1].data["files"] == {"prediction": "preview/prediction.png", "truth": "preview/truth.png"}
    truth, prediction = (image(workspace / "preview" / f"{kind}.png") for kind in ("truth", "prediction"))
    np.testing.assert_array_equal(truth, image(workspace / "evaluation" / f"{found.view}.truth.png"))
    assert found.psnr == pytest.approx(-10 * np.log10(np.square(truth - prediction).mean()), abs=0.1)
    new = [r for r in Ledger(workspace / "costs.jsonl").read()[booked:] if r.unit == "view"]
    names = [f"base/test/{found.view}", *[f"preview/{found.view}"] * len(told)]
    assert [(r.name, r.stage, r.purpose) for r in new] == [(name, "finetune", "evaluation") for name in names]


@pytest.mark.robustness
def test_without_them_the_weights_are_the_same(server: Server, trained: str) -> None:
    """Whether a run shows pictures does not matter to what it makes, nor to whether it is up to date."""
    plain, shown = copy_of(server, trained, "plain"), copy_of(server, trained, "pictured")
    before = weights(plain)
    told, _ = finetune(plain, "finetune.preview_seconds=0", "finetune.step2.ema=0.9")
    assert told == [] and not (plain / "preview").exists()
    told, _ = finetune(shown, "finetune.preview_seconds=0.001", "finetune.step2.ema=0.9")
    assert len(told) >= 2
    assert weights(shown) == weights(plain) != before
    told, _ = finetune(plain, "finetune.preview_seconds=10", "finetune.step2.ema=0.9")
    assert told == []  # up to date


def test_first_of_all(server: Server, trained: str) -> None:
    """Nothing of evaluation's is made for it; without a reference there is no PSNR."""
    workspace = copy_of(server, trained, "early")
    for part in ("base/test", "raytraced/test", "preview"):
        shutil.rmtree(workspace / part, ignore_errors=True)
    booked = len(Ledger(workspace / "costs.jsonl").read())
    told, _ = finetune(workspace)
    assert [(e["split"], e["psnr"], list(e["files"])) for e in told] == [("test", None, ["prediction"])] * len(told)
    assert told and not (workspace / "preview" / "truth.png").exists()
    new = [r for r in Ledger(workspace / "costs.jsonl").read()[booked:] if r.name.startswith("base/")]
    assert [(r.name, r.stage, r.purpose) for r in new] == [(f"base/test/{told[0]['view']}", "finetune", "evaluation")]
    assert not (workspace / "base" / "test").exists()


def test_of_a_renderer_without_base_images(server: Server, trained: str) -> None:
    """As the preset ``paper`` has: views are made of the pass files, wherever base images would lie."""
    from dnrpipe.core.scene_files import split_views
    from dnrpipe.core.workspace import Workspace
    from dnrpipe.stages.trainer import load

    workspace = Workspace.open(server.root / f"{trained}.dnr")
    view = next(view for view in split_views(workspace)["train"] if workspace.raytraced("train", view.name).exists())
    nowhere = [workspace.preview / "base" / "nowhere.exr"]
    views = load(workspace, [view], "train", raytraced=True, base="none", base_files=nowhere)
    assert views.names == (view.name,) and views.tensors.base is None


def test_a_damaged_reference_costs_the_view_not_the_training(server: Server, trained: str) -> None:
    """It is evaluation's to repair; meanwhile a training view is shown, which is said."""
    workspace = copy_of(server, trained, "dented")
    (path,) = (workspace / "raytraced" / "test").glob("*.exr")
    data = bytearray(path.read_bytes())
    for place in range(len(data) - 400, len(data) - 100):
        data[place] ^= 0x5A
    path.write_bytes(data)
    told, errors = finetune(workspace)
    assert "cannot be shown" in errors and "training view" in errors
    assert [e["split"] for e in told] == ["train"] * len(told) and told[-1]["psnr"] is not None
    assert path.read_bytes() == bytes(data)


def test_what_is_not_a_picture(server: Server) -> None:
    empty_workspace(server.root, "odd")
    folder = server.root / "odd.dnr" / "preview"
    folder.mkdir()
    (folder / "preview.json").write_text('{"epoch": ')
    with server.client() as client, pytest.raises(Refused, match="damaged") as refused:
        client.preview("odd")
    assert refused.value.status == 409
    (folder / "truth.png").symlink_to("/etc/hostname")
    assert httpx.get(f"{server.url}/workspaces/odd/preview/truth").status_code == 404
    assert httpx.get(f"{server.url}/workspaces/odd/preview/flip").status_code == 422


def test_large_views_are_not_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Training goes by squares of them; the whole of one would want several times the memory."""

    from dnrpipe.core.console import Console
    from dnrpipe.core.settings import resolve
    from dnrpipe.core.workspace import Workspace
    from dnrpipe.stages.finetune import LivePicture
    from dnrpipe.stages.stage import Run

    large: Any = SimpleNamespace(size=(2048, 2048))
    empty_workspace(tmp_path, "large")
    workspace, settings = Workspace.open(tmp_path / "large.dnr"), resolve("draft", {}, environment={})
    picture = LivePicture(Run(workspace, settings, Console()), large)
    assert picture.preview is None and "more than 2.1 megapixels" in capsys.readouterr().out

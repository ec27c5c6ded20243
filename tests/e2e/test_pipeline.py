"""The whole way on the demo scene, tiny: what is traced, what is reused, what a kill costs."""

from __future__ import annotations

import json
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
from e2e_harness import STAGES, command, contents, environment, image, run

from dnrpipe.costs import Ledger

pytestmark = [pytest.mark.slow, pytest.mark.e2e]


def test_only_the_selected_views_are_traced(tiny: Path) -> None:
    """selection.json, the files and the ledger name the same views."""
    selected = json.loads((tiny / "selection.json").read_text())["views"]
    assert len(selected) == len(set(selected)) == 3
    files = {path.stem for path in (tiny / "raytraced" / "train").glob("*.exr")}
    traced = [r.name for r in Ledger(tiny / "costs.jsonl").read() if r.stage == "raytrace"]
    assert files == set(selected)
    assert sorted(traced) == sorted(f"train/{name}" for name in selected)


def test_evaluation_is_booked_apart(tiny: Path) -> None:
    records = Ledger(tiny / "costs.jsonl").read()
    assert {r.purpose for r in records if r.stage in ("select", "raytrace", "finetune")} == {"training"}
    assert {r.purpose for r in records if r.stage == "evaluate"} == {"evaluation"}
    assert {r.purpose for r in records if r.name.startswith("test/")} == {"evaluation"}


def test_running_again_does_nothing(tiny: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in tiny.rglob("*.exr")}
    started = time.monotonic()
    for stage in STAGES:
        assert "up to date" in run(stage, folder=tiny).stdout
    assert time.monotonic() - started < 10 * len(STAGES)
    assert {path: path.stat().st_mtime_ns for path in tiny.rglob("*.exr")} == before


def test_status_json_and_costs(tiny: Path) -> None:
    rows = json.loads(run("status", "--json", folder=tiny).stdout)["stages"]
    assert [row["state"] for row in rows] == ["done"] * 5
    costs = json.loads(run("costs", "--json", folder=tiny).stdout)
    assert costs["tracing_all"]["views"] == 3
    assert costs["tracing_all"]["candidates"] == 6
    assert "all would have cost" in run("costs", folder=tiny).stdout


def test_a_lost_file_is_made_again_and_nothing_else(tiny: Path, tmp_path: Path) -> None:
    copy = tmp_path / "demo.dnr"
    shutil.copytree(tiny, copy)
    expected = contents(copy)
    victim = sorted((copy / "raytraced" / "train").glob("*.exr"))[0]
    others = {p: p.stat().st_mtime_ns for p in copy.rglob("*.exr") if p != victim}
    victim.unlink()
    assert "partial" in run("status", folder=copy).stdout
    run("raytrace-selected", folder=copy)
    assert {p: p.stat().st_mtime_ns for p in copy.rglob("*.exr") if p != victim} == others
    assert contents(copy) == expected
    assert "up to date" in run("finetune", folder=copy).stdout


def test_a_larger_budget_traces_the_new_views_only(tiny: Path, tmp_path: Path) -> None:
    copy = tmp_path / "demo.dnr"
    shutil.copytree(tiny, copy)
    old = set(json.loads((copy / "selection.json").read_text())["views"])
    run("select", "--budget", "4", "--policy", "farthest", folder=copy)
    assert "stale" in run("status", folder=copy).stdout
    refused = run("evaluate", folder=copy, check=False)
    assert refused.returncode == 2
    assert "raytrace-selected" in refused.stderr
    before = len(Ledger(copy / "costs.jsonl").read())
    run("raytrace-selected", folder=copy)
    new = set(json.loads((copy / "selection.json").read_text())["views"])
    traced = [r.name for r in Ledger(copy / "costs.jsonl").read()[before:]]
    assert sorted(traced) == sorted(f"train/{name}" for name in new - old)


def test_novel_views(tiny: Path, tmp_path: Path) -> None:
    copy = tmp_path / "demo.dnr"
    shutil.copytree(tiny, copy)
    answer = json.loads(
        run("render", "--orbit", "4", "--frames", "both", "--movie", "webp", "--json", folder=copy).stdout
    )
    folder = Path(answer["folder"])
    pictures = [image(path) for path in sorted(folder.glob("frame_*.png"))]
    assert len(pictures) == len(list(folder.glob("frame_*.exr"))) == 4
    assert all(picture.shape == (64, 64, 3) for picture in pictures)
    assert pictures[0].std() > 0.05
    assert abs(pictures[0] - pictures[2]).mean() > 0.01
    assert Path(answer["movie"]).read_bytes()[8:12] == b"WEBP"
    run("render", "--orbit", "3", folder=copy)
    assert (copy / "renders" / "orbit-3" / "orbit-3.mp4").stat().st_size > 1000


@pytest.mark.parametrize("stage", STAGES)
def test_killed_anywhere_and_run_again_gives_the_same(stage: str, tiny: Path, tmp_path: Path, demo_blend: Path) -> None:
    """SIGKILL at random moments of each stage, then the rest: every pixel, weight and metric is the same."""
    expected = contents(tiny)
    seconds = json.loads((tiny / "manifest.json").read_text())["stages"]
    names = dict(zip(STAGES, ("prepare", "select", "raytrace", "finetune", "evaluate"), strict=True))
    copy = tmp_path / "demo.dnr"
    start = STAGES.index(stage)
    if start > 0:
        shutil.copytree(tiny, copy)
        for later in STAGES[start:]:
            _forget(copy, names[later])
    rng = random.Random(stage)
    arguments = ("prepare", str(demo_blend)) if stage == "prepare" else (stage,)
    for _ in range(3):
        process = subprocess.Popen(
            command(*arguments, "--quiet"), cwd=tmp_path, env=environment(), stderr=subprocess.DEVNULL
        )
        time.sleep(rng.uniform(0.3, 1.0) * (1.0 + seconds[names[stage]]["seconds"]))
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert not _torn(copy)
    run(*arguments, folder=tmp_path)
    for later in STAGES[start + 1 :]:
        run(later, folder=tmp_path)
    assert contents(copy) == expected


def _forget(workspace: Path, stage: str) -> None:
    """Bring a finished workspace back to before ``stage``."""
    from dnrpipe.stages import STAGES as ALL
    from dnrpipe.stages import clear
    from dnrpipe.workspace import Workspace

    clear(ALL[stage], Workspace.open(workspace))


def _torn(workspace: Path) -> list[Path]:
    """Files under their final name that do not read: there must be none at any moment."""
    from dnrtrain.contract import ContractError
    from dnrtrain.exr import read_exr

    torn = []
    for path in workspace.rglob("[!.]*"):
        try:
            if path.suffix == ".exr" and not path.is_relative_to(workspace / "scene"):
                read_exr(path)
            elif path.suffix == ".json":
                json.loads(path.read_text())
        except (ContractError, ValueError):
            torn.append(path)
    return torn


def test_interrupt_is_exit_code_130_and_resumable(tmp_path: Path, tiny: Path) -> None:
    copy = tmp_path / "demo.dnr"
    shutil.copytree(tiny, copy)
    for name in ("finetune", "evaluate"):
        _forget(copy, name)
    process = subprocess.Popen(
        command("finetune"), cwd=tmp_path, env=environment(), stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    time.sleep(4)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    if process.returncode == 0:
        pytest.skip("finetune was done before the interrupt came")
    assert process.returncode == 130
    assert "run the same command" in errors
    assert "Traceback" not in errors
    run("finetune", folder=tmp_path)

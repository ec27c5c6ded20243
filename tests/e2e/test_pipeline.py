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
from tools.faults.workspaces import forget, torn

from dnrpipe.core.ledger import Ledger
from dnrtrain.exr import read_exr

pytestmark = [pytest.mark.slow, pytest.mark.e2e]


def test_only_the_selected_views_are_traced(tiny: Path) -> None:
    """selection.json, the files and the ledger name the same views; depth pilot and baked light are booked apart."""
    selected = json.loads((tiny / "selection.json").read_text())["views"]
    assert len(selected) == len(set(selected)) == 3
    files = {path.stem for path in (tiny / "raytraced" / "train").glob("*.exr")}
    records = [r for r in Ledger(tiny / "costs.jsonl").read() if r.stage == "raytrace"]
    assert files == set(selected)
    expected = [f"{kind}train/{name}" for kind in ("", "base/") for name in selected]
    assert sorted(r.name for r in records if r.unit == "view") == sorted(expected)
    assert {path.stem for path in (tiny / "base" / "train").glob("*.exr")} == set(selected)
    assert [r.name for r in records if r.unit == "scene"] == ["path depth pilot", "light"]


def test_evaluation_is_booked_apart(tiny: Path) -> None:
    records = Ledger(tiny / "costs.jsonl").read()
    assert {r.purpose for r in records if r.stage in ("select", "raytrace")} == {"training"}
    shown = {
        (r.purpose, r.unit, r.name.partition(" ")[0]) for r in records if r.stage == "finetune" and r.unit != "overhead"
    }
    looked_at = {("evaluation", "view", name) for name in ("base/test/0001", "preview/0001")}  # and not needed
    assert shown == {("training", "epoch", "epoch"), *looked_at}
    assert {r.purpose for r in records if r.stage == "evaluate"} == {"evaluation"}
    assert {r.purpose for r in records if r.name.startswith("test/")} == {"evaluation"}


def test_the_ledger_explains_the_seconds_of_every_stage(tiny: Path) -> None:
    """And most of them by name: what no step accounts for is a small part of a run."""
    stages = json.loads((tiny / "manifest.json").read_text())["stages"]
    records = Ledger(tiny / "costs.jsonl").read()
    for name, stage in stages.items():
        of_run = {r.run for r in records if r.stage == name}
        assert len(of_run) == 1
        booked = sum(r.wall_seconds for r in records if r.stage == name)
        assert 0.95 * stage["seconds"] - 0.05 <= booked <= 1.05 * stage["seconds"] + 0.05, name
    rest = sum(r.wall_seconds for r in records if r.name == "everything else")
    assert rest < 0.35 * sum(stage["seconds"] for stage in stages.values())
    # The engine of rasterised colour, which a timing chose, is told with every result.
    engine = stages["prepare"]["detail"]["raster_engine"]
    assert engine and json.loads((tiny / "evaluation" / "metrics.json").read_text())["raster_engine"] == engine


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
    traced = [r.name for r in Ledger(copy / "costs.jsonl").read()[before:] if r.unit == "view"]
    assert sorted(traced) == sorted(f"{kind}train/{name}" for kind in ("", "base/") for name in new - old)


@pytest.mark.robustness
def test_going_back_after_an_interrupted_change_is_not_up_to_date(tiny: Path, tmp_path: Path) -> None:
    """A run with other samples overwrites one view and is killed; the old samples must come back."""
    copy = tmp_path / "demo.dnr"
    shutil.copytree(tiny, copy)
    expected = contents(copy)
    before = {path: path.stat().st_mtime_ns for path in (copy / "raytraced" / "train").glob("*.exr")}
    change = command("raytrace-selected", "--spp", "3000", "--set", "raytrace.workers=1", "--quiet")
    process = subprocess.Popen(change, cwd=tmp_path, env=environment(), stderr=subprocess.DEVNULL)
    for _ in range(600):
        time.sleep(0.1)
        if any(path.stat().st_mtime_ns != old for path, old in before.items()):
            break
    process.kill()
    process.wait()
    done = run("raytrace-selected", "--spp", "32", folder=tmp_path)
    assert "up to date" not in done.stdout
    assert contents(copy) == expected


def test_another_camera_file_makes_everything_after_it_stale(tiny: Path, tmp_path: Path, demo_blend: Path) -> None:
    copy = tmp_path / "demo.dnr"
    shutil.copytree(tiny, copy)
    cameras = tmp_path / "cameras.json"
    shutil.copy(copy / "cameras" / "train.json", cameras)
    run("prepare", str(demo_blend), "--cameras", str(cameras), "-w", str(copy), folder=tmp_path)
    run("select", "--budget", "2", "--policy", "farthest", folder=copy)
    data = json.loads(cameras.read_text())
    for frame in data["frames"]:
        frame["transform_matrix"][2][3] += 0.1
    cameras.write_text(json.dumps(data))
    run("prepare", str(demo_blend), "--cameras", str(cameras), "-w", str(copy), folder=tmp_path)
    states = {row["stage"]: row["state"] for row in json.loads(run("status", "--json", folder=copy).stdout)["stages"]}
    assert states["prepare"] == "done"
    assert states["select"] == states["raytrace"] == "stale"


def test_a_changed_texture_is_noticed(tmp_path: Path) -> None:
    """An OBJ whose texture file changes is converted again, and its passes are made again."""
    from PIL import Image

    (tmp_path / "square.obj").write_text(
        "mtllib square.mtl\nusemtl paint\nv 0 0 0\nv 1 0 0\nv 1 1 0.3\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\n"
    )
    (tmp_path / "square.mtl").write_text("newmtl paint\nmap_Kd paint.png\n")
    means = []
    for colour in ((200, 30, 30), (30, 30, 200)):
        Image.new("RGB", (8, 8), colour).save(tmp_path / "paint.png")
        done = run("prepare", "square.obj", folder=tmp_path)
        assert "up to date" not in done.stdout
        channels, _ = read_exr(sorted((tmp_path / "square.dnr" / "passes" / "train").glob("*.exr"))[0])
        inside = channels["mask"] > 0.5
        means.append([float(channels[c][inside].mean()) for c in "RGB"])
    assert "up to date" in run("prepare", "square.obj", folder=tmp_path).stdout
    assert means[0][0] > 2 * means[0][2] > 0  # lit (by the neutral world) and red
    assert means[1][2] > 2 * means[1][0] > 0  # and now blue


@pytest.mark.robustness
def test_no_validation_and_no_test_views(tmp_path: Path, demo_blend: Path) -> None:
    off = ("--set", "cameras.val=0", "--set", "cameras.test=0")
    quick = {"DNRPIPE_SELECT__STEP1__EPOCHS": "1", "DNRPIPE_FINETUNE__STEP2__EPOCHS": "1", "DNRPIPE_RAYTRACE__SPP": "4"}
    done = run("run", str(demo_blend), *off, folder=tmp_path, **quick)
    assert "no test views" in done.stderr
    assert "report" in done.stdout
    assert run("status", folder=tmp_path).returncode == 0


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


@pytest.mark.robustness
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
            forget(copy, names[later])
    rng = random.Random(stage)
    arguments = ("prepare", str(demo_blend)) if stage == "prepare" else (stage,)
    for _ in range(3):
        process = subprocess.Popen(
            command(*arguments, "--quiet"), cwd=tmp_path, env=environment(), stderr=subprocess.DEVNULL
        )
        time.sleep(rng.uniform(0.3, 1.0) * (1.0 + seconds[names[stage]]["seconds"]))
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert not torn(copy)
    run(*arguments, folder=tmp_path)
    for later in STAGES[start + 1 :]:
        run(later, folder=tmp_path)
    assert contents(copy) == expected


def test_interrupt_is_exit_code_130_and_resumable(tmp_path: Path, tiny: Path) -> None:
    copy = tmp_path / "demo.dnr"
    shutil.copytree(tiny, copy)
    for name in ("finetune", "evaluate"):
        forget(copy, name)
    progress = copy / "checkpoints" / "step2" / "checkpoint.json"
    process = subprocess.Popen(
        command("finetune", "--epochs", "40"), cwd=tmp_path, env=environment(), stderr=subprocess.PIPE, text=True
    )
    for _ in range(3000):
        time.sleep(0.02)
        if progress.exists() and json.loads(progress.read_text())["epoch"] >= 1:
            break
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "run the same command" in errors
    assert "Traceback" not in errors
    assert 1 <= json.loads(progress.read_text())["epoch"] < 40
    assert "continues after epoch" in run("finetune", folder=tmp_path).stderr

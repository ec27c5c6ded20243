"""`dnrpipe batch`: what fleet.toml may say, and a fleet with a broken scene in it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from tests.service.harness import TINY

from dnrpipe.core.errors import UserError
from dnrpipe.fleet.page import page, told
from dnrpipe.fleet.plan import read_fleet
from dnrpipe.fleet.records import FleetRow, FleetSummary

SCENES = Path(__file__).parents[1] / "blender_scenes"
SCENE = SCENES / "hard" / "emissive_only.blend"
FLEET = """
out = "made"
commands = ["run", "render --orbit 8"]
preset = "draft"
scenes = ["c.blend", "[ab].blend"]
[settings]
cameras.train = 9
[variants.cheap]
select.budget = 0
[variants.full]
select.policy = "random"
"""


def _file(folder: Path, text: str) -> Path:
    path = folder / "fleet.toml"
    path.write_text(text)
    return path


def test_scenes_times_variants(tmp_path: Path) -> None:
    for name in ("b", "a", "c"):
        (tmp_path / f"{name}.blend").touch()
    fleet = read_fleet(_file(tmp_path, FLEET))
    assert fleet.out == tmp_path / "made"
    assert [job.name for job in fleet.jobs] == [f"{s}-{v}" for s in "cab" for v in ("cheap", "full")]
    run, render = fleet.jobs[0].commands
    assert run[:2] == ("run", str(tmp_path / "c.blend"))
    assert ("--set", "cameras.train=9") in pairwise(run)
    assert ("--set", "select.budget=0") in pairwise(run)
    assert render == ("render", "--orbit", "8", "-w", str(tmp_path / "made" / "c-cheap.dnr"))
    assert 'select.policy="random"' in fleet.jobs[1].commands[0]


def test_settings_reach_commands_that_take_no_scene(tmp_path: Path) -> None:
    """They are told until a command remembers them; the executor is not remembered, so each one is told that."""
    (tmp_path / "a.blend").touch()
    settings = 'preset = "draft"\nscenes = ["a.blend"]\n[settings]\nfinetune.step2.epochs = 9\nexecutor.workers = 3\n'
    fleet = read_fleet(
        _file(tmp_path, f'commands = ["export-gltf", "report", "finetune", "evaluate", "export-nerf"]\n{settings}')
    )
    export, report, finetune, evaluate, again = (line[1:-2] for line in fleet.jobs[0].commands)
    executor = ("--set", "executor.workers=3")
    assert export == again == () and evaluate == executor
    assert report == finetune == ("--preset", "draft", "--set", "finetune.step2.epochs=9", *executor)


@pytest.mark.parametrize(
    "text, message",
    [
        ('scenes = ["a.blend"', "not valid TOML"),
        ("scenes = []", "scenes: list should have at least 1 item"),
        ('scenes = ["*.blend"]', r"scenes: \*.blend matches no file"),
        ('scenes = ["a.blend"]\nsheep = 1', "sheep: extra inputs are not permitted"),
        ('scenes = ["a.blend"]\n[settings]\ncameras.trian = 9', "unknown setting 'cameras.trian'; did you mean"),
        ('scenes = ["a.blend"]\n[variants.x]\nselect.budget = -1', "select.budget"),
        ('scenes = ["a.blend"]\ncommands = ["rm -rf /"]', "is none of run, prepare"),
        ('scenes = ["a.blend"]\ncommands = ["run -w elsewhere"]', "-w is the fleet's to say"),
        ('scenes = ["a.blend", "d/a.blend"]', "would both be a"),
    ],
)
def test_what_is_refused_before_anything_starts(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        read_fleet(_file(tmp_path, text))


def test_the_page_escapes_and_counts() -> None:
    row = FleetRow(
        name="<b>", scene="s", state="failed", failed_at="run", error="<script>", seconds=3, log="logs/x.log"
    )
    summary = FleetSummary(finished=0, rows=[row, row.model_copy(update={"name": "c", "state": "done", "psnr": 30.0})])
    html = page(summary, 3)
    assert "<script>" not in html and "&lt;script&gt;" in html and "30.00 dB" in html
    assert told(summary, 3) == "1 of 3 done, 1 failed, 1 not ended yet"


def _batch(fleet: Path, *more: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "dnrpipe.cli", "batch", str(fleet), "--json", *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def test_a_forecast_wants_something_to_go_by(tmp_path: Path) -> None:
    (tmp_path / "a.blend").touch()
    process = _batch(_file(tmp_path, 'scenes = ["a.blend"]'), "--forecast", "1,8")
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 2 and "no scene of" in errors and "is done yet" in errors


@pytest.mark.slow
def test_a_broken_scene_stops_no_other_and_a_second_run_goes_on(tmp_path: Path) -> None:
    (tmp_path / "broken.blend").write_bytes(b"BLENDER-v300 and then nothing")
    (tmp_path / "good.blend").write_bytes(SCENE.read_bytes())
    settings = "\n".join(f"{key} = {json.dumps(value)}" for key, value in TINY.items())
    scenes = 'scenes = ["broken.blend", "missing.blend", "good.blend"]'
    fleet = _file(tmp_path, f"{scenes}\n[settings]\n{settings}\n")
    first = _batch(fleet)
    until = time.monotonic() + 60
    while not (tmp_path / "fleet" / "good.dnr" / "manifest.json").exists():
        assert time.monotonic() < until and first.poll() is None, first.communicate()
        time.sleep(0.05)
    os.killpg(first.pid, signal.SIGINT)
    out, errors = first.communicate(timeout=60)
    assert first.returncode == 130 and "go on where it stopped" in errors

    second = _batch(fleet)
    out, errors = second.communicate(timeout=300)
    assert second.returncode == 1, errors
    rows = {row["name"]: row for row in json.loads(out)["rows"]}
    assert [rows[name]["state"] for name in ("broken", "missing", "good")] == ["failed", "failed", "done"]
    assert "damaged or truncated" in rows["broken"]["error"] and "missing.blend" in rows["missing"]["error"]
    assert errors.splitlines()[-1].startswith("dnrpipe: error: batch: broken, missing failed")
    assert rows["good"]["psnr"] > 10
    folder = tmp_path / "fleet"
    assert (folder / rows["good"]["report"]).is_file() and (folder / rows["good"]["log"]).is_file()
    assert rows["good"]["report"] in (folder / "index.html").read_text()
    assert json.loads((folder / "fleet.json").read_text())["rows"] == json.loads(out)["rows"]
    forecast = _batch(fleet, "--forecast", "1,8")
    told, errors = forecast.communicate(timeout=30)
    seconds = json.loads(told)["seconds"]
    assert forecast.returncode == 0 and 0 < seconds["8"] <= seconds["1"], errors


@pytest.mark.robustness
def test_ten_scenes_and_a_broken_one_run_unattended(tmp_path: Path) -> None:
    scenes = sorted(SCENES.glob("*.blend"))
    assert len(scenes) == 11  # the ten and the demo
    (tmp_path / "broken.blend").write_bytes(b"no scene at all")
    settings = "\n".join(f"{key} = {json.dumps(value)}" for key, value in TINY.items())
    listed = json.dumps(["broken.blend", *map(str, scenes)])
    process = _batch(_file(tmp_path, f"scenes = {listed}\n[settings]\n{settings}\n"), "--jobs", "2")
    out, errors = process.communicate(timeout=1800)
    assert process.returncode == 1, errors
    states = {row["name"]: row["state"] for row in json.loads(out)["rows"]}
    assert [name for name, state in states.items() if state != "done"] == ["broken"]
    assert "batch: broken failed" in errors

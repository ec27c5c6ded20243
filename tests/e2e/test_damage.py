"""Damaged files of a workspace: found, named, made again, and the results are those of an undamaged run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from e2e_harness import contents, run

pytestmark = [pytest.mark.slow, pytest.mark.e2e]


def _flip(path: Path, where: float = 0.7) -> Path:
    """Change one byte: a disk or a copy that lies."""
    data = bytearray(path.read_bytes())
    data[int(where * len(data))] ^= 0x20
    path.write_bytes(data)
    return path


def _cut(path: Path) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    return path


@pytest.fixture
def copy(tiny: Path, tmp_path: Path) -> Path:
    shutil.copytree(tiny, tmp_path / "demo.dnr")
    return tmp_path / "demo.dnr"


def test_stages_mend_what_they_meet(copy: Path) -> None:
    """One stage's run meets five damaged files of four stages; each is named, and nothing else is made again."""
    expected = contents(copy)
    chosen = json.loads((copy / "selection.json").read_text())["views"]
    damaged = [
        _flip(copy / "checkpoints" / "step2" / "model.safetensors"),
        _cut(copy / "raytraced" / "train" / f"{chosen[0]}.exr"),
        _cut(copy / "passes" / "train" / f"{chosen[1]}.exr"),
        _cut(copy / "base" / "train" / f"{chosen[2]}.exr"),
        _cut(copy / "selection.json"),
    ]
    kept = {p: p.stat().st_mtime_ns for p in copy.rglob("*.exr") if p not in damaged}
    # Evaluation that is not up to date reads the weights; what it needs, it sends for.
    shutil.rmtree(copy / "evaluation")
    said = run("raytrace-selected", folder=copy).stderr + run("evaluate", folder=copy).stderr
    assert all(f"{path}: damaged (" in said for path in damaged)
    assert "Traceback" not in said
    assert contents(copy) == expected
    assert {p: p.stat().st_mtime_ns for p in copy.rglob("*.exr") if p in kept} == kept


def test_verify_finds_everything_and_repair_clears_the_way(copy: Path) -> None:
    expected = contents(copy)
    whole = run("verify", "--json", folder=copy)
    assert json.loads(whole.stdout)["faults"] == []
    damaged = [
        _flip(sorted((copy / "passes" / "val").glob("*.exr"))[0]),
        _flip(sorted((copy / "raytraced" / "test").glob("*.exr"))[0]),
        _flip(copy / "checkpoints" / "step2" / "model.safetensors"),
        _cut(copy / "base" / "light.npz"),
        _cut(copy / "cameras" / "test.json"),
        _flip(sorted((copy / "scene" / "meshes").iterdir())[0]),
        _cut(sorted((copy / "evaluation").glob("*.truth.png"))[0]),
    ]
    (copy / "passes" / "train" / ".0001.99999.tmp.exr").write_bytes(b"torn")
    found = run("verify", "--json", folder=copy, check=False)
    assert found.returncode == 1
    answer = json.loads(found.stdout)
    named = {row["file"] for row in answer["faults"]}
    assert named == {str(path) for path in [*damaged, copy / "passes" / "train" / ".0001.99999.tmp.exr"]}
    repaired = run("verify", "--repair", folder=copy)
    assert "dnrpipe prepare, dnrpipe finetune, dnrpipe evaluate" in repaired.stdout
    for stage in ("prepare", "select", "raytrace-selected", "finetune", "evaluate"):
        run(stage, folder=copy) if stage != "prepare" else run(stage, _source(copy), folder=copy.parent)
    assert contents(copy) == expected
    assert json.loads(run("verify", "--json", folder=copy).stdout)["faults"] == []


def _source(workspace: Path) -> str:
    return json.loads((workspace / "manifest.json").read_text())["source"]["path"]


def test_the_number_of_processes_changes_no_bit(copy: Path) -> None:
    """Ray tracing by one worker and by three: the same pixels (the seed of a view is its own)."""
    expected = {name: value for name, value in contents(copy).items() if name.startswith("raytraced/train")}
    assert len(expected) == 3
    for workers in (1, 3):
        shutil.rmtree(copy / "raytraced" / "train")
        run("raytrace-selected", "--set", f"raytrace.workers={workers}", folder=copy)
        again = {name: value for name, value in contents(copy).items() if name.startswith("raytraced/train")}
        assert again == expected

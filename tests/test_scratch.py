"""Scratch folders: on the RAM disk when they fit, and none outlives its process for long."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from dnrpipe.blender.passes import scratch


@pytest.fixture
def ram_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(scratch, "RAM_DISK", tmp_path)
    return tmp_path


def test_the_folder_is_gone_afterwards(ram_disk: Path) -> None:
    with scratch.scratch_folder(16) as folder:
        assert folder.parent == ram_disk and folder.is_dir()
    assert not list(ram_disk.iterdir())


def test_a_folder_of_a_dead_process_is_swept_and_one_of_a_living_process_stays(ram_disk: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", "pass"])
    process.wait()
    dead = ram_disk / f"{scratch.PREFIX}{process.pid}-abc"
    dead.mkdir()
    (dead / "frame.exr").write_bytes(b"x")
    alive = ram_disk / f"{scratch.PREFIX}1-abc"
    alive.mkdir()
    with scratch.scratch_folder(16):
        assert not dead.exists()
        assert alive.exists()

"""What is known of a machine is kept until its drivers change."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dnrpipe.blender.passes import choice
from dnrpipe.core import machine


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("DNRPIPE_CACHE", str(tmp_path / "cache"))
    for found in (choice.try_engine, machine.machine_fingerprint):
        found.cache_clear()
    yield
    for found in (choice.try_engine, machine.machine_fingerprint):
        found.cache_clear()


def test_kept_until_the_driver_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert machine.remembered("probe") is None
    machine.remember("probe", {"seconds": 1.5})
    assert machine.remembered("probe") == {"seconds": 1.5}
    monkeypatch.setenv("LIBGL_ALWAYS_SOFTWARE", "another")
    machine.machine_fingerprint.cache_clear()
    assert machine.remembered("probe") is None
    monkeypatch.delenv("LIBGL_ALWAYS_SOFTWARE")
    machine.machine_fingerprint.cache_clear()
    assert machine.remembered("probe") == {"seconds": 1.5}
    (machine.cache_root() / "machine" / "probe.json").write_text("{")
    assert machine.remembered("probe") is None
    machine.forget_all()
    assert not (machine.cache_root() / "machine").exists()


def test_a_cache_that_cannot_be_written_costs_nothing_but_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("DNRPIPE_CACHE", str(tmp_path / "file"))
    machine.remember("probe", 1)
    assert machine.remembered("probe") is None
    machine.forget_all()


def test_an_engine_is_tried_once_per_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trial is a process of its own: here a script that counts how often it was asked."""
    counter = tmp_path / "counter"
    script = tmp_path / "python"
    answer = '{"ok": true, "seconds_first": 9.0, "seconds_next": 0.25}'
    script.write_text(f"#!/bin/sh\necho tried >> {counter}\necho '{answer}'\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    for _ in range(3):
        choice.try_engine.cache_clear()  # as a new process
        assert choice.choose_raster("auto") == ("eevee", "EEVEE takes 0.25 s per 256x256 frame here")
    assert counter.read_text().split() == ["tried"]
    machine.forget_all()
    choice.try_engine.cache_clear()
    choice.choose_raster("auto")
    assert counter.read_text().split() == ["tried", "tried"]
    # A machine too busy to answer says nothing of the driver.
    script.write_text(f"#!/bin/sh\necho late >> {counter}\nsleep 20\n")
    monkeypatch.setattr(choice, "TIMEOUT", 0.5)
    machine.forget_all()
    for _ in range(2):
        choice.try_engine.cache_clear()
        assert choice.choose_raster("auto")[0] == "cycles-direct"
    assert counter.read_text().split().count("late") == 2

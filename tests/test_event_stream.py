"""What commands tell other programs while they run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from dnrpipe.core.console import Console
from dnrpipe.core.errors import UserError
from dnrpipe.core.event_stream import VARIABLE, EventStream
from dnrpipe.service.worker import EventReader


def _read(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_messages_and_progress(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where nothing is shown: the first and the last step of a bar, and every message, are told."""
    path = tmp_path / "events.jsonl"
    monkeypatch.setenv(VARIABLE, str(path))
    console = Console(quiet=True)
    console.say("hello")
    console.warn("careful")
    with console.bar("views", 300) as bar:
        for number in range(300):
            bar.advance(note=f"view {number}")
    events = _read(path)
    assert [e["text"] for e in events if e["kind"] == "message"] == ["hello", "careful"]
    steps = [e for e in events if e["kind"] == "progress"]
    assert (steps[0]["done"], steps[0]["seconds_left"]) == (0, None)
    assert (steps[-1]["done"], steps[-1]["total"], steps[-1]["seconds_left"]) == (300, 300, 0.0)
    assert len(steps) < 50  # told at most a few times a second


def test_numbers_that_are_not_json(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    EventStream(path).send("epoch", losses={"total": float("nan")}, val={"psnr": float("inf")}, epoch=1)
    event = _read(path)[0]
    assert event["losses"] == {"total": None} and event["val"] == {"psnr": None} and event["epoch"] == 1


def test_nothing_without_the_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    EventStream.from_environment().send("message", text="nobody hears this")


def test_a_file_that_cannot_be_written_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=VARIABLE):
        EventStream(tmp_path / "none" / "events.jsonl")
    done = subprocess.run(
        [sys.executable, "-m", "dnrpipe.cli", "select", "-w", str(tmp_path)],
        env={**os.environ, VARIABLE: str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2 and VARIABLE in done.stderr and "Traceback" not in done.stderr


def test_reader_takes_whole_lines_once(tmp_path: Path) -> None:
    """Torn lines wait for their end; noise is left out; of progress in a row the last is kept."""
    path = tmp_path / "events.jsonl"
    reader = EventReader(path)
    path.write_bytes(b'{"time": 1, "kind": "message", "text": "a"}\nnoise\n{"time": 2, "ki')
    assert [event["kind"] for event in reader.read()] == ["message"]
    with path.open("ab") as file:
        file.write(b'nd": "message", "text": "b"}\n')
        for done in range(5):
            file.write(json.dumps({"time": 3, "kind": "progress", "label": "x", "done": done}).encode() + b"\n")
    assert [(e["kind"], e.get("done")) for e in reader.read()] == [("message", None), ("progress", 4)]
    assert reader.read() == []

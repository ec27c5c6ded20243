"""What the user sees while a stage runs: lines and progress bars, never from inside the trainer.

Progress goes to standard error. With ``--json`` so do messages, and standard output carries one JSON value.
Other programs read the same from the event stream (`event_stream`).
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console as RichConsole
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from .event_stream import EventStream

PLAIN_INTERVAL = 10.0  # seconds between progress lines when standard error is not a terminal
EVENT_INTERVAL = 0.2  # least seconds between progress events


class Bar:
    """One running progress bar. ``advance`` counts units; ``note`` is shown at its end."""

    def __init__(self, console: Console, label: str, total: int, done: int, progress: Progress | None) -> None:
        self.label, self.total, self.done = label, total, done
        self._console, self._first, self._reported = console, done, 0.0
        self._progress = progress
        self._task = progress.add_task(label, total=total, completed=done, note="") if progress else None
        self._started = self._last = time.monotonic()
        self._report("")

    def advance(self, count: int = 1, note: str = "") -> None:
        self.done += count
        self._report(note)
        if self._progress is not None and self._task is not None:
            self._progress.update(self._task, completed=self.done, note=note)
            return
        now = time.monotonic()
        if now - self._last >= PLAIN_INTERVAL and self.done < self.total and not self._console.quiet:
            self._last = now
            left = clock(self._seconds_left(now) or 0.0)
            print(f"{self.label}: {self.done}/{self.total}, {left} left {note}".rstrip(), file=sys.stderr, flush=True)

    def _seconds_left(self, now: float) -> float | None:
        made = self.done - self._first
        return (now - self._started) / made * (self.total - self.done) if made > 0 else None

    def _report(self, note: str) -> None:
        now = time.monotonic()
        if now - self._reported < EVENT_INTERVAL and self.done < self.total:
            return
        self._reported = now
        left = self._seconds_left(now)
        self._console.events.send(
            "progress",
            label=self.label,
            done=self.done,
            total=self.total,
            seconds_left=None if left is None else round(left, 1),
            note=note,
        )


class Console:
    """Messages and bars of one command."""

    def __init__(self, *, json_mode: bool = False, quiet: bool = False) -> None:
        self.json_mode = json_mode
        self.quiet = quiet
        self.events = EventStream.from_environment()
        self._rich = RichConsole(stderr=True, highlight=False)

    def say(self, text: str) -> None:
        """A line for the user; standard output, or standard error under ``--json``."""
        self.events.send("message", level="info", text=text)
        if not self.quiet:
            print(text, file=sys.stderr if self.json_mode else sys.stdout, flush=True)

    def warn(self, text: str) -> None:
        """A line that should not be missed: standard error, also when quiet."""
        self.events.send("message", level="warning", text=text)
        print(f"warning: {text}", file=sys.stderr, flush=True)

    def result(self, value: Any) -> None:
        """The command's JSON answer (only under ``--json``)."""
        if self.json_mode:
            print(json.dumps(value, indent=2), flush=True)

    @contextmanager
    def bar(self, label: str, total: int, done: int = 0) -> Iterator[Bar]:
        """A progress bar with time left; a line every ten seconds where there is no terminal."""
        if self.quiet or total <= 0 or not self._rich.is_terminal:
            yield Bar(self, label, total, done, None)
            return
        with Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=self._rich,
        ) as progress:
            yield Bar(self, label, total, done, progress)


def clock(seconds: float) -> str:
    """``3:05``, ``2:10:00``."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}" if minutes >= 60 else f"{minutes}:{rest:02d}"

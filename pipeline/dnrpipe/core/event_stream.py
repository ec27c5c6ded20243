"""What a running command tells other programs: one JSON object a line, in the file that DNRPIPE_EVENTS names.

Every line has ``time`` (unix seconds) and ``kind``; the rest depends on the kind:

    message    level (info, warning), text
    progress   label, done, total, seconds_left (None until something is done), note
    epoch      stage (select, finetune), epoch, epochs, losses, val, seconds
    preview    stage (finetune), split, view, epoch, epochs, and files by what they show (prediction, truth),
               relative to the workspace, until the next one; psnr in dB, None where there is no reference yet
    picture    split, view, and files by what they show, relative to the workspace; psnr in dB

The file is appended to, so that a command that is run again goes on in it. Readers must bear a torn last line.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

from pydantic_core import to_jsonable_python

from .errors import UserError

VARIABLE = "DNRPIPE_EVENTS"


class EventStream:
    """Appends events to a file; without a path it does nothing. Raises UserError where it cannot be opened."""

    def __init__(self, path: Path | None) -> None:
        self._descriptor: int | None = None
        if path is None:
            return
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise UserError(f"{VARIABLE}={path}: cannot be written ({error.strerror}); name another file") from None

    @classmethod
    def from_environment(cls) -> EventStream:
        """The stream that ``DNRPIPE_EVENTS`` asks for, or a silent one."""
        path = os.environ.get(VARIABLE)
        return cls(Path(path) if path else None)

    def send(self, kind: str, **facts: Any) -> None:
        """Append one event; NaN and infinity become None.

        A reader's troubles (disk full, file gone) never end the work that is reported on.
        """
        if self._descriptor is None:
            return
        plain = to_jsonable_python(facts, inf_nan_mode="null")
        event = {"time": round(time.time(), 3), "kind": kind, **plain}
        try:
            os.write(self._descriptor, json.dumps(event, allow_nan=False).encode() + b"\n")
        except OSError:
            self._descriptor = None

"""Worker that makes a whole stage: see `elsewhere`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core.console import Console
from ..core.settings import ExecutorSettings, Settings
from ..core.workspace import Workspace
from .pipeline import STAGES
from .stage import Run


class Worker:
    """Makes a stage in the process that it is asked in."""

    def __init__(self, common: dict[str, Any]) -> None:
        del common  # says what the process needs, not what it does

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        settings = Settings.model_validate(task["settings"])
        device = "cuda" if settings.device.startswith("cuda") else settings.device  # it sees the one that it got
        here = settings.model_copy(update={"executor": ExecutorSettings(), "device": device})
        run = Run(
            Workspace.open(Path(task["workspace"])),
            here,
            Console(json_mode=True, quiet=True),
            task["stage"],
            task["id"],
            task["fingerprint"],
        )
        outcome = STAGES[task["stage"]].make(run)
        return {"output": outcome.output, "detail": outcome.detail}

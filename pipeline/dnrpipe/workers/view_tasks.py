"""Tasks that write one file each: what they are called, whether they are made, what failed, what was repaired.

Also the answer to a single task.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from dnrtrain.exr import read_metadata

from ..core.console import Console
from ..core.errors import UserError
from .placement import HERE, Placement
from .task_list import Retry, TaskResult, run_tasks

Book = Callable[[dict[str, Any], dict[str, Any], int], None]
"""Called with a finished task, its result and the number of workers side by side; writes it into the ledger."""


class TasksFailed(RuntimeError):
    """Some views could not be made; the others are on disk. The message names them and the log."""


def worker_count(setting: int) -> int:
    """The setting, or one worker per core that this process may use when it is 0."""
    return setting or len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1))


def is_made(task: dict[str, Any]) -> bool:
    """True when the task's file is there and was made from the same inputs."""
    metadata = read_metadata(Path(task["output"]))
    return metadata is not None and metadata.get("fingerprint") == task["fingerprint"]


def warn_of_retries(label: str, console: Console) -> Callable[[Retry], None]:
    """A `retried` of `run_tasks` that warns under the label."""
    return lambda retry: console.warn(f"{label}: {retry.reason}; trying once more")


def only_answer(
    label: str,
    module: str,
    common: dict[str, Any],
    task: dict[str, Any],
    *,
    log: Path,
    console: Console,
    environment: dict[str, str] | None = None,
    place: Placement = HERE,
    timeout: float | None = None,
) -> dict[str, Any]:
    """The result of one task on a worker of its own. Raises UserError: it failed twice."""
    retried = warn_of_retries(label, console)
    (outcome,) = run_tasks(
        module,
        common,
        [task],
        workers=1,
        log=log,
        retried=retried,
        environment=environment,
        place=place,
        timeout=timeout,
    )
    if outcome.result is None:
        raise UserError(f"{label} failed twice: {outcome.error}; see {log}")
    return outcome.result


class Failures:
    """The tasks of one list that failed twice: warned of as they come, raised together at the end."""

    def __init__(self, label: str, console: Console, log: Path) -> None:
        self.label, self.console, self.log = label, console, log
        self.names: list[str] = []

    def retried(self, retry: Retry) -> None:
        """Tell of a task that is tried once more."""
        self.console.warn(f"{self.label}: {task_name(retry.task)}: {retry.reason}; trying once more")

    def noted(self, outcomes: Iterator[TaskResult]) -> Iterator[TaskResult]:
        """The outcomes, with failures noted."""
        for outcome in outcomes:
            if outcome.result is None:
                name = task_name(outcome.task)
                self.console.warn(f"{self.label}: {name} failed twice: {outcome.error}")
                self.names.append(name)
            yield outcome

    def report(self, total: int) -> None:
        """Raise TasksFailed where there are any."""
        if self.names:
            listed = f"{', '.join(self.names[:5])}{'…' if len(self.names) > 5 else ''}"
            raise TasksFailed(
                f"{self.label}: {len(self.names)} of {total} failed ({listed});"
                f" the others are done. See {self.log}; run the same command to try again"
            )


def task_name(task: dict[str, Any]) -> str:
    """``train/0007`` for a view's task, else the output's name."""
    output = Path(task.get("output", "scene"))
    return f"{output.parent.name}/{output.stem}" if "view" in task else output.name


def warn_of_repairs(tasks: Sequence[dict[str, Any]], console: Console) -> None:
    """Say which views hold pixels that were not finite: traced or read again, or set to zero."""
    for task in tasks:
        metadata = read_metadata(Path(task["output"])) or {}
        repaired, masked = int(metadata.get("repaired") or 0), int(metadata.get("masked") or 0)
        if repaired or masked:
            rest = f", {masked} more set to zero" if masked else ""
            console.warn(f"repaired: {repaired} pixels in view {task_name(task)} that were not finite{rest}")
        if guides := int(metadata.get("guides_masked") or 0):
            console.warn(
                f"repaired: {guides} pixels of the denoiser's guides in view {task_name(task)} were not finite;"
                " there it saw the colour alone"
            )

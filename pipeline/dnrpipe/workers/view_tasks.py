"""Run a list of per-view tasks on workers: skip what is on disk, book what was done, show progress."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from dnrtrain.exr import read_metadata

from ..core.console import Console
from ..core.ledger import CostRecord
from ..core.workspace import Workspace
from .processes import Retry, TaskResult, run_tasks


class TasksFailed(RuntimeError):
    """Some views could not be made; the others are on disk. The message names them and the log."""


def worker_count(setting: int) -> int:
    """The setting, or one worker per core that this process may use when it is 0."""
    return setting or len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1))


def is_made(task: dict[str, Any]) -> bool:
    """True when the task's file is there and was made from the same inputs."""
    metadata = read_metadata(Path(task["output"]))
    return metadata is not None and metadata.get("fingerprint") == task["fingerprint"]


def run_view_tasks(
    label: str,
    module: str,
    common: dict[str, Any],
    tasks: Sequence[dict[str, Any]],
    *,
    workspace: Workspace,
    console: Console,
    stage: str,
    workers: int,
    book: Callable[[dict[str, Any], dict[str, Any], int], CostRecord],
    environment: dict[str, str] | None = None,
) -> int:
    """Run the tasks whose files are missing or out of date; returns how many were run.

    ``book(task, result, workers)`` gives the ledger record of a finished task. Raises TasksFailed after all
    other tasks are done when some failed twice.
    """
    due = [task for task in tasks if not is_made(task)]
    if not due:
        return 0
    count = max(1, min(workers, len(due)))
    log = workspace.log(stage)
    with console.bar(label, len(tasks), len(tasks) - len(due)) as bar:
        outcomes = run_tasks(module, common, due, workers=count, log=log, environment=environment)

        def done(outcome: TaskResult) -> None:
            if outcome.result is not None:
                workspace.ledger.append(book(outcome.task, outcome.result, count))
            bar.advance(note=task_name(outcome.task) if outcome.result is not None else "")

        failed = consume(label, outcomes, console, done)
    report_failed(label, failed, len(tasks), log)
    return len(due)


def consume(
    label: str,
    outcomes: Iterator[TaskResult | Retry],
    console: Console,
    done: Callable[[TaskResult], None],
) -> list[str]:
    """Go through the outcomes of tasks, telling of retries and failures; names of the tasks that failed.

    done: called with every TaskResult. Raises OSError: the disk is full. The workers end with this call.
    """
    failed: list[str] = []
    try:
        for outcome in outcomes:
            name = task_name(outcome.task)
            if isinstance(outcome, Retry):
                console.warn(f"{label}: {name}: {outcome.reason}; trying once more")
                continue
            if outcome.errno == errno.ENOSPC:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), outcome.task["output"])
            if outcome.result is None:
                console.warn(f"{label}: {name} failed twice: {outcome.error}")
                failed.append(name)
            done(outcome)
    finally:
        outcomes.close()  # type: ignore[attr-defined]
    return failed


def report_failed(label: str, failed: Sequence[str], total: int, log: Path) -> None:
    """Raise TasksFailed where there are any."""
    if failed:
        raise TasksFailed(
            f"{label}: {len(failed)} of {total} failed ({', '.join(failed[:5])}{'…' if len(failed) > 5 else ''});"
            f" the others are done. See {log}; run the same command to try again"
        )


def task_name(task: dict[str, Any]) -> str:
    """``train/0007`` for a view's task, else the output's name."""
    output = Path(task.get("output", "scene"))
    return f"{output.parent.name}/{output.stem}" if "view" in task else output.name


def view_record(
    *,
    run: str,
    stage: Any,
    purpose: Any,
    task: dict[str, Any],
    result: dict[str, Any],
    workers: int,
    device: str,
) -> CostRecord:
    """The ledger record of one view."""
    known = {"seconds", "cpu_seconds", "peak_mb", "spp", "noise"}
    return CostRecord(
        time=time.time(),
        run=run,
        stage=stage,
        purpose=purpose,
        unit="view",
        name=task_name(task),
        seconds=result["seconds"],
        cpu_seconds=result.get("cpu_seconds", 0.0),
        device=device,
        workers=workers,
        width=task["view"]["width"],
        height=task["view"]["height"],
        spp=result.get("spp"),
        peak_mb=result.get("peak_mb"),
        noise=result.get("noise"),
        detail={k: v for k, v in result.items() if k not in known},
    )


def warn_repairs(tasks: Sequence[dict[str, Any]], console: Console) -> None:
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

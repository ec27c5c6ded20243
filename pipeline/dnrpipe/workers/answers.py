"""The one loop over the answers of workers: retries are told, a full disk is an OSError, workers end with the loop."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ..core.console import Console
from ..core.errors import UserError
from .processes import Retry, TaskResult, run_tasks


def answers(
    module: str,
    common: dict[str, Any],
    tasks: Sequence[dict[str, Any]],
    *,
    workers: int,
    log: Path,
    retried: Callable[[Retry], None],
    environment: dict[str, str] | None = None,
    timeout: float | None = None,
    next_tasks: Callable[[TaskResult], Sequence[dict[str, Any]]] | None = None,
) -> Iterator[TaskResult]:
    """Each task's last answer, as it comes; it has a result or an error.

    Args:
        module, common, tasks, workers, log, environment, timeout, next_tasks: of `processes.run_tasks`.
        retried: called when a task is tried once more.

    Raises OSError: the disk is full. The workers end with this iterator.
    """
    outcomes = run_tasks(
        module,
        common,
        tasks,
        workers=workers,
        log=log,
        timeout=timeout,
        environment=environment,
        next_tasks=next_tasks,
    )
    try:
        for outcome in outcomes:
            if isinstance(outcome, Retry):
                retried(outcome)
                continue
            if outcome.errno == errno.ENOSPC:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), outcome.task.get("output", str(log.parent)))
            yield outcome
    finally:
        outcomes.close()


def warn_of_retries(label: str, console: Console) -> Callable[[Retry], None]:
    """A `retried` of `answers` that warns under the label."""
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
) -> dict[str, Any]:
    """The result of one task on a worker of its own. Raises UserError: it failed twice."""
    results = []
    for outcome in answers(
        module,
        common,
        [task],
        workers=1,
        log=log,
        retried=warn_of_retries(label, console),
        environment=environment,
    ):
        if outcome.result is None:
            raise UserError(f"{label} failed twice: {outcome.error}; see {log}")
        results.append(outcome.result)
    return results[0]

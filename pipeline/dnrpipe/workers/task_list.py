"""Task lists: one loop, whatever kind of worker answers.

A worker is a process of this machine (`processes.LocalWorker`) or an actor of a Ray cluster (`ray_workers.RayWorker`).
The parent survives a worker's death, reports it, retries a task once on a fresh worker, and goes on. A worker that does
not answer is killed after a while: see `TaskTimeout`.
"""

from __future__ import annotations

import errno
import os
import queue
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dnrtrain.text import one_line

from ..core.errors import UserError
from ..core.units import parse_seconds
from .placement import HERE, Placement, Worker, WorkerLost
from .processes import KeptWorker, LocalWorker, temporary_folder

MAX_ATTEMPTS, MOST_LOSSES = 2, 3
TIMEOUT_VARIABLE = "DNRPIPE_TASK_TIMEOUT"
FIRST_LIMIT = 6 * 3600.0
"""Seconds that a task may take while none has ended yet: paper-sized light on two cores is well within."""
LEAST_LIMIT = 600.0
"""Below it nothing counts as hung, however quick the others were: machines swap, and sleep."""
SLOWEST = 30.0
"""A task may take so many times the longest one so far."""


@dataclass
class TaskResult:
    """Outcome of one task: ``result`` when it succeeded, else ``error`` (one line).

    ``died``: the worker process ended or hung, rather than answering with an error. ``errno``: of the
    OSError that the worker met, or None. ``node``: name of the machine that answered, "" for this one.
    ``side_by_side``: how many workers there were.
    """

    task: dict[str, Any]
    result: dict[str, Any] | None = None
    error: str | None = None
    attempts: int = 1
    seconds: float = 0.0
    died: bool = False
    errno: int | None = None
    node: str = ""
    side_by_side: int = 1


@dataclass
class Retry:
    """A worker died or a task failed; the task is tried again."""

    task: dict[str, Any]
    reason: str


class TaskTimeout:
    """The limit of each task of one run.

    Args:
        fixed: seconds; None: those of DNRPIPE_TASK_TIMEOUT, else SLOWEST times the longest task that ended so far
            (LEAST_LIMIT at least, FIRST_LIMIT before any has).

    Raises UserError: the variable is no number of seconds above 0.
    """

    def __init__(self, fixed: float | None = None) -> None:
        self.fixed, self.longest = fixed, 0.0
        if fixed is None and (text := os.environ.get(TIMEOUT_VARIABLE, "").strip()):
            try:
                self.fixed = parse_seconds(text)
            except ValueError:
                raise UserError(f"{TIMEOUT_VARIABLE}={text}: expected a time such as 90, 20m or 2h") from None

    def limit(self, attempt: int) -> float:
        """Seconds for try number ``attempt`` of a task; further tries get twice as long, unless told otherwise."""
        if self.fixed is not None:
            return self.fixed
        usual = max(LEAST_LIMIT, SLOWEST * self.longest) if self.longest else FIRST_LIMIT
        return usual * (1 if attempt == 1 else 2)

    def took(self, seconds: float) -> None:
        self.longest = max(seconds, self.longest)

    def reason(self) -> str:
        """What the limit came from."""
        return f"; the longest so far took {self.longest:.0f} s" if self.fixed is None and self.longest else ""


def run_tasks(
    module: str,
    common: dict[str, Any],
    tasks: Sequence[dict[str, Any]],
    *,
    workers: int,
    log: Path,
    retried: Callable[[Retry], object] = lambda retry: None,
    timeout: float | None = None,
    environment: dict[str, str] | None = None,
    next_tasks: Callable[[TaskResult], Sequence[dict[str, Any]]] | None = None,
    place: Placement = HERE,
    kept: KeptWorker | None = None,
) -> Generator[TaskResult, None, None]:
    """Run ``tasks`` on ``workers`` workers; yield each task's outcome as it comes.

    Args:
        module: importable module with a class ``Worker(common)`` that is callable with a task.
        common: JSON-able, sent once to each worker.
        log: file to which the workers' output is appended.
        retried: called when a task is tried once more.
        timeout: seconds after which a silent task counts as hung; its worker is killed. None: see `TaskTimeout`.
        environment: variables added to the workers' environment.
        next_tasks: called with each TaskResult before it is yielded; returns tasks to do after it.
        place: where the workers are. On a cluster ``workers`` says how many share one machine like this one; there
            are as many as the cluster has room for.
        kept: the one worker, of this machine, which lives on when all tasks are answered for.

    Closing the iterator (Ctrl-C in the consumer) kills the workers. A consumer that leaves early closes it itself
    (`contextlib.closing`): Python drops what is raised while it throws an iterator away, a Ctrl-C, too.

    Raises UserError: see `TaskTimeout`; no such cluster. Raises OSError: the disk is full.
    """
    task_timeout = TaskTimeout(timeout)
    # Not a SimpleQueue: of several that wait there with a timeout, CPython 3.11 lets one wait for ever whose time is up
    # just when another takes what it was woken for (measured: one in ten, 1 ms, four threads).
    pending: queue.Queue[tuple[dict[str, Any], int, int]] = queue.Queue()
    for task in tasks:
        pending.put((task, 1, 0))  # the how-manieth try; nodes that were lost with it
    outcomes: queue.SimpleQueue[TaskResult | Retry] = queue.SimpleQueue()
    stopping = threading.Event()
    open_tasks = len(tasks)  # not answered for yet: written by the consumer alone, read by the workers' threads
    left_behind = ExitStack()
    answering: list[Worker] = []
    if kept is not None:
        answering.append(kept.get(module, common, log, environment))
    elif place.is_local:
        count = max(1, min(workers, len(tasks)))
        variables = left_behind.enter_context(temporary_folder()) | (environment or {})
        answering += [LocalWorker(module, common, log, variables) for _ in range(count)]
    else:
        from .ray_workers import ray_workers

        answering += ray_workers(module, common, log, environment or {}, place, workers, len(tasks))

    def serve(worker: Worker) -> None:
        # The thread lives as long as a worker that it starts: PR_SET_PDEATHSIG follows the spawning thread.
        try:
            while not stopping.is_set() and open_tasks > 0:
                try:
                    if not worker.ready():
                        continue
                    task, attempt, losses = pending.get(timeout=0.05)
                except queue.Empty:
                    continue
                started = time.monotonic()
                try:
                    answer = worker.answer(task, task_timeout.limit(attempt), task_timeout.reason())
                except WorkerLost as loss:
                    if losses + 1 < MOST_LOSSES:
                        outcomes.put(Retry(task, str(loss)))
                        pending.put((task, attempt, losses + 1))
                        continue
                    answer = {"error": f"{loss}, as were those that had it before", "retry": False, "died": True}
                except Exception as death:  # cannot be started, truncated answer, no room for what it reads
                    answer = {"error": one_line(death), "retry": True, "died": True}
                if stopping.is_set():
                    return
                seconds, node = time.monotonic() - started, answer.get("node", "")
                if answer.get("retry"):  # on a fresh worker: this one may be short of memory, or half broken
                    worker.close()
                if "error" not in answer:
                    task_timeout.took(seconds)
                    outcomes.put(
                        TaskResult(
                            task, answer["result"], None, attempt, seconds, node=node, side_by_side=len(answering)
                        )
                    )
                elif attempt < MAX_ATTEMPTS and answer.get("retry", True):
                    outcomes.put(Retry(task, answer["error"]))
                    pending.put((task, attempt + 1, losses))
                else:
                    died, number = answer.get("died", False), answer.get("errno")
                    outcomes.put(TaskResult(task, None, answer["error"], attempt, seconds, died, number, node))
        finally:
            if kept is None or stopping.is_set() or not kept.lives_on:
                worker.close(force=stopping.is_set())

    threads = [threading.Thread(target=serve, args=(worker,), daemon=True) for worker in answering]
    for thread in threads:
        thread.start()
    try:
        while open_tasks > 0:
            outcome = outcomes.get()
            if isinstance(outcome, Retry):
                retried(outcome)
                continue
            more = next_tasks(outcome) if next_tasks is not None else ()
            for task in more:
                pending.put((task, 1, 0))
            open_tasks += len(more) - 1
            if outcome.errno == errno.ENOSPC:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), outcome.task.get("output", str(log.parent)))
            yield outcome
    finally:
        if open_tasks > 0:
            stopping.set()
            for worker in answering:
                worker.kill()
        for thread in threads:
            thread.join(timeout=10)
        left_behind.close()

"""Task lists on local worker processes.

A renderer runs in a process of its own: bpy is process-global state, and a bad LLVM or GL driver kills
the process it lives in. The parent survives, reports, retries a task once on a fresh worker, and goes on.
A worker that does not answer is killed after a while: see `TaskTimeout`.

Protocol: ``python -m dnrpipe.workers.processes MODULE PARENT``. The worker calls ``MODULE.Worker(common)`` once, then
``worker(task) -> result`` for every JSON line on standard input. Answers are JSON lines on a private copy
of standard output; what libraries print goes to the log file.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import UserError
from ..core.units import parse_seconds

MAX_ATTEMPTS = 2
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
    OSError that the worker met, or None.
    """

    task: dict[str, Any]
    result: dict[str, Any] | None = None
    error: str | None = None
    attempts: int = 1
    seconds: float = 0.0
    died: bool = False
    errno: int | None = None


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
) -> Generator[TaskResult, None, None]:
    """Run ``tasks`` on ``workers`` processes; yield each task's outcome as it comes.

    Args:
        module: importable module with a class ``Worker(common)`` that is callable with a task.
        common: JSON-able, sent once to each worker.
        log: file to which the workers' output is appended.
        retried: called when a task is tried once more.
        timeout: seconds after which a silent task counts as hung; its worker is killed. None: see `TaskTimeout`.
        environment: variables added to the workers' environment.
        next_tasks: called with each TaskResult before it is yielded; returns tasks to do after it.

    Closing the iterator (Ctrl-C in the consumer) kills the workers.

    Raises UserError: see `TaskTimeout`. Raises OSError: the disk is full.
    """
    task_timeout = TaskTimeout(timeout)
    pending: queue.SimpleQueue[tuple[dict[str, Any], int]] = queue.SimpleQueue()
    for task in tasks:
        pending.put((task, 1))
    outcomes: queue.SimpleQueue[TaskResult | Retry] = queue.SimpleQueue()
    stopping = threading.Event()
    open_tasks = len(tasks)  # not answered for yet: written by the consumer alone, read by the workers' threads
    # Workers end without Blender's own clean-up (see _worker_main); what it leaves in the temporary folder goes here.
    temp_dir = tempfile.TemporaryDirectory(prefix="dnrpipe-workers-", ignore_cleanup_errors=True)
    worker_environment = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), temp_dir.name) | (environment or {})
    count = max(1, min(workers, len(tasks)))
    processes = [LocalWorker(module, common, log, worker_environment) for _ in range(count)]

    def serve(worker: LocalWorker) -> None:
        # The thread lives as long as its worker: PR_SET_PDEATHSIG follows the spawning thread.
        try:
            while not stopping.is_set() and open_tasks > 0:
                try:
                    task, attempt = pending.get(timeout=0.05)
                except queue.Empty:
                    continue
                started = time.monotonic()
                try:
                    answer = worker.answer(task, task_timeout.limit(attempt), task_timeout.reason())
                except (WorkerDied, OSError, ValueError) as death:  # also: cannot be started, truncated answer
                    answer = {"error": " ".join(str(death).split()), "retry": True, "died": True}
                if stopping.is_set():
                    return
                seconds = time.monotonic() - started
                if answer.get("retry"):  # on a fresh worker: this one may be short of memory, or half broken
                    worker.close()
                if "error" not in answer:
                    task_timeout.took(seconds)
                    outcomes.put(TaskResult(task, answer["result"], None, attempt, seconds))
                elif attempt < MAX_ATTEMPTS and answer.get("retry", True):
                    outcomes.put(Retry(task, answer["error"]))
                    pending.put((task, attempt + 1))
                else:
                    died, number = answer.get("died", False), answer.get("errno")
                    outcomes.put(TaskResult(task, None, answer["error"], attempt, seconds, died, number))
        finally:
            worker.close(force=stopping.is_set())

    threads = [threading.Thread(target=serve, args=(worker,), daemon=True) for worker in processes]
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
                pending.put((task, 1))
            open_tasks += len(more) - 1
            if outcome.errno == errno.ENOSPC:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), outcome.task.get("output", str(log.parent)))
            yield outcome
    finally:
        if open_tasks > 0:
            stopping.set()
            for worker in processes:
                worker.kill()
        for thread in threads:
            thread.join(timeout=10)
        temp_dir.cleanup()


class WorkerDied(RuntimeError):
    """The worker process ended or hung while a task was under way."""


class TaskFailed(RuntimeError):
    """The worker answered with an error; it lives on."""


class LocalWorker:
    """One worker process that is asked task by task. Not for several threads at once.

    Linux kills it when the thread that asked first ends.

    Args: as of `run_tasks`; without a log its output goes where this process's errors go.
    """

    def __init__(self, module: str, common: dict[str, Any], log: Path | None, environment: dict[str, str]) -> None:
        self.module, self.common, self.log, self.environment = module, common, log, environment
        self._process: subprocess.Popen[str] | None = None

    def ask(self, task: dict[str, Any], timeout: float) -> dict[str, Any]:
        """The result of a task. Raises WorkerDied, TaskFailed."""
        try:
            answer = self.answer(task, timeout)
        except WorkerDied:
            self.close()
            raise
        if "error" in answer:
            raise TaskFailed(answer["error"])
        return answer["result"]

    def answer(self, task: dict[str, Any], timeout: float, why: str = "") -> dict[str, Any]:
        """What the worker says, as `_worker_main` makes it; the worker is started where there is none.

        Raises WorkerDied, also after ``timeout`` seconds (``why``: where that number is from).
        """
        if self._process is None or self._process.poll() is not None:
            self._process = self._spawn()
        process = self._process
        assert process.stdin is not None and process.stdout is not None
        hung = threading.Event()

        def kill() -> None:
            hung.set()
            process.kill()

        timer = threading.Timer(timeout, kill)
        timer.daemon = True
        timer.start()
        try:
            try:
                process.stdin.write(json.dumps(task) + "\n")
                process.stdin.flush()
                line = process.stdout.readline()
            except OSError:
                line = ""
            if not line:
                raise WorkerDied(f"worker hung for {timeout:.0f} s{why}" if hung.is_set() else _exit_reason(process))
            return json.loads(line)
        finally:
            timer.cancel()

    def kill(self) -> None:
        """At once, and from any thread; `close` is still to be called."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()

    def close(self, *, force: bool = True) -> None:
        """End the process. Without ``force`` it may finish first."""
        process, self._process = self._process, None
        if process is None:
            return
        with contextlib.suppress(OSError):
            if process.stdin:
                process.stdin.close()
        if force:
            process.kill()
        try:
            process.wait(timeout=20)
        except subprocess.TimeoutExpired:  # a library that hangs at exit; its work is on disk already
            process.kill()
            process.wait()
        if process.stdout:
            process.stdout.close()

    def _spawn(self) -> subprocess.Popen[str]:
        if self.log is not None:
            self.log.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.nullcontext() if self.log is None else self.log.open("a") as sink:
            process = subprocess.Popen(
                [sys.executable, "-m", "dnrpipe.workers.processes", self.module, str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=sink,
                text=True,
                env={**os.environ, "PYTHONUNBUFFERED": "1", **self.environment},
            )
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(self.common) + "\n")
            process.stdin.flush()
        except OSError:
            raise WorkerDied(_exit_reason(process)) from None
        return process


def _exit_reason(process: subprocess.Popen[str]) -> str:
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=5)
    guess = " (out of memory?)" if process.returncode == -signal.SIGKILL else ""
    return f"worker {how_ended(process.returncode)}{guess}"


def how_ended(code: int | None) -> str:
    """``was killed by SIGKILL``, ``ended with exit code 3``."""
    if code is None or code >= 0:
        return f"ended with exit code {code}"
    names = {int(one): one.name for one in signal.Signals}
    return f"was killed by {names.get(-code, f'signal {-code}')}"


def die_with_parent(parent: int) -> None:
    """Ask Linux to kill this process when the thread that started it dies; elsewhere stdin's end serves.

    parent: number of the process that started this one. Where it died before we could ask, this process ends at once.
    """
    if sys.platform == "linux":
        import ctypes

        parent_death_signal = 1  # PR_SET_PDEATHSIG
        ctypes.CDLL(None, use_errno=True).prctl(parent_death_signal, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)


def _worker_main(module: str, parent: int) -> int:
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    common = json.loads(sys.stdin.readline())
    worker: Any = None
    for line in sys.stdin:
        try:
            if worker is None:  # made on the first task: its failure is that task's answer
                worker = importlib.import_module(module).Worker(common)
            answer = {"result": worker(json.loads(line))}
        except Exception as error:  # reported to the parent, the traceback goes to the log
            import traceback

            traceback.print_exc()
            reason = " ".join(str(error).split()) or type(error).__name__
            if isinstance(error, MemoryError):
                reason = f"out of memory ({reason})"
            # Bad input and a full disk stay what they are; anything else gets its second try.
            full = isinstance(error, OSError) and error.errno == errno.ENOSPC
            retry = not (full or isinstance(error, ValueError | UserError))
            answer = {"error": reason, "retry": retry, "errno": getattr(error, "errno", None)}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()
    answers.flush()
    sys.stderr.flush()
    os._exit(0)  # bpy and Dr.Jit may crash in their own shutdown after all work is written


if __name__ == "__main__":
    raise SystemExit(_worker_main(sys.argv[1], int(sys.argv[2])))

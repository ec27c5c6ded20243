"""A worker process: a renderer runs in a process of its own.

bpy is process-global state, and a bad LLVM or GL driver kills the process it lives in. The parent survives, and goes on
with a fresh one.

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
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dnrtrain.text import one_line

from ..core.errors import UserError

TAIL = 20_000
"""Bytes at the end of a log in which `last_error` looks."""
ERROR = "dnrpipe: error: "


class WorkerDied(RuntimeError):
    """The worker process ended or hung while a task was under way."""


class TaskFailed(RuntimeError):
    """The worker answered with an error; it lives on."""


class LocalWorker:
    """One worker process that is asked task by task. Not for several threads at once.

    Linux kills it when the thread that started it ends, which is the one that asks where `start` was not called.

    Args: as of `task_list.run_tasks`; without a log its output goes where this process's errors go.
    """

    def __init__(self, module: str, common: dict[str, Any], log: Path | None, environment: dict[str, str]) -> None:
        self.module, self.common, self.log, self.environment = module, common, log, environment
        self._process: subprocess.Popen[str] | None = None
        self._thread = 0

    def ready(self) -> bool:
        """A process is started when it is asked."""
        return True

    @property
    def runs(self) -> bool:
        return self._process is not None and self._process.poll() is None

    @property
    def outlives_this_thread(self) -> bool:
        """Whether another thread started the process."""
        return self._thread != threading.get_ident()

    def start(self) -> None:
        """Start the process now, from this thread. Raises WorkerDied."""
        self._process, self._thread = self._spawn(), threading.get_ident()

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
        """What the worker says, as `Answerer` makes it; the worker is started where there is none.

        Raises WorkerDied, also after ``timeout`` seconds (``why``: where that number is from).
        """
        if not self.runs:
            self.start()
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
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


class KeptWorker:
    """A worker process that outlives a list of tasks: the next list that wants the same of it finds it warm.

    There is one at a time. Linux kills it when the thread that asked for it ends. A context manager, which ends it.
    """

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()
        self._worker: LocalWorker | None = None
        self._wanted: Any = None
        self.started = 0.0
        """When the process was, by `time.monotonic`."""

    def __enter__(self) -> KeptWorker:
        return self

    def __exit__(self, *exception: Any) -> None:
        self.close()

    def get(self, module: str, common: dict[str, Any], log: Path, environment: dict[str, str] | None) -> LocalWorker:
        """The worker, another one where this is not what it was started for."""
        wanted = (module, common, log, environment)
        if self._worker is None or not self._worker.runs or self._wanted != wanted:
            self.close()
            self._wanted, self.started = wanted, time.monotonic()
            folder = self._stack.enter_context(temporary_folder())
            self._worker = LocalWorker(module, common, log, folder | (environment or {}))
            with contextlib.suppress(WorkerDied, OSError):  # asked, it is started again, and says what is wrong
                self._worker.start()
            self._stack.callback(self._worker.close)
        return self._worker

    @property
    def lives_on(self) -> bool:
        """Whether it outlives the thread that asks: not where that one had to start it again."""
        return self._worker is not None and self._worker.outlives_this_thread

    def close(self) -> None:
        """End it, so that its memory is free; the next `get` starts another."""
        self._worker = None
        self._stack.close()


@contextlib.contextmanager
def temporary_folder() -> Iterator[dict[str, str]]:
    """Variables that name a folder for what workers leave behind: they end without Blender's own clean-up."""
    with tempfile.TemporaryDirectory(prefix="dnrpipe-workers-", ignore_cleanup_errors=True) as folder:
        yield dict.fromkeys(("TMPDIR", "TEMP", "TMP"), folder)


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


def last_error(log: Path) -> str | None:
    """The last error line that a command wrote to its log, without ``dnrpipe: error:``; None where there is none."""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - TAIL))
        lines = file.read().decode("utf-8", "replace").splitlines()
    errors = [line.removeprefix(ERROR) for line in lines if line.startswith(ERROR)]
    return errors[-1] if errors else None


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


class Answerer:
    """``MODULE.Worker(common)``, made on the first task, or before by `get_ready`: a failure is that task's answer."""

    def __init__(self, module: str, common: dict[str, Any]) -> None:
        self.module, self.common = module, common
        self.worker: Any = None
        self.failure: Exception | None = None

    def get_ready(self) -> None:
        try:
            self.worker = self._made()
        except Exception as error:
            self.failure = error

    def _made(self) -> Any:
        return importlib.import_module(self.module).Worker(self.common)

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        """``{"result": ...}``, or ``{"error": one line, "retry": whether it is worth a second try, "errno": ...}``."""
        try:
            failure, self.failure = self.failure, None
            if failure is not None:
                raise failure
            if self.worker is None:
                self.worker = self._made()
            return {"result": self.worker(task)}
        except Exception as error:  # reported to the parent, the traceback goes to the log
            import traceback

            traceback.print_exc()
            reason = one_line(error) or type(error).__name__
            if isinstance(error, MemoryError):
                reason = f"out of memory ({reason})"
            # Bad input and a full disk stay what they are; anything else gets its second try.
            full = isinstance(error, OSError) and error.errno == errno.ENOSPC
            retry = not (full or isinstance(error, ValueError | UserError))
            return {"error": reason, "retry": retry, "errno": getattr(error, "errno", None)}


def _worker_main(module: str, parent: int) -> int:
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    answerer = Answerer(module, json.loads(sys.stdin.readline()))
    answerer.get_ready()
    for line in sys.stdin:
        answers.write(json.dumps(answerer(json.loads(line))) + "\n")
        answers.flush()
    answers.flush()
    sys.stderr.flush()
    os._exit(0)  # bpy and Dr.Jit may crash in their own shutdown after all work is written


if __name__ == "__main__":
    raise SystemExit(_worker_main(sys.argv[1], int(sys.argv[2])))

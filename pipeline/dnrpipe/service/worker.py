"""The worker process of one device: claims a job, runs its command, watches it and records how it ended.

`run_job` is all of that but claiming and recording; workers elsewhere (`remote_worker`) use it, too.

`python -m dnrpipe.service.worker DEVICE SERVER_PID`, with the server's configuration as JSON on standard input. The
job's process leads its own session. It dies with the worker, and the worker dies with the server: after kill -9 nothing
runs on unseen, and the next server queues the job again.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from filelock import FileLock, Timeout

from dnrtrain.text import one_line

from ..core.errors import UserError
from ..core.event_stream import VARIABLE
from ..core.workspace import LOCK_FILES
from ..workers.processes import die_with_parent, how_ended, last_error
from ..workers.task_list import TIMEOUT_VARIABLE
from .config import ServerConfig, tightest
from .models import End, Job, Limits
from .queue import MAX_LOSSES, Queue
from .results import EXPORTED
from .root import ServiceRoot

GRACE = 15.0
"""Seconds between SIGTERM and SIGKILL, in which a job stops its workers and writes what it has."""
IDLE = 0.3
WATCH = 0.2
DISK_INTERVAL = 5.0
MACHINE_VARIABLES = ("DNRPIPE_CACHE", TIMEOUT_VARIABLE)
"""Variables of the server's environment that its jobs inherit."""
UNLOCK_SECONDS = 10.0
"""How long the processes of a killed worker may still hold a workspace."""
INTERRUPTED = 130


class Report(Protocol):
    """Where a running job's news go, and word of its cancellation comes from."""

    def news(self, events: list[dict[str, Any]]) -> None: ...

    def cancelled(self) -> bool: ...


class Worker:
    """One device's share of the queue."""

    def __init__(self, config: ServerConfig, device: str) -> None:
        self.config, self.device = config, device
        self.root = ServiceRoot(config.root)
        self.queue = Queue(self.root.queue)
        self.stopping = False

    def run(self) -> None:
        """Work until SIGTERM; then requeue the running job."""
        self.queue.recover(self.device)
        while not self.stopping:
            job = self.queue.claim(self.device)
            if job is None:
                time.sleep(IDLE)
                continue
            limits = tightest(job.request.limits, self.config.limits)
            report = _QueueReport(self.queue, job.id)
            try:
                end = run_job(
                    job, self.root, self.device, limits, report, lambda: self.stopping, executor=self.config.executor
                )
            except (UserError, OSError) as error:  # the job cannot start; the worker goes on
                end = End(state="failed", error=one_line(error))
            self.queue.end(job.id, end)

    def stop(self, *_: Any) -> None:
        self.stopping = True


class _QueueReport:
    """To the queue itself."""

    def __init__(self, queue: Queue, job: int) -> None:
        self.queue, self.job = queue, job

    def news(self, events: list[dict[str, Any]]) -> None:
        self.queue.add_events(self.job, events)

    def cancelled(self) -> bool:
        return self.queue.get(self.job).cancel_requested


def run_job(
    job: Job,
    root: ServiceRoot,
    device: str,
    limits: Limits,
    report: Report,
    stopping: Callable[[], bool],
    *,
    executor: tuple[str, ...] = (),
) -> End:
    """Run a job's command in ``root`` on a device, and watch it until it ends. Returns how it did.

    stopping: asked all the time; when it says so the job is stopped, and is to be started again. Raises UserError,
    OSError: the command cannot be started. Raises what ``report`` raises; the job's processes are gone then.
    """
    workspace = root.workspace(job.request.workspace, must_exist=False)
    command = job_command(job, root, executor)
    if workspace.is_dir():  # if somebody else holds it, the command says so
        with contextlib.suppress(Timeout), FileLock(workspace / LOCK_FILES[0], timeout=UNLOCK_SECONDS):
            pass
    events = root.events(job.id)
    events.write_bytes(b"")  # the queue already has the events of earlier attempts
    with root.log(job.id).open("ab") as log:
        log.write(f"--- {time.strftime('%F %T')} start {job.starts} on {job.device}\n".encode())
        log.flush()
        process = subprocess.Popen(
            command,
            cwd=root.folder,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=job_environment(device, events),
            start_new_session=True,
            preexec_fn=partial(die_with_parent, os.getpid()),
        )
    try:
        stopped = _watch(process, workspace, limits, EventReader(events), report, stopping)
    except BaseException:
        end_group(process, grace=0)
        raise
    return _how_ended(job, process.returncode, stopped, root.log(job.id))


def _watch(
    process: subprocess.Popen[bytes],
    workspace: Path,
    limits: Limits,
    events: EventReader,
    report: Report,
    stopping: Callable[[], bool],
) -> str | None:
    """Wait until the job ends. Returns why it was stopped: "cancelled", "stopping" or a limit; None: by itself."""
    started, disk_due = time.monotonic(), 0.0
    ended = None
    while process.poll() is None:
        report.news(events.read())
        now = time.monotonic()
        if report.cancelled():
            ended = "cancelled"
        elif stopping():
            ended = "stopping"
        elif limits.seconds is not None and now - started > limits.seconds:
            ended = f"took longer than its limit of {limits.seconds:g} s"
        elif limits.memory_mb is not None and session_memory_mb(process.pid) > limits.memory_mb:
            ended = f"used more than its limit of {limits.memory_mb} MiB of memory"
        elif limits.disk_mb is not None and now >= disk_due:
            disk_due = now + DISK_INTERVAL
            if folder_mb(workspace) > limits.disk_mb:
                ended = f"its workspace is larger than its limit of {limits.disk_mb} MiB"
        if ended is not None:
            end_group(process)
            break
        time.sleep(WATCH)
    end_group(process, grace=0)  # helpers that outlive their command
    report.news(events.read())
    return ended


def _how_ended(job: Job, code: int, stopped: str | None, log: Path) -> End:
    if code == 0 and stopped in (None, "cancelled", "stopping"):  # it ended before it was stopped
        return End(state="done", exit_code=0)
    if stopped == "cancelled":
        return End(state="cancelled", exit_code=code)
    if stopped == "stopping":
        return End(state="queued", error="its worker was stopped")
    if stopped is not None:
        return End(state="failed", exit_code=code, error=f"{stopped}; raise it and retry to go on")
    if code < 0 and job.crashes < min(job.request.retries, MAX_LOSSES - 1):
        return End(state="queued", error=f"its process {how_ended(code)}", crashed=True)
    return End(state="failed", exit_code=code, error=_reason(log, code))


class EventReader:
    """Reads new complete lines of a job's event stream; of successive progress reports it keeps the last."""

    def __init__(self, path: Path) -> None:
        self.path, self.offset = path, 0

    def read(self) -> list[dict[str, Any]]:
        with self.path.open("rb") as file:
            file.seek(self.offset)
            data = file.read(4 << 20)
        whole = data.rfind(b"\n") + 1
        self.offset += whole
        found: list[dict[str, Any]] = []
        for line in data[:whole].splitlines():
            try:
                event = json.loads(line)
                event["time"], event["kind"] = float(event["time"]), str(event["kind"])
            except (ValueError, KeyError, TypeError):
                continue
            before = found[-1] if found else {}
            if event["kind"] == before.get("kind") == "progress" and before.get("label") == event.get("label"):
                found.pop()
            found.append(event)
        return found


def job_command(job: Job, root: ServiceRoot, executor: tuple[str, ...] = ()) -> list[str]:
    """The command line of a job. Only the first start of which something is left gets `--force`; later ones resume."""
    request = job.request
    workspace = root.workspace(request.workspace, must_exist=False)
    command = [sys.executable, "-m", "dnrpipe.cli", request.command]
    if request.scene is not None:
        command.append(str(root.submitted_scene(request.scene, request.scene_sha256)[1]))
    command += ["-w", str(workspace), "--json"]
    if request.command in EXPORTED:
        return [*command, "--out", str(workspace / EXPORTED[request.command])]
    if request.orbit is not None:
        command += ["--orbit", str(request.orbit)]
    for option, value in (("--frames", request.frames), ("--size", request.size)):
        command += [option, value] if value is not None else []
    if request.preset is not None:
        command += ["--preset", request.preset]
    for key, value in request.settings.items():
        command += ["--set", f"{key}={value if isinstance(value, str) else json.dumps(value)}"]
    for setting in executor:  # the operator's word, after the job's
        command += ["--set", setting]
    if request.force and job.starts - job.lost == 1:
        command.append("--force")
    return command


def job_environment(device: str, events: Path) -> dict[str, str]:
    """The worker's environment, without the settings of whoever started the server, on the worker's device."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("DNRPIPE_") or k in MACHINE_VARIABLES}
    if device.startswith("cuda:"):
        kept |= {"CUDA_VISIBLE_DEVICES": device.removeprefix("cuda:"), "DNRPIPE_DEVICE": "cuda"}
    else:
        kept |= {"DNRPIPE_DEVICE": "cpu"}
    return kept | {VARIABLE: str(events), "PYTHONUNBUFFERED": "1"}


def session_memory_mb(session: int) -> float:
    """Resident memory of all processes of a session, MiB (pages that several share are counted for each). Linux."""
    pages = 0
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        with contextlib.suppress(OSError, ValueError, IndexError):
            # pid (command) state ppid pgrp session ...: the command may hold anything, so split after its bracket.
            fields = (entry / "stat").read_text(errors="replace").rpartition(")")[2].split()
            if int(fields[3]) == session:
                pages += int(fields[21])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def folder_mb(folder: Path) -> float:
    """Size of the files in a folder, MiB; links are not followed."""
    total = 0
    for path, _, files in os.walk(folder):
        for name in files:
            with contextlib.suppress(OSError):
                total += os.lstat(os.path.join(path, name)).st_size  # noqa: PTH118
    return total / 2**20


def end_group(process: subprocess.Popen[Any], *, grace: float = GRACE) -> None:
    """SIGTERM to the leader, which stops its workers itself; SIGKILL to the whole group after ``grace`` seconds."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=grace)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _reason(log: Path, code: int) -> str:
    """The command's own error line, or its exit code."""
    if (error := last_error(log)) is not None:
        return error
    if code == INTERRUPTED:
        return "interrupted from outside; retry to go on where it stopped"
    return f"the command {how_ended(code)}; see its log"


def main() -> int:
    die_with_parent(int(sys.argv[2]))
    config = ServerConfig.model_validate_json(sys.stdin.read())
    worker = Worker(config, sys.argv[1])
    signal.signal(signal.SIGTERM, worker.stop)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the server's to handle
    worker.run()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

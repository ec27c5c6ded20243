"""Run a fleet: several scenes side by side, each by its own chain of commands, none stopped by another's failure.

<out>/
  NAME.dnr          a workspace per job
  logs/NAME.log     what its commands said
  fleet.json        `FleetSummary`
  index.html        the same as a page, with links to the reports
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from typing import Literal

from dnrtrain.atomic import write_json, write_text
from dnrtrain.text import one_line

from ..core.console import Console
from ..core.workspace import locked
from ..workers.processes import die_with_parent, how_ended, last_error
from .page import page
from .plan import TAKES_NO_FORCE, Fleet, FleetJob
from .records import FleetRow, FleetSummary, read_rows

GRACE = 20.0
"""Seconds between SIGTERM and SIGKILL, in which a command stops its workers and writes what it has."""


def run_fleet(fleet: Fleet, *, jobs: int, environment: dict[str, str], force: bool, console: Console) -> FleetSummary:
    """Run all jobs, at most ``jobs`` at once, and write the summary after each of them.

    Args:
        environment: variables of every command, beside this process's own.
        force: do everything again; else each goes on where it stopped.

    Raises UserError: another command works in the folder. KeyboardInterrupt is passed on once all commands have ended.
    """
    pending: queue.SimpleQueue[FleetJob] = queue.SimpleQueue()
    for job in fleet.jobs:
        pending.put(job)
    ended_before = {row.name: row for row in read_rows(fleet.out)}  # told until they end again
    rows: dict[str, FleetRow] = {}
    ended: queue.SimpleQueue[FleetRow] = queue.SimpleQueue()
    running: set[subprocess.Popen[bytes]] = set()
    stopping = threading.Event()
    (fleet.out / "logs").mkdir(parents=True, exist_ok=True)

    def serve() -> None:  # lives as long as its processes: PR_SET_PDEATHSIG follows the thread
        while not stopping.is_set():
            try:
                job = pending.get_nowait()
            except queue.Empty:
                return
            try:
                row = _run(job, environment, force, fleet.out, running, stopping)
            except Exception as error:  # a full disk, a log that cannot be written: this scene's, not the fleet's
                reason = one_line(error)
                row = FleetRow(name=job.name, scene=str(job.scene), state="failed", error=reason, seconds=0, log="")
            ended.put(row)

    with locked(fleet.out, "batch"):
        threads = [threading.Thread(target=serve, daemon=True) for _ in range(min(jobs, len(fleet.jobs)))]
        for thread in threads:
            thread.start()
        try:
            with console.bar("fleet", len(fleet.jobs)) as bar:
                while len(rows) < len(fleet.jobs):
                    row = _next(ended)
                    rows[row.name] = row
                    if row.state == "failed":
                        console.warn(f"{row.name}: {row.failed_at} failed: {row.error}")
                    bar.advance(note=row.name)
                    _write(fleet, ended_before | rows)
        except BaseException:
            stopping.set()
            _end(running)
            raise
        finally:
            for thread in threads:
                thread.join(timeout=GRACE)
            while not ended.empty():  # those that were interrupted
                row = ended.get_nowait()
                rows[row.name] = row
            summary = _write(fleet, ended_before | rows)
    return summary


def _next(ended: queue.SimpleQueue[FleetRow]) -> FleetRow:
    """Waits such that Ctrl-C is heard."""
    while True:
        try:
            return ended.get(timeout=0.2)
        except queue.Empty:
            continue


def _run(
    job: FleetJob,
    environment: dict[str, str],
    force: bool,
    out: Path,
    running: set[subprocess.Popen[bytes]],
    stopping: threading.Event,
) -> FleetRow:
    """The job's commands, until one fails."""
    log, started, failed, error = out / "logs" / f"{job.name}.log", time.monotonic(), "", ""
    with log.open("ab") as sink:
        for words in job.commands:
            line = [*words, *(["--force"] if force and words[0] not in TAKES_NO_FORCE else [])]
            sink.write(f"--- {time.strftime('%F %T')} dnrpipe {' '.join(line)}\n".encode())
            sink.flush()
            process = subprocess.Popen(
                [sys.executable, "-m", "dnrpipe.cli", *line, "-q"],
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                env={**os.environ, **environment},
                start_new_session=True,  # Ctrl-C is ours to pass on
                preexec_fn=partial(die_with_parent, os.getpid()),
            )
            running.add(process)
            code = process.wait()
            running.discard(process)
            if code != 0:
                failed, error = words[0], _reason(log, code)
                break
    state: Literal["done", "failed", "interrupted"] = "failed" if failed else "done"
    row = FleetRow(
        name=job.name,
        scene=str(job.scene),
        state="interrupted" if failed and stopping.is_set() else state,
        failed_at=failed,
        error=error,
        seconds=round(time.monotonic() - started, 1),
        log=str(log.relative_to(out)),
    )
    return row.model_copy(update=_facts(job.workspace, out))


def _facts(workspace: Path, out: Path) -> dict[str, object]:
    """What the workspace says of itself; nothing where it does not."""
    report, found = workspace / "report" / "report.html", dict[str, object]()
    if report.is_file():
        found["report"] = str(report.relative_to(out))
    with contextlib.suppress(OSError, ValueError, KeyError):
        found["psnr"] = json.loads((workspace / "evaluation" / "metrics.json").read_bytes())["mean"]["psnr"]
    return found


def _reason(log: Path, code: int) -> str:
    """The command's own error line, or how it ended."""
    error = last_error(log)
    return f"the command {how_ended(code)}; see {log}" if error is None else error


def _end(running: set[subprocess.Popen[bytes]]) -> None:
    """SIGTERM, which the commands take as Ctrl-C, then SIGKILL."""
    processes = list(running)
    for process in processes:
        process.send_signal(signal.SIGTERM)
    until = time.monotonic() + GRACE
    for process in processes:
        try:
            process.wait(timeout=max(0.1, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()


def _write(fleet: Fleet, rows: dict[str, FleetRow]) -> FleetSummary:
    summary = FleetSummary(finished=time.time(), rows=[rows[job.name] for job in fleet.jobs if job.name in rows])
    write_json(fleet.out / "fleet.json", summary.model_dump(mode="json"))
    write_text(fleet.out / "index.html", page(summary, len(fleet.jobs)))
    return summary

"""Keeps one worker process per device alive."""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

from .config import ServerConfig
from .queue import Queue
from .worker import GRACE, end_group

LOG = logging.getLogger("dnrpipe.workers")
POLL = 0.3
LONGEST_PAUSE = 30.0
STEADY_SECONDS = 60.0
"""A worker that lived this long starts again soon; one that keeps dying, after longer and longer pauses."""


class Supervisor:
    """Starts a worker per device, restarts those that die, and stops all of them in the end.

    One thread does it all: Linux kills the workers when the thread that started them ends.
    """

    def __init__(self, config: ServerConfig, queue: Queue, log: Path) -> None:
        self.config, self.queue, self.log = config, queue, log
        self.processes: dict[str, subprocess.Popen[str]] = {}
        self._started: dict[str, float] = {}
        self._due = dict.fromkeys(config.devices, 0.0)
        self._pause = dict.fromkeys(config.devices, 1.0)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="supervisor", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def alive(self) -> dict[str, bool]:
        found = dict(self.processes)
        return {d: (p := found.get(d)) is not None and p.poll() is None for d in self.config.devices}

    def stop(self) -> None:
        """End the workers; each requeues its job."""
        self._stopping.set()
        self._thread.join(timeout=2 * GRACE)

    def _run(self) -> None:
        while not self._stopping.is_set():
            for device in self.config.devices:
                if time.monotonic() < self._due[device]:
                    continue
                try:
                    self._look_after(device)
                except Exception:  # a full disk, a busy queue: the other workers live on, and this one is tried again
                    LOG.exception("worker could not be started again", extra={"facts": {"device": device}})
                    self._due[device] = time.monotonic() + LONGEST_PAUSE
            self._stopping.wait(POLL)
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            end_group(process, grace=GRACE + 5)
        self.queue.close()

    def _look_after(self, device: str) -> None:
        """Start the device's worker if there is none; queue the job of one that died again, and say when to start the
        next."""
        now, process = time.monotonic(), self.processes.get(device)
        if process is None:
            self.processes[device] = self._spawn(device)
            self._started[device] = now
        elif process.poll() is not None:
            LOG.error("worker died", extra={"facts": {"device": device, "code": process.returncode}})
            self.queue.recover(device)
            del self.processes[device]  # last: where that failed, it is done again
            steady = now - self._started[device] > STEADY_SECONDS
            self._pause[device] = 1.0 if steady else min(2 * self._pause[device], LONGEST_PAUSE)
            self._due[device] = now + self._pause[device]

    def _spawn(self, device: str) -> subprocess.Popen[str]:
        with self.log.open("a") as sink:
            process = subprocess.Popen(
                [sys.executable, "-m", "dnrpipe.service.worker", device, str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=sink,
                stderr=sink,
                text=True,
                start_new_session=True,  # Ctrl-C in the terminal is the server's to handle
            )
        assert process.stdin is not None
        with contextlib.suppress(OSError):  # it died at once; the next turn sees it
            process.stdin.write(self.config.model_dump_json())
            process.stdin.close()
        return process

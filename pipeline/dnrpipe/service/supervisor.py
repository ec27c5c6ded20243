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
        started: dict[str, float] = {}
        due = dict.fromkeys(self.config.devices, 0.0)
        pause = dict.fromkeys(self.config.devices, 1.0)
        while not self._stopping.is_set():
            now = time.monotonic()
            for device in self.config.devices:
                process = self.processes.get(device)
                if process is not None and process.poll() is not None:
                    LOG.error("worker died", extra={"facts": {"device": device, "code": process.returncode}})
                    del self.processes[device]
                    self.queue.recover(device)
                    steady = now - started[device] > STEADY_SECONDS
                    pause[device] = 1.0 if steady else min(2 * pause[device], LONGEST_PAUSE)
                    due[device] = now + pause[device]
                elif process is None and now >= due[device]:
                    self.processes[device] = self._spawn(device)
                    started[device] = now
            self._stopping.wait(POLL)
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            end_group(process, grace=GRACE + 5)
        self.queue.close()

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

"""Memory and disk that a job uses, and how to end its processes."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from pathlib import Path

GRACE = 15.0
"""Seconds between SIGTERM and SIGKILL, in which a job stops its workers and writes what it has."""


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


def end_group(process: subprocess.Popen[bytes], *, grace: float = GRACE) -> None:
    """SIGTERM to the leader, which stops its workers itself; SIGKILL to the whole group after ``grace`` seconds."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=grace)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()

"""The thread that keeps the workers alive: what fails once ends none of them."""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dnrpipe.service import supervisor
from dnrpipe.service.config import ServerConfig
from dnrpipe.service.queue import Queue
from dnrpipe.service.server import forget_settings
from dnrpipe.service.supervisor import Supervisor
from dnrpipe.service.worker import job_environment

SLEEP = "import time; time.sleep(600)"


def _until(wish: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not wish():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_jobs_inherit_what_is_of_the_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The cache and the time limit of a task reach a job through server and worker; settings do not."""
    environment = {"PATH": "/bin", "DNRPIPE_CACHE": "/c", "DNRPIPE_TASK_TIMEOUT": "20m", "DNRPIPE_SELECT__BUDGET": "3"}
    forget_settings(environment)
    assert environment == {"PATH": "/bin", "DNRPIPE_CACHE": "/c", "DNRPIPE_TASK_TIMEOUT": "20m"}
    monkeypatch.setattr("os.environ", environment)
    assert job_environment("cpu", tmp_path).items() >= environment.items()


def test_a_full_disk_ends_no_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The queue cannot be written when a worker has died: the other one lives on, and this one is started again."""
    monkeypatch.setattr(supervisor, "LONGEST_PAUSE", 0.2)
    monkeypatch.setattr(supervisor, "POLL", 0.02)
    recovered: list[str | None] = []

    class Full(Queue):
        def recover(self, device: str | None = None) -> list[int]:
            recovered.append(device)
            if len(recovered) == 1:
                raise OSError(28, "No space left on device")
            return super().recover(device)

    class Sleepers(Supervisor):
        def _spawn(self, device: str) -> subprocess.Popen[str]:
            return subprocess.Popen([sys.executable, "-c", SLEEP], text=True, start_new_session=True)

    config = ServerConfig(root=tmp_path, devices=("cpu", "cuda:0"))
    kept = Sleepers(config, Full(tmp_path / "q.sqlite"), tmp_path / "workers.log")
    with caplog.at_level(logging.ERROR, "dnrpipe.workers"):
        kept.start()
        try:
            _until(lambda: all(kept.alive().values()))
            first, other = kept.processes["cpu"], kept.processes["cuda:0"]
            first.kill()
            _until(lambda: len(recovered) == 2 and kept.alive()["cpu"])
            assert kept.processes["cpu"] is not first and kept.processes["cuda:0"] is other
            assert kept.alive() == {"cpu": True, "cuda:0": True}
        finally:
            kept.stop()
    assert recovered == ["cpu", "cpu"]
    assert "worker could not be started again" in caplog.text and "No space left" in caplog.text
    assert not any(kept.alive().values())

"""A real server on a real socket, as its own process, that can be killed and started again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from dnrpipe.core.workspace import Source, Workspace
from dnrpipe.service.client import Client

# 48², 4 candidates, some epochs: everything runs, nothing takes long.
TINY: dict[str, bool | int | float | str] = {
    "cameras.train": 4,
    "cameras.val": 1,
    "cameras.test": 1,
    "cameras.width": 48,
    "cameras.height": 48,
    "select.budget": 2,
    "select.policy": "farthest",
    "raytrace.spp": 8,
    "raytrace.evaluation_spp": 8,
    "raytrace.evaluation_baseline": False,
    "base.light_size": 64,
    "base.light_spp": 4,
    "base.samples": 2,
    "passes.raster": "cycles-direct",
    "model.texture_size": 32,
    "model.width": 8,
    "finetune.step2.start": "fresh",
    "raytrace.max_depth": 3,
    "raytrace.denoise": False,
    "raytrace.evaluation_denoise": False,
    "finetune.step2.epochs": 40,
    "finetune.step2.loss.perceptual": 0.0,
}


class Server:
    """``dnrpipe serve`` in ``root``."""

    def __init__(self, root: Path, *options: str) -> None:
        self.root, self.options, self.port = root, options, 0
        self.log = root.parent / f"{root.name}.server.log"
        self.start()

    def start(self) -> None:
        command = [sys.executable, "-m", "dnrpipe.cli", "serve", "--root", str(self.root)]
        command += ["--port", str(self.port), *self.options]
        if "--devices" not in command:
            command += ["--devices", "cpu"]
        with self.log.open("a") as sink:
            self.process = subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=sink, text=True, env=dict(os.environ)
            )
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith("dashboard: "):
                self.url = line.removeprefix("dashboard: ").strip()
                self.port = int(self.url.rpartition(":")[2])  # the same one after a restart
                return
        raise AssertionError(f"the server did not start:\n{self.log.read_text()}")

    def kill(self) -> None:
        """kill -9, and wait until it is gone."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(timeout=30)

    def stop(self) -> int:
        """SIGTERM; returns the exit code."""
        if self.process.poll() is None:
            self.process.terminate()
        return self.process.wait(timeout=60)

    def client(self, token: str | None = None) -> Client:
        return Client(self.url, token)


def empty_workspace(root: Path, name: str) -> None:
    """A workspace in which no stage has run: jobs on it are accepted, and fail within a second."""
    Workspace.create(root / f"{name}.dnr", Source(path=str(root / "none.blend"), sha256="0"))


def processes_of(root: Path) -> list[str]:
    """Command lines of live processes that work on a workspace under ``root``."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if f"-w {root}/" in command:
            found.append(command)
    return found

"""`dnrpipe worker`: this machine works for a server elsewhere."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import click

from ..core.console import Console
from ..core.errors import UserError
from ..workers.processes import die_with_parent
from .options import options as with_options
from .service import SERVER, chosen_devices, server_and_token


@click.command()
@with_options(SERVER[:2])
@click.option("--root", type=click.Path(path_type=Path), metavar="DIR", help="Where jobs work (default: in the cache).")
@click.option("--devices", metavar="A,B", help="A worker each: cpu, cuda:0, ... (default: all GPUs, else cpu).")
@click.option("--name", metavar="NAME", help="Shown with its jobs (default: this machine's name).")
@click.option("--job-memory-mb", type=click.IntRange(64), metavar="N", help="Of a job's processes (default 80%).")
def worker(
    server: str | None,
    token_file: Path | None,
    root: Path | None,
    devices: str | None,
    name: str | None,
    job_memory_mb: int | None,
) -> None:
    """Take whole jobs of a server on another machine, one at a time on each device.

    A job's workspace comes from the server, and what the job makes goes back to it. Ctrl-C stops: the running job is
    sent back as far as it got, and queued again. The token's role is `worker`.

    \b
    Examples:
      dnrpipe worker --server https://render.example.org --token-file token.txt
      dnrpipe worker --server http://box:8420 --token-file token.txt --devices cuda:0,cuda:1
      dnrpipe serve --root ~/scenes --devices none     # a server without workers of its own
    """
    from ..core.machine import cache_root
    from ..service.config import default_memory_mb
    from ..service.lease_client import LeaseClient
    from ..service.leases import WORKER_PATTERN
    from ..service.models import Limits
    from ..service.remote_worker import RemoteWorker, WorkerConfig

    console = Console()
    device, *further = chosen = chosen_devices(devices)
    address, token = server_and_token(server, token_file)
    machine = re.sub(r"[^A-Za-z0-9._-]", "-", platform.node()).lstrip("-._")[:64] or "worker"
    called = machine if name is None else name
    if not re.fullmatch(WORKER_PATTERN, called):
        raise UserError(f"--name {called[:80]!r}: expected 64 letters, digits, dots, dashes and underscores at most")
    place = (root or cache_root() / "workers").expanduser()
    memory = job_memory_mb or default_memory_mb()
    if further:
        with LeaseClient(address, token) as client:
            client.check()  # one line where each of the processes would say the same
        again = ["--server", address, "--root", str(place), "--name", called]
        again += ["--token-file", str(token_file)] if token_file else []
        again += ["--job-memory-mb", str(memory)] if memory else []
        _one_process_each(chosen, again)
        return
    config = WorkerConfig(
        server=address,
        token=token,
        root=place / device.replace(":", "-"),
        name=called,
        device=device,
        limits=Limits(memory_mb=memory),
    )
    RemoteWorker(config, console.say).run()


def _one_process_each(devices: Sequence[str], options: Sequence[str]) -> None:
    """The same command for each device, until Ctrl-C, SIGTERM, or one of them ends; then the others are stopped.

    Raises click.exceptions.Exit: with the exit code of one that failed.
    """
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "dnrpipe.cli", "worker", *options, "--devices", device],
            start_new_session=True,  # Ctrl-C in the terminal is ours to handle
            preexec_fn=partial(die_with_parent, os.getpid()),
        )
        for device in devices
    ]
    try:
        with contextlib.suppress(KeyboardInterrupt):
            while all(process.poll() is None for process in processes):
                time.sleep(0.3)
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait()
    finally:
        for process in processes:
            process.kill()
    code = next((process.returncode for process in processes if process.returncode), 0)
    if code:
        raise click.exceptions.Exit(code if code > 0 else 1)

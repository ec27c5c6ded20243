"""`dnrpipe serve` and `dnrpipe bench-live`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ..core.console import Console
from ..core.errors import UserError


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Another host than loopback needs --token-file.")
@click.option("--port", type=click.IntRange(0, 65535), default=8420, show_default=True, help="0 = any free one.")
@click.option(
    "--root", type=click.Path(path_type=Path), default=Path(), metavar="DIR",
    help="Workspaces, scenes and the queue live here (default: this folder).",
)  # fmt: skip
@click.option("--token-file", type=click.Path(path_type=Path), metavar="FILE", help="Requests must carry this token.")
@click.option("--devices", metavar="A,B", help="One worker each: cpu, cuda:0, ... (default: all GPUs, else cpu).")
@click.option("--upload-mb", type=click.IntRange(1), metavar="N", help="Largest scene file (default 2048 MiB).")
@click.option("--most-queued", type=click.IntRange(1), metavar="N", help="Jobs that may wait (default 10000).")
@click.option("--rate", type=float, metavar="N", help="Requests per second and client address (default 50).")
@click.option("--job-hours", type=float, metavar="H", help="Longest job (default 24).")
@click.option("--job-memory-mb", type=click.IntRange(64), metavar="N", help="Of a job's processes (default 80%).")
@click.option("--job-disk-mb", type=click.IntRange(1), metavar="N", help="Of a job's workspace (default 51200).")
@click.option("--keep-days", type=float, metavar="D", help="Logs and events of ended jobs (default 30 days).")
@click.option("--keep-jobs", type=click.IntRange(1), metavar="N", help="Those of the last N ended jobs (default 1000).")
def serve(
    host: str,
    port: int,
    root: Path,
    token_file: Path | None,
    devices: str | None,
    job_hours: float | None,
    job_memory_mb: int | None,
    job_disk_mb: int | None,
    **options: Any,
) -> None:
    """Serve the pipeline: a job queue, a dashboard and a live viewer in the browser.

    Jobs survive kill -9 and power cuts: they go on from their checkpoints when the server is started again.
    Listens on this machine only, unless --host says otherwise; then every request must carry the token.

    \b
    Examples:
      dnrpipe serve --root ~/scenes          # then open http://127.0.0.1:8420
      dnrpipe serve --host 0.0.0.0 --token-file token.txt
      dnrpipe submit scene.blend             # in another terminal
    """
    from ..service.config import ServerConfig, default_devices, default_memory_mb, read_token
    from ..service.models import Limits
    from ..service.server import serve as run_server

    token = read_token(token_file) if token_file is not None else None
    chosen = tuple(part.strip() for part in devices.split(",")) if devices else default_devices()
    for name in chosen:
        if name != "cpu" and not (name.startswith("cuda:") and name.removeprefix("cuda:").isdigit()):
            raise UserError(f"--devices {name}: neither cpu nor cuda:<number>")
    if len(set(chosen)) < len(chosen):
        raise UserError(f"--devices {devices}: names a device twice")
    days = options["keep_days"]
    if days is not None and not 0 < days <= 36_500:
        raise UserError(f"--keep-days {days:g}: must be above 0, and 36500 at most")
    for name, value in (("--job-hours", job_hours), ("--rate", options["rate"])):
        if value is not None and value <= 0:
            raise UserError(f"{name} {value:g}: must be above 0")
    limits = Limits(
        seconds=3600 * min(job_hours or 24.0, 720.0),
        memory_mb=job_memory_mb or default_memory_mb(),
        disk_mb=job_disk_mb or 50 * 1024,
    )
    given = {key: value for key, value in options.items() if value is not None}
    if "rate" in given:
        given["burst"] = max(1, int(4 * given["rate"]))
    config = ServerConfig(root=root, host=host, port=port, devices=chosen, limits=limits, **given)
    console = Console()
    console.say(f"serving {root.resolve()}, workers: {', '.join(chosen)}; Ctrl-C stops, jobs go on at the next start")
    run_server(config, token, ready=lambda address: console.say(f"dashboard: {address}"))


@click.command("bench-live")
@click.argument("workspace")
@click.option("--server", metavar="URL", help="A running server (default: one is started for the measurement).")
@click.option("--size", type=click.IntRange(64, 1024), default=256, show_default=True, metavar="PIXELS")
@click.option("--seconds", type=click.FloatRange(1, 600), default=15.0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def bench_live(workspace: str, server: str | None, size: int, seconds: float, as_json: bool) -> None:
    """Measure the live viewer: frames per second of an orbiting camera, over the WebSocket.

    WORKSPACE is a folder, or a workspace's name with --server. Says how busy the machine was meanwhile.

    \b
    Examples:
      dnrpipe bench-live scene.dnr
      dnrpipe bench-live scene --server http://127.0.0.1:8420 --size 512
    """
    from ..service.live_bench import bench, lines

    console = Console(json_mode=as_json)
    result = bench(workspace, server, size=size, seconds=seconds, console=console)
    for line in lines(result):
        console.say(line)
    console.result(result)

"""Frames per second of the live viewer for an orbiting camera, end to end over the WebSocket; how busy the machine was.

    python -m tools.bench_live scene.dnr [--size 256] [--seconds 15] [--json]
    python -m tools.bench_live scene --server http://127.0.0.1:8420

The workspace is a folder, or a workspace's name with --server; without, a server is started for the measurement. Linux.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from dnrpipe.core.console import Console
from dnrpipe.core.errors import UserError
from dnrpipe.core.workspace import SUFFIX
from dnrpipe.service.guard import SUBPROTOCOL
from dnrpipe.service.models import NAME_PATTERN
from dnrpipe.service.routes_live import unpack
from dnrtrain.text import one_line

WARM_FRAMES = 40
"""Frames before the measurement: they compile kernels and let the pace settle."""
TURN = 0.05
"""Radians between two frames."""
STARTUP_SECONDS = 60.0


def bench(workspace: str, server: str | None, *, size: int, seconds: float, console: Console) -> dict[str, Any]:
    """Orbit for `seconds`, and request one frame at a time, as the viewer in the browser does.

    Returns frames_per_second, milliseconds (median, 90th percentile, by stage), image sizes and samples seen, the load
    average, others_share: the share of the cores' time that other processes took, and own_cpu_ms: processor time of a
    frame. Raises UserError.
    """
    with contextlib.ExitStack() as stack:
        if server is None:
            path = Path(workspace).resolve()
            name = path.name.removesuffix(SUFFIX)
            if path.suffix != SUFFIX or not re.fullmatch(NAME_PATTERN, name):
                raise UserError(f"{workspace}: not a workspace folder (NAME{SUFFIX})")
            server = stack.enter_context(_server(path.parent))
        else:
            name = workspace
        url = f"{server.replace('http', 'ws', 1)}/workspaces/{name}/live"
        try:
            socket = stack.enter_context(connect(url, subprotocols=[SUBPROTOCOL], max_size=None))  # type: ignore[list-item]
            return _orbit(socket, size, seconds, console) | {"workspace": name, "size": size}
        except (WebSocketException, OSError) as error:
            raise UserError(f"{url}: {one_line(error)}") from None


def lines(result: dict[str, Any]) -> list[str]:
    stages = ", ".join(f"{name} {value:.0f}" for name, value in result["stages_ms"].items())
    seen = ", ".join(f"{key}: {share:.0%}" for key, share in result["frames_at"].items())
    return [
        f"{result['frames_per_second']:.1f} frames/s at {result['size']}², moving ({result['frames']} frames)",
        f"a frame: {result['median_ms']:.0f} ms median, {result['p90_ms']:.0f} ms 90th percentile; {stages} ms",
        f"pixels and rays per pixel: {seen}; at rest, full quality: {result['rest_ms']:.0f} ms",
        f"machine: {result['cores']} cores, load average {result['load']:.1f}; other processes took"
        f" {result['others_share']:.0%} of them, a frame {result['own_cpu_ms']:.0f} ms of processor time",
    ]


def _orbit(socket: Any, size: int, seconds: float, console: Console) -> dict[str, Any]:
    hello = json.loads(socket.recv(timeout=STARTUP_SECONDS))
    if hello.get("kind") != "hello":
        raise UserError(hello.get("detail", "no greeting"))
    angle = 0.0

    def frame(moving: bool) -> tuple[dict[str, Any], float]:
        nonlocal angle
        angle += TURN
        camera = {"azimuth": angle, "elevation": 0.5, "distance": hello["distance"], "target": hello["center"]}
        started = time.perf_counter()
        socket.send(json.dumps({"camera": camera, "size": size, "mode": "neural", "moving": moving}))
        while True:
            message = socket.recv(timeout=STARTUP_SECONDS)
            if isinstance(message, str):
                raise UserError(json.loads(message)["detail"])
            header = unpack(message)[0]
            if header["moving"] == moving and not header["refined"]:
                return header, 1000 * (time.perf_counter() - started)

    with console.bar("warming up", WARM_FRAMES) as bar:
        for _ in range(WARM_FRAMES):
            frame(True)
            bar.advance()
    headers, times = [], []
    began, before = time.perf_counter(), _cpu_times()
    while time.perf_counter() - began < seconds:
        header, took = frame(True)
        headers.append(header)
        times.append(took)
    elapsed, after = time.perf_counter() - began, _cpu_times()
    rest = [frame(False)[1] for _ in range(6)][1:]
    stages = {key: statistics.fmean(h["ms"].get(key, 0.0) for h in headers) for key in headers[-1]["ms"]}
    kinds = [f"{h['width']}², {h['samples'] or 'all'}" for h in headers]
    return {
        "frames_per_second": len(times) / elapsed,
        "frames": len(times),
        "median_ms": statistics.median(times),
        "p90_ms": sorted(times)[int(0.9 * (len(times) - 1))],
        "rest_ms": statistics.median(rest),
        "stages_ms": stages,
        "frames_at": {kind: kinds.count(kind) / len(kinds) for kind in dict.fromkeys(kinds)},
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "others_share": max(0.0, after[0] - before[0] - (after[1] - before[1])) / (elapsed * (os.cpu_count() or 1)),
        "own_cpu_ms": 1000 * (after[1] - before[1]) / len(times),
    }


def _cpu_times() -> tuple[float, float]:
    """(busy seconds of all cores, those of server, frame process and this one) since the machine started."""
    tick = os.sysconf("SC_CLK_TCK")
    with Path("/proc/stat").open() as file:
        user, nice, system, _, _, irq, soft, steal, *_ = (int(x) / tick for x in file.readline().split()[1:])
    ours = 0.0
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError, IndexError):
            words = (entry / "cmdline").read_bytes().split(b"\0")
            if b"dnrpipe.service.live_frames" in words or b"tools.bench_live" in words or b"serve" in words:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                ours += (int(fields[11]) + int(fields[12])) / tick
    return user + nice + system + irq + soft + steal, ours


@contextlib.contextmanager
def _server(root: Path) -> Iterator[str]:
    """A server on a free port, for the length of the measurement; it gets no jobs."""
    command = [sys.executable, "-m", "dnrpipe.cli", "serve", "--root", str(root), "--port", "0", "--devices", "cpu"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if line.startswith("dashboard: "):
                break
        else:
            raise UserError(f"{root}: no server could be started here; is one running? Then name it with --server")
        yield line.removeprefix("dashboard: ").strip()
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(timeout=40)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.bench_live", description=__doc__)
    parser.add_argument("workspace")
    parser.add_argument("--server", metavar="URL", help="a running server (default: one is started)")
    parser.add_argument("--size", type=int, default=256, metavar="PIXELS", help="side of the picture (default: 256)")
    parser.add_argument("--seconds", type=float, default=15.0, help="how long to orbit (default: 15)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    console = Console(json_mode=options.json)
    try:
        result = bench(options.workspace, options.server, size=options.size, seconds=options.seconds, console=console)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    for line in lines(result):
        console.say(line)
    console.result(result)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

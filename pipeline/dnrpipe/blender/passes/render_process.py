"""A Blender process that renders one scene of source.blend, view after view.

Cycles keeps its BVH and images between frames (persistent data) only while nothing else is rendered in
the process: one frame of any other scene, even with Workbench, drops them. Measured with 540,000
triangles, CPU seconds per 256² G-buffer: 0.03 alone, 0.33 in turn with another scene. So G-buffer,
coverage and raster colour each get a process.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

from dnrpipe.core.errors import UserError
from dnrpipe.workers.processes import die_with_parent
from dnrtrain.contract import View

from ..tasks import FrameCosts, FrameFailure, PassesCommon

Kind = Literal["gbuffer", "coverage", "raster"]


class RenderProcess:
    """The parent's end. ``process(view, path)`` renders one view to an EXR file."""

    def __init__(self, kind: Kind, common: PassesCommon) -> None:
        self.kind = kind
        self.common = common
        self.process: Any = None
        self.connection: Connection | None = None

    def __call__(self, view: View, path: Path) -> FrameCosts:
        """Render a frame and say what it took.

        Raises UserError for unusable input, RuntimeError when rendering fails or the process dies; the
        next call starts a new process.
        """
        connection = self.connection or self._start()
        try:
            connection.send((view, path))
            answer = connection.recv()
        except (EOFError, OSError):
            raise RuntimeError(f"the {self.kind} renderer {self._exit_reason()}") from None
        if "error" in answer:
            raise (UserError if answer["input"] else RuntimeError)(answer["error"])
        return answer

    def _start(self) -> Connection:
        context = multiprocessing.get_context("spawn")  # bpy does not survive a fork
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, self.kind, self.common, os.getpid()), daemon=True)
        self.process.start()
        theirs.close()  # so that its end is seen here
        return self.connection

    def _exit_reason(self) -> str:
        self.process.join(10)
        code = self.process.exitcode
        self.process, self.connection = None, None
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"


def _serve(connection: Connection, kind: Kind, common: PassesCommon, parent: int) -> None:
    """Body of the process: a renderer is made at the first task, so that its errors reach the parent."""
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    draw: Callable[[View, Path], None] | None = None
    while True:
        try:
            view, path = connection.recv()
        except EOFError:
            os._exit(0)  # bpy may crash in its own shutdown
        started, cpu = time.perf_counter(), time.process_time()
        try:
            if draw is None:
                from .drawing import make_renderer

                draw = make_renderer(kind, common)
            draw(view, path)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            answer: FrameCosts | FrameFailure = {
                "seconds": time.perf_counter() - started,
                "cpu_seconds": time.process_time() - cpu,
                "peak_mb": peak / (1 << 20 if sys.platform == "darwin" else 1 << 10),
            }
        except Exception as error:  # handed to the parent, the traceback goes to the log
            import traceback

            traceback.print_exc()
            reason = " ".join(str(error).split()) or type(error).__name__
            answer = {"error": reason, "input": isinstance(error, UserError)}
        connection.send(answer)

"""Worker that renders one scene of source.blend, view after view.

Cycles keeps its BVH and images between frames (persistent data) only while nothing else is rendered in
the process: one frame of any other scene, even with Workbench, drops them. Measured with 540,000
triangles, CPU seconds per 256² G-buffer: 0.03 alone, 0.33 in turn with another scene. So G-buffer,
coverage and raster colour each get a process.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dnrpipe.raytrace.tasks import Costs, costs_since
from dnrtrain.contract import View

from ..tasks import PassesCommon
from .drawing import make_renderer


class Worker:
    """Renders frames. common: a `PassesCommon` with "kind", of `make_renderer`; task: "view" and "path" (.exr)."""

    def __init__(self, common: dict[str, Any]) -> None:
        self.kind, self.common = common["kind"], PassesCommon.model_validate(common)
        self.draw: Callable[[View, Path], None] | None = None

    def __call__(self, task: dict[str, Any]) -> Costs:
        started = time.monotonic(), time.process_time()
        self.draw = self.draw or make_renderer(self.kind, self.common)  # part of the first frame's costs
        self.draw(View.model_validate(task["view"]), Path(task["path"]))
        return costs_since(*started)

"""The artist's own renderer as a baseline: frames of Cycles, measured against Cycles' own reference.

The two path tracers do not agree to the last decibel (docs/fidelity.md), so each is judged by its own converged
picture: Cycles by a reference with as many samples as ours, raw, with another seed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import TypeAdapter

from dnrtrain.display import DisplayTransform

from ...blender.tasks import CyclesAnswer
from ...core.scene_files import read_frame, read_record
from ...core.workspace import Workspace
from ..cells.tasks import FileWorker
from ..frames.scene import shown
from .path_tracing_worker import load_lpips, masks_of, quality_of, read_rgba
from .records import CYCLES_PREFIX, BaselineFile, BaselinePoint, CyclesMeasureTask

REFERENCE = "reference"


class Worker(FileWorker):
    """Names begin with ``Cycles``."""

    TASK = TypeAdapter(CyclesMeasureTask)

    def answer(self, task: CyclesMeasureTask) -> BaselineFile:
        workspace = Workspace.open(task.workspace)
        frames = read_record(task.frames, CyclesAnswer)
        display = DisplayTransform(read_frame(workspace), workspace.scene)

        def pictures(name: str) -> list[Any]:
            return [shown(display, read_rgba(task.folder / name / f"{view}.exr")) for view in task.views]

        truth, masks, lpips = pictures(REFERENCE), masks_of(workspace, task.views), load_lpips()
        points = [
            BaselinePoint(
                name=CYCLES_PREFIX + name,
                spp=int(name.split()[0]),
                denoised=not name.endswith("raw"),
                ms=float(np.median(ms)),
                **quality_of(pictures(name), truth, masks, lpips),
            )
            for name, ms in frames.ms.items()
        ]
        return BaselineFile(threads=frames.threads, baselines=points)

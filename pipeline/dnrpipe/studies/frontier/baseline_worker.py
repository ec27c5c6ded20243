"""The baselines in the same run: path tracing of the test views, raw and denoised, and Cycles, in a worker process.

Their pictures are measured as those of the cells are. Path tracing is judged by the same references, its frames and a
base image are timed by one clock. Cycles does not agree with it to the last decibel (docs/fidelity.md), so it is judged
by its own converged picture: with as many samples as ours, raw, with another seed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from pydantic import TypeAdapter

from dnrtrain.display import DisplayTransform
from dnrtrain.exr import read_exr
from dnrtrain.perceptual import build_lpips

from ...blender.tasks import CyclesAnswer
from ...core.images import mean_known, over_white, read_rgba
from ...core.scene_files import read_frame, read_record, split_views
from ...core.workspace import Workspace
from ...stages.trainer import perceptual_weights
from ..cells.measure import view_metrics
from ..cells.tasks import FileWorker
from ..frames.baselines import METHODS as ALL
from ..frames.baselines import make_baselines, render_baselines
from ..frames.ours import BASE, Ours
from ..frames.scene import Clock, open_scene
from .records import CYCLES_PREFIX, BaselineFile, BaselinePoint, CyclesMeasureTask, PathTracingTask

METHODS = ("raw", "colour-fast", "clean16-fast", "clean16")
WARM = 2


class Worker(FileWorker):
    """Milliseconds are medians of processor time over the threads."""

    TASK = TypeAdapter(PathTracingTask | CyclesMeasureTask)

    def answer(self, task: PathTracingTask | CyclesMeasureTask) -> BaselineFile:
        return self._trace(task) if isinstance(task, PathTracingTask) else self._measure_cycles(task)

    def _trace(self, task: PathTracingTask) -> BaselineFile:
        workspace = Workspace.open(task.workspace)
        views = split_views(workspace)["test"]
        scene = open_scene(workspace.root, views, self.threads, task.settings)
        clock = Clock("cpu", self.threads)
        for turn in range(WARM):
            render_baselines(scene, views[0], turn, clock, make_baselines(task.samples, METHODS))
        baselines = make_baselines(task.samples, METHODS)
        for number, view in enumerate(views):
            render_baselines(scene, view, 10_007 * (number + 1), clock, baselines)
        names = [view.name for view in views]
        judge = Judge(workspace, names, [scene.shown(read_rgba(workspace.raytraced("test", name))) for name in names])
        points = [
            BaselinePoint(
                name=baseline.name,
                spp=baseline.spp,
                denoised=ALL[baseline.method].denoise,
                ms=baseline.ms(),
                masked=baseline.masked,
                **judge.means([picture.float() for picture in baseline.pictures]),
            )
            for baseline in baselines.values()
        ]
        base_ms = None
        if task.settings.model.base == "baked":
            ours = Ours(scene, (), task.output.parent / "no-model", smoothed=False)
            ours.frame(views[0], clock)
            frames = [(name, frame) for view in views for name, frame in ours.frame(view, clock).items()]
            parts = [frame["parts"].values() for name, frame in frames if name.startswith(BASE)]
            base_ms = float(np.median([sum(ms) for ms in parts]))
        return BaselineFile(key=task.fingerprint, threads=self.threads, baselines=points, base_ms=base_ms)

    def _measure_cycles(self, task: CyclesMeasureTask) -> BaselineFile:
        workspace = Workspace.open(task.workspace)
        frames = read_record(task.frames, CyclesAnswer)
        display = DisplayTransform(read_frame(workspace), workspace.scene)

        def pictures(name: str) -> list[Any]:
            return [over_white(display, read_rgba(task.folder / name / f"{view}.exr")) for view in task.views]

        judge = Judge(workspace, task.views, pictures("reference"))
        points = [
            BaselinePoint(
                name=CYCLES_PREFIX + name,
                spp=int(name.split()[0]),
                denoised=not name.endswith("raw"),
                ms=float(np.median(ms)),
                **judge.means(pictures(name)),
            )
            for name, ms in frames.ms.items()
        ]
        return BaselineFile(threads=frames.threads, baselines=points)


class Judge:
    """Measures pictures of test views, display RGB, torch [1, 3, H, W] each. truth: likewise."""

    def __init__(self, workspace: Workspace, names: list[str], truth: list[Any]) -> None:
        weights = perceptual_weights(None)
        self.lpips = None if weights is None else build_lpips(weights)
        gbuffers = [read_exr(workspace.passes("test", name))[0] for name in names]
        masks = [torch.from_numpy(np.ascontiguousarray(g["mask"] > 0.5)).float()[None, None] for g in gbuffers]
        self.known = list(zip(truth, masks, strict=True))

    def means(self, pictures: list[Any]) -> dict[str, Any]:
        """Means over the views of the metrics that cells have; None where no view has one."""
        rows = [view_metrics(one, *known, self.lpips) for one, known in zip(pictures, self.known, strict=True)]
        return {key: mean_known(row[key] for row in rows) for key in rows[0]}

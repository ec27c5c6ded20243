"""The baseline in the same run: path tracing of the test views, raw and denoised, and our frames, by one clock.

A worker (see `dnrpipe.workers.processes`) renders them. Their pictures are measured against the same references as the
cells are.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from dnrtrain.exr import read_exr

from ...core.workspace import Workspace
from ..cells.measure import view_metrics
from ..cells.tasks import FileWorker, weights_or_none
from .records import BaselineFile, BaselinePoint, PathTracingTask

METHODS = ("raw", "colour-fast", "clean16-fast", "clean16")
WARM = 2


class Worker(FileWorker):
    """Milliseconds are medians of processor time over the threads."""

    TASK = TypeAdapter(PathTracingTask)

    def answer(self, task: PathTracingTask) -> BaselineFile:
        from ...core.scene_files import split_views
        from ..frames.baselines import METHODS as ALL
        from ..frames.baselines import make_baselines, render_baselines
        from ..frames.ours import BASE, TIMED, Ours
        from ..frames.scene import Clock, open_scene

        workspace, settings = Workspace.open(task.workspace), task.settings
        views = split_views(workspace)["test"]
        scene = open_scene(workspace.root, views, self.threads, settings)
        clock = Clock("cpu", self.threads)
        for turn in range(WARM):
            render_baselines(scene, views[0], turn, clock, make_baselines(task.samples, METHODS))
        baselines = make_baselines(task.samples, METHODS)
        for number, view in enumerate(views):
            render_baselines(scene, view, 10_007 * (number + 1), clock, baselines)
        names = [view.name for view in views]
        truth = [scene.shown(read_rgba(workspace.raytraced("test", name))) for name in names]
        masks = masks_of(workspace, names)
        lpips = load_lpips()
        points = [
            BaselinePoint(
                name=baseline.name,
                spp=baseline.spp,
                denoised=ALL[baseline.method].denoise,
                ms=baseline.ms(),
                masked=baseline.masked,
                **quality_of([picture.float() for picture in baseline.pictures], truth, masks, lpips),
            )
            for baseline in baselines.values()
        ]
        base_ms = None
        if settings.model.base == "baked" and settings.model.base in TIMED:
            ours = Ours(scene, (), task.output.parent / "no-model")
            ours.frame(views[0], clock)
            frames = [next(iter(ours.frame(view, clock).items())) for view in views]
            base_ms = float(
                np.median([sum(frame["parts"].values()) for name, frame in frames if name.startswith(BASE)])
            )
        return BaselineFile(key=task.fingerprint, threads=self.threads, baselines=points, base_ms=base_ms)


def read_rgba(path: Path) -> np.ndarray:
    """RGBA of a picture's file, [H, W, 4]."""
    channels, _ = read_exr(path)
    return np.stack([channels[channel] for channel in "RGBA"], axis=-1)


def masks_of(workspace: Workspace, names: list[str]) -> list[Any]:
    """Object masks of test views, torch [1, 1, H, W]."""
    import torch

    gbuffers = [read_exr(workspace.passes("test", name))[0] for name in names]
    return [torch.from_numpy(np.ascontiguousarray(g["mask"] > 0.5)).float()[None, None] for g in gbuffers]


def load_lpips() -> Any:
    """LPIPS networks by name, None where there are no weights."""
    from dnrtrain.perceptual import build_lpips

    weights = weights_or_none()
    return None if weights is None else build_lpips(weights)


def quality_of(pictures: list[Any], truth: list[Any], masks: list[Any], lpips: Any) -> dict[str, Any]:
    """Means over the views of the metrics that cells have."""
    rows = [view_metrics(*one, lpips) for one in zip(pictures, truth, masks, strict=True)]
    return {
        key: float(np.mean(values)) if (values := [row[key] for row in rows if row[key] is not None]) else None
        for key in rows[0]
    }

"""The rival of every evaluation: path tracing at a few samples with a denoiser, timed on test views.

A ray-traced reference has hundreds of samples, which nobody pays for who has a denoiser. What the renderer must be
compared with is the cheapest path tracing that is as good.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import View

from ..effects.store import lenses
from ..raytrace.variants import choose_variant
from .records import BaselineRung
from .shots.frame_tasks import FrameTask, Way
from .shots.references import compared, display_of, shown
from .shots.render_frames import frame_outcomes
from .shots.renderers import path_tracer
from .stage import Run

LADDER, SEED = (1, 4, 16, 64), 3
"""Samples per pixel, and of their random numbers."""


def measure_baseline(run: Run, views: Sequence[View], truths: dict[str, Any], lpips: Any) -> list[BaselineRung]:
    """Path tracing at the samples of LADDER, denoised, with what a frame takes; means of the views.

    Args:
        truths: references by view name, display RGB over white, torch [1, 3, H, W].
        lpips: LPIPS with AlexNet, or None.

    [] where this machine has no jit variant of Mitsuba, or where a frame failed twice, which is told.
    """
    if choose_variant(run.settings.raytrace.variant).variant.startswith("scalar"):
        return []
    tracer, display = path_tracer(run, background=False), display_of(run)
    known = lenses(run.workspace, run.settings) if run.effect_plan.on("depth-of-field") else {}
    rows: dict[int, list[tuple[float, dict[str, float]]]] = {}
    with tempfile.TemporaryDirectory() as scratch, run.console.bar("rival", len(LADDER) * len(views)) as bar:
        tasks = [
            FrameTask(
                view=view,
                way=Way(name="path", spp=spp),
                lens=known.get(view.name),
                seed=SEED,
                output=Path(scratch) / f"{spp}-{view.name}.exr",
                picture=Path(scratch) / f"{spp}-{view.name}.png",
                fingerprint="",
            )
            for spp in LADDER
            for view in views
        ]
        for task, outcome in zip(tasks, frame_outcomes(run, tracer, tasks, "rival"), strict=True):
            if outcome.result is None:
                run.console.warn(f"path tracing with a denoiser was not measured: {outcome.error}")
                return []
            seconds = outcome.result["seconds"]
            size = {"width": task.view.width, "height": task.view.height}
            run.book("evaluation", "view", f"rival/{task.output.stem}", seconds, spp=task.way.spp, **size)
            figures = compared(shown(display, task.output), truths[task.view.name], lpips)
            rows.setdefault(task.way.spp, []).append((seconds, figures))
            bar.advance()
    return [
        BaselineRung(
            spp=spp,
            seconds=float(np.median([seconds for seconds, _ in found])),
            psnr=float(np.mean([figures["psnr"] for _, figures in found])),
            lpips=float(np.mean([f["lpips"] for _, f in found])) if "lpips" in found[0][1] else None,
        )
        for spp, found in rows.items()
    ]

"""Held-out frames of a finished shot against references that are traced for it.

Their number of pictures (notation: `references`) is doubled until their noise is at most NOISE of the error.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...core.cameras import spread
from ...core.images import flip_error, picture_of, write_png
from ...core.workspace import digest
from ..stage import Run
from .frame_tasks import FrameTask, Way
from .records import Check, ShotFrame
from .references import FEWEST, SEED, SPP, Truth, compared, decibels, display_of, shown
from .render_frames import frame_path, render_frames
from .renderers import Renderer

MOST = 256
"""Samples of a picture A_i at most. Of a path-traced frame it has four times that one's, whose denoiser's bias is to
show."""
PICTURES = 8
"""k at most."""
NOISE = 0.25


def held_out(frames: Sequence[ShotFrame], count: int) -> list[int]:
    """Places of the frames to check: spread over the shot; of those with moving things one, where there are any."""
    still = [i for i, frame in enumerate(frames) if not frame.moving]
    moving = [i for i, frame in enumerate(frames) if frame.moving]
    if not moving or not still:
        return list(spread(still or moving, count))
    return sorted([*spread(still, max(1, count - 1)), *spread(moving, 1)])


@dataclass(frozen=True)
class Held:
    """A frame to check. tracer: path traces it. way: how it was rendered."""

    frame: ShotFrame
    tracer: Renderer
    way: Way

    @property
    def spp(self) -> int:
        """Samples per pixel of a picture A_i."""
        return min(MOST, max(SPP, 4 * self.way.spp)) if self.way.name == "path" else SPP

    def task(self, folder: Path, inputs: Any, number: int) -> FrameTask:
        """Renders A_number."""
        stem = folder / "check" / "traced" / f"{self.frame.number:05d}-{number}"
        way = Way(name="path", spp=self.spp)
        decides = ["check", inputs, self.frame.model_dump(mode="json"), way.model_dump(mode="json"), number]
        return FrameTask(
            view=self.frame.view,
            way=way,
            lens=self.frame.lens,
            seed=SEED + number,
            output=stem.with_suffix(".exr"),
            picture=stem.with_suffix(".png"),
            fingerprint=digest(decides),
        )


def check(run: Run, held: Sequence[Held], folder: Path, inputs: Any, lpips: Any) -> Check:
    """Trace the frames and compare; pictures of both and of the error lie in ``check/``."""
    started, display = time.monotonic(), display_of(run)
    rows: list[dict[str, float]] = []
    groups: dict[int, list[Held]] = {}
    for one in held:
        groups.setdefault(id(one.tracer), []).append(one)
    for due in groups.values():
        count, tracer = FEWEST, due[0].tracer
        while due:
            tasks = [[one.task(folder, inputs, number) for number in range(count)] for one in due]
            flat = [task for own in tasks for task in own]
            render_frames(run, tracer, flat, label="frames to check by", purpose="evaluation")
            noisy = []
            for one, own in zip(due, tasks, strict=True):
                ours: Any = shown(display, frame_path(folder, one.frame))
                truth = Truth.of([shown(display, task.output) for task in own])
                error = truth.error(ours)
                if truth.noise > NOISE * error and count < PICTURES:
                    noisy.append(one)
                    continue
                stem = folder / "check" / f"{one.frame.number:05d}"
                flip, heat = flip_error(picture_of(truth.picture[0]), picture_of(ours[0]))
                write_png(stem.with_suffix(".truth.png"), picture_of(truth.picture[0]))
                write_png(stem.with_suffix(".ours.png"), picture_of(ours[0]))
                write_png(stem.with_suffix(".error.png"), heat)
                found = {
                    **compared(ours, truth.picture, lpips),
                    "flip": flip,
                    "noise": truth.noise / error,
                    "error": error,
                }
                rows.append({"number": one.frame.number, "spp": count * one.spp, **found})
            due, count = noisy, 2 * count
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return Check(
        frames=tuple(sorted(int(row["number"]) for row in rows)),
        spp=round(mean["spp"]),
        noise=mean["noise"],
        psnr=float(np.mean([decibels(row["error"]) for row in rows])),
        ssim=mean["ssim"],
        lpips=mean.get("lpips"),
        flip=mean["flip"],
        seconds=time.monotonic() - started,
    )

"""Held-out frames of a finished shot against references that are traced for it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.cameras import spread
from ...core.images import flip_error, picture_of, write_png
from ...core.workspace import digest
from ..stage import Run
from .frame_tasks import FrameTask, Way
from .pilot import REFERENCE_SEED, compared, display_of, shown
from .records import Check, ShotFrame
from .render_frames import frame_path, render_frames
from .renderers import Renderer

SPP = 256


def held_out(frames: Sequence[ShotFrame], count: int) -> list[int]:
    """Places of the frames to check: spread over the shot; of those with moving things one, where there are any."""
    still = [i for i, frame in enumerate(frames) if not frame.moving]
    moving = [i for i, frame in enumerate(frames) if frame.moving]
    if not moving or not still:
        return list(spread(still or moving, count))
    return sorted([*spread(still, max(1, count - 1)), *spread(moving, 1)])


def check(
    run: Run,
    tracers: Sequence[tuple[Renderer, list[int]]],
    frames: Sequence[ShotFrame],
    folder: Path,
    inputs: Any,
    lpips: Any,
) -> Check:
    """Trace the frames and compare; pictures of both and of the error lie in ``check/``.

    tracers: (path tracer, places of the frames to check by it).
    """
    started, display = time.monotonic(), display_of(run)
    way = Way(name="path", spp=SPP)
    rows: list[dict[str, float]] = []
    numbers: list[int] = []
    for tracer, places in tracers:
        tasks = []
        for place in places:
            frame = frames[place]
            stem = folder / "check" / f"{frame.number:05d}"
            tasks.append(
                FrameTask(
                    view=frame.view,
                    way=way,
                    lens=frame.lens,
                    seed=REFERENCE_SEED,
                    output=stem.with_suffix(".exr"),
                    picture=stem.with_suffix(".truth.png"),
                    fingerprint=_fingerprint(inputs, frame, way),
                )
            )
        render_frames(run, tracer, tasks, label="frames to check by", purpose="evaluation")
        for place, task in zip(places, tasks, strict=True):
            frame = frames[place]
            ours, truth = shown(display, frame_path(folder, frame)), shown(display, task.output)
            flip, heat = flip_error(picture_of(truth[0]), picture_of(ours[0]))
            write_png(task.output.with_suffix(".error.png"), heat)
            write_png(task.output.with_suffix(".ours.png"), picture_of(ours[0]))
            rows.append({**compared(ours, truth, lpips), "flip": flip})
            numbers.append(frame.number)
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return Check(
        frames=tuple(numbers),
        spp=SPP,
        psnr=mean["psnr"],
        ssim=mean["ssim"],
        lpips=mean.get("lpips"),
        flip=mean["flip"],
        seconds=time.monotonic() - started,
    )


def _fingerprint(inputs: Any, frame: ShotFrame, way: Way) -> str:
    return digest(["check", inputs, frame.model_dump(mode="json"), way.model_dump(mode="json")])

"""A shot from its cameras to the finished frames: measure, choose, render, check.

Everything lies in ``shots/NAME`` of the workspace: ``frames/`` (EXR), ``pictures/`` (PNG), ``NAME.mp4``, ``check/``,
``shot.json``. A run that was interrupted goes on with what is missing.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dnrtrain.records import write

from ...core.scene_files import scene_fingerprint
from ...core.units import duration
from ...core.workspace import digest, file_sha256
from ..base_images import BASE_VERSION
from ..session import Session
from ..stage import Run
from ..trainer import perceptual_weights
from .check import check, held_out
from .options import Option, Wanted, choose
from .plan_shot import equal_rung_of, lines, weigh
from .records import RECORD, ShotFrame, ShotRecord, facts
from .render_frames import frame_tasks, picture_path, render_frames, write_movie
from .renderers import Renderer, path_tracer, shipped_renderer, trained_renderer

CHECKED = 2
"""Frames of a shot that are traced to check it."""


@dataclass(frozen=True)
class Shot:
    """A shot to be made in a prepared workspace.

    Args:
        moving: what changes over its frames, in words, by name.
        background: the camera sees the world behind everything.
        at_frame: converts the scene at a frame -> its bundle.
    """

    name: str
    frames: Sequence[ShotFrame]
    moving: dict[str, str]
    fps: float
    background: bool
    wanted: Wanted
    at_frame: Callable[[Run, int], Path]


@dataclass(frozen=True)
class Planned:
    """options: what was weighed. chosen: of them. ours: renders with baked light, where it was weighed."""

    options: list[Option]
    chosen: Option
    why: str
    ours: Renderer | None
    seconds: float


def plan_shot(session: Session, shot: Shot) -> Planned:
    """Measure ways to make the shot on small frames, choose, and say so."""
    started = time.monotonic()
    run = session.run.for_stage("render")
    tracer = path_tracer(run, shot.background)
    options, ours = weigh(run, shot.frames, folder_of(run, shot) / "pilot", shot.wanted, tracer, lpips_of(run))
    chosen, why = choose(options, shot.wanted)
    for line in lines(options, chosen, why):
        run.console.say(line)
    return Planned(options, chosen, why, ours, time.monotonic() - started)


def make_shot(session: Session, shot: Shot, planned: Planned) -> ShotRecord:
    """Carry the plan out: train where it says so, render all frames, make the movie, check.

    Raises UserError, TasksFailed: as the stages do.
    """
    started = time.monotonic()
    run, chosen = session.run.for_stage("render"), planned.chosen
    folder, tracer = folder_of(run, shot), path_tracer(run, shot.background)
    renderer = tracer
    if chosen.way.name != "path":
        renderer = planned.ours or shipped_renderer(run, shot.background)
        if chosen.views:
            session.settings = session.settings.with_budget(chosen.views)
            session.stages("select", "raytrace", "finetune")
            run = session.run.for_stage("render")
            renderer = trained_renderer(run, shot.background)
    inputs = _inputs(run, renderer)
    still = [place for place, frame in enumerate(shot.frames) if not frame.moving]
    render_frames(
        run,
        renderer.common,
        renderer.environment,
        frame_tasks(shot.frames, folder, chosen.way, inputs, still),
        label=f"frames by {chosen.way.told}",
    )
    moving = [place for place, frame in enumerate(shot.frames) if frame.moving]
    moving_way = equal_rung_of(planned.options, chosen) if moving else None
    tracers = [(tracer, still)]
    for place in moving:
        assert moving_way is not None
        own = tracer.of_bundle(shot.at_frame(run, shot.frames[place].number))
        tracers.append((own, [place]))
        tasks = frame_tasks(shot.frames, folder, moving_way, inputs, [place])
        label = f"frame {shot.frames[place].number} by {moving_way.told}"
        render_frames(run, own.common, own.environment, tasks, label=label)
    movie = folder / f"{shot.name}.mp4"
    write_movie(movie, [picture_path(folder, frame) for frame in shot.frames], shot.fps)
    spent = time.monotonic() - started
    places = set(held_out(shot.frames, CHECKED))
    checked = [(own.common, own.environment, sorted(places & set(of_it))) for own, of_it in tracers]
    found = check(run, [row for row in checked if row[2]], shot.frames, folder, inputs, lpips_of(run))
    record = ShotRecord(
        name=shot.name,
        scene=run.workspace.manifest.source.path,
        **facts(shot.frames),
        fps=shot.fps,
        moving=shot.moving,
        options=tuple(planned.options),
        chosen=chosen,
        why=planned.why,
        still_way=chosen.way,
        moving_way=moving_way,
        expected=chosen.seconds,
        spent_before=planned.seconds,
        spent=spent,
        check=found,
        movie=str(movie),
    )
    write(folder / RECORD, record)
    _tell(run, record)
    return record


def folder_of(run: Run, shot: Shot) -> Path:
    folder = run.workspace.root / "shots" / shot.name
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def lpips_of(run: Run) -> Any:
    """LPIPS with AlexNet, or None where its weights are missing."""
    weights = perceptual_weights(run.console)
    if weights is None:
        return None
    from dnrtrain.perceptual import build_lpips

    return build_lpips(weights)["alex"]


def _inputs(run: Run, renderer: Renderer) -> str:
    """Hash of all that decides a frame but its view and way."""
    common = renderer.common.model_dump(mode="json")
    model: list[str] = []
    if renderer.common.checkpoint is not None:
        model = [file_sha256(renderer.common.checkpoint / "model.safetensors")]
    elif renderer.common.base is not None:
        from dnrtrain.shipped import WEIGHTS

        model = [file_sha256(WEIGHTS)]
    light = base_fingerprint(run) if renderer.common.base is not None else ""
    return digest([BASE_VERSION, scene_fingerprint(run.workspace), common, model, light])


def base_fingerprint(run: Run) -> str:
    from ..base_images import base_renderer

    return base_renderer(run.workspace, run.settings, run.effect_plan).fingerprint


def _tell(run: Run, record: ShotRecord) -> None:
    spent, expected = duration(record.spent), duration(record.expected)
    run.console.say(f"{len(record.frames)} frames in {spent} (expected {expected})")
    if record.check is not None:
        told = f"{record.check.psnr:.2f} dB"
        if record.check.lpips is not None:
            told += f", LPIPS {record.check.lpips:.4f}"
        aim = "" if record.chosen.psnr is None else f" (expected {record.chosen.psnr:.2f} dB)"
        frames = ", ".join(map(str, record.check.frames))
        run.console.say(f"checked on frames {frames}, traced with {record.check.spp} samples: {told}{aim}")
    if record.movie is not None:
        run.console.say(record.movie)

"""A shot from its cameras to the finished frames: measure, choose, render, check.

Everything lies in ``shots/NAME`` of the workspace: ``frames/`` (EXR), ``pictures/`` (PNG), ``NAME.mp4``, ``check/``,
``shot.json``. A run that was interrupted goes on with what is missing.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dnrtrain.records import read, write

from ...core.scene_files import read_summary, scene_fingerprint
from ...core.settings import Settings
from ...core.units import duration
from ...core.workspace import digest, file_sha256
from ...workers.processes import KeptWorker
from ..base_images import BASE_VERSION, DENOISE_VERSION, LIGHT_VERSION, SPP, base_renderer, light_plan
from ..effect_plan import resolve_plan
from ..render import write_mp4
from ..session import Session
from ..shot_scene import convert_frames, scene_at
from ..stage import Run
from ..trainer import perceptual_weights
from .check import Held, check, held_out
from .frame_tasks import Way
from .options import Wanted, choose
from .plan_shot import lines, moving_way, weigh
from .records import PLAN, RECORD, ShotFrame, ShotPlan, ShotRecord, facts
from .render_frames import (
    FRAMES_FOLDER,
    PICTURES_FOLDER,
    be_ready,
    frame_tasks,
    is_whole,
    pictures,
    render_frames,
)
from .renderers import Renderer, path_tracer, shipped_renderer, trained_renderer

CHECKED = 2
"""Frames of a shot that are traced to check it."""
PLAN_VERSION = 23
LIGHT_SIDE, MORE = 1024, (1, 2, 4)
"""Texels of the light map's side, and times as many paths a texel for more pixels."""
BATCH = 8
"""Bundles of single frames that are on disk at once."""


@dataclass(frozen=True)
class Shot:
    """A shot to be made in a prepared workspace.

    Args:
        moving: what changes over its frames, in words, by name.
        background: the camera sees the world behind everything.
    """

    name: str
    frames: Sequence[ShotFrame]
    moving: dict[str, str]
    fps: float
    background: bool
    wanted: Wanted


def plan_shot(session: Session, shot: Shot, kept: KeptWorker) -> ShotPlan:
    """Measure ways to make the shot on small frames, choose, and say so. A plan of the same shot is kept.

    kept: what renders them.
    """
    started = time.monotonic()
    choose_light(session, shot.frames, shot.wanted.planned(len(shot.frames)))
    run = _run(session, kept)
    tracer, path = path_tracer(run, shot.background), folder_of(run, shot) / PLAN
    lpips = lpips_of(run)
    inputs = [
        lpips is not None,  # without it, PSNR alone decides
        BASE_VERSION,
        LIGHT_VERSION,
        DENOISE_VERSION,
        tracer.decides(run),
        run.scene_fingerprint,
        shot.wanted.model_dump(mode="json"),
    ]
    frames = [frame.model_dump(mode="json") for frame in shot.frames]
    settings = run.settings.model_dump(mode="json", exclude={"executor": True, "cameras": {"source"}})  # not where
    fingerprint = digest([PLAN_VERSION, *inputs, frames, settings])
    plan = read(path, ShotPlan) if path.exists() and not session.options["force"] else None
    if plan is None or plan.fingerprint != fingerprint:
        be_ready(run, tracer)
        options, trust = weigh(run, shot.frames, folder_of(run, shot) / "pilot", shot.wanted, tracer, lpips)
        chosen, why = choose(options, shot.wanted)
        plan = ShotPlan(
            fingerprint=fingerprint,
            options=tuple(options),
            chosen=chosen,
            why=why,
            trust=trust,
            seconds=time.monotonic() - started,
        )
        write(path, plan)
    for line in lines(plan.options, plan.chosen, plan.why):
        run.console.say(line)
    return plan


def choose_light(session: Session, frames: Sequence[ShotFrame], planned: int | None = None) -> None:
    """Choose what no setting says of the light map (`shot_light`).

    planned: frames, of which these are some; None: these alone.

    The choice is not remembered as flags are: the next shot has other frames.
    """
    pixels = sum(frame.view.width * frame.view.height for frame in frames if not frame.moving)
    session.settings = shot_light(session.run.for_stage("render"), pixels * (planned or len(frames)) // len(frames))


def shot_light(run: Run, pixels: int) -> Settings:
    """The run's settings with what suits a shot of so many pixels where they leave the light map's to us.

    Its paths go where the shot looks. There are more of them (MORE) as long as the shot has as many pixels, so that
    light takes a small part of the time (figures: docs/experiments.md).
    """
    settings, plan = run.settings, resolve_plan(run)
    side = LIGHT_SIDE * (2 if read_summary(run.workspace.scene).atlas.loses_most else 1)
    spp = SPP["gathered" if light_plan(settings, plan).gathered else "traced"]
    found = []
    for more in MORE:
        chosen = {"light_where": "seen", "light_size": side, "light_spp": spp * more}
        left = {name: value for name, value in chosen.items() if getattr(settings.base, name) == "auto"}
        found.append(settings.model_copy(update={"base": settings.base.model_copy(update=left)}))
    return [each for each in found if each is found[0] or light_plan(each, plan).paths <= pixels][-1]


def make_shot(session: Session, shot: Shot, plan: ShotPlan, kept: KeptWorker) -> ShotRecord:
    """Carry the plan out: train where it says so, render all frames, make the movie, check.

    kept: as of `plan_shot`; what rendered its pictures renders the frames, too, where they are of the same kind.

    Raises UserError, TasksFailed: as the stages do.
    """
    started = time.monotonic()
    run, chosen = _run(session, kept), plan.chosen
    folder, tracer = folder_of(run, shot), path_tracer(run, shot.background)
    if session.options["force"]:
        for made in (FRAMES_FOLDER, PICTURES_FOLDER, "check"):
            shutil.rmtree(folder / made, ignore_errors=True)
    if chosen.way.name == "path":
        renderer = tracer
    elif chosen.views:
        kept.close()  # training wants the memory
        session.settings = session.settings.with_budget(chosen.views)
        session.stages("select", "raytrace", "finetune")
        run = _run(session, kept)
        renderer = trained_renderer(run, shot.background)
    else:
        assert plan.trust is not None  # ways with baked light were weighed
        renderer = shipped_renderer(run, shot.background, plan.trust)
    inputs = _inputs(run, renderer)
    still = [place for place, frame in enumerate(shot.frames) if not frame.moving]
    trained = chosen.views > 0
    tasks = frame_tasks(shot.frames, folder, chosen.way, inputs, still, renderer.trust, alone=trained)
    render_frames(run, renderer, tasks, label=f"frames by {chosen.way.told}")
    places = held_out(shot.frames, CHECKED)
    way_of_moving = render_moving(run, shot, plan, tracer, inputs, places)
    movie = folder / f"{shot.name}.mp4"
    write_mp4(movie, pictures(folder, shot.frames), shot.fps, edge=True)
    spent = time.monotonic() - started
    held = [_held(run, shot.frames[place], tracer, chosen.way, way_of_moving) for place in places]
    found = check(run, held, folder, inputs, lpips_of(run))
    shutil.rmtree(scene_at(run.workspace, 0).parent, ignore_errors=True)  # bundles of single frames
    record = ShotRecord(
        name=shot.name,
        scene=run.workspace.manifest.source.path,
        **facts(shot.frames),
        fps=shot.fps,
        moving=shot.moving,
        options=plan.options,
        chosen=chosen,
        why=plan.why,
        still_way=chosen.way,
        moving_way=way_of_moving,
        expected=chosen.seconds,
        spent_before=plan.seconds,
        spent=spent,
        check=found,
        movie=str(movie),
    )
    write(folder / RECORD, record)
    _tell(run, record)
    return record


def render_moving(
    run: Run, shot: Shot, plan: ShotPlan, tracer: Renderer, inputs: str, checked: Sequence[int]
) -> Way | None:
    """Path trace the frames in which things move, each of the scene as it is then -> how; None: there are none.

    Bundles of frames that are ``checked`` stay; the others would fill the disk.
    """
    moving = [place for place, frame in enumerate(shot.frames) if frame.moving]
    if not moving:
        return None
    folder, way = folder_of(run, shot), moving_way(plan.options, plan.chosen)
    tasks = dict(zip(moving, frame_tasks(shot.frames, folder, way, inputs, moving), strict=True))
    due = [place for place in moving if place in checked or not is_whole(tasks[place])]
    if due and run.kept is not None:
        run.kept.close()  # conversion wants the memory, and each frame a process of its own
    for batch in (due[first : first + BATCH] for first in range(0, len(due), BATCH)):
        convert_frames(run, [shot.frames[place].number for place in batch])
        for place in batch:
            number = shot.frames[place].number
            own = tracer.at_frame(run, number)
            render_frames(run, own, [tasks[place]], label=f"frame {number} by {way.told}")
            if place not in checked:
                shutil.rmtree(scene_at(run.workspace, number))
    return way


def _run(session: Session, kept: KeptWorker) -> Run:
    return replace(session.run.for_stage("render"), kept=kept)


def _held(run: Run, frame: ShotFrame, tracer: Renderer, way: Way, way_of_moving: Way | None) -> Held:
    if not frame.moving:
        return Held(frame, tracer, way)
    return Held(frame, tracer.at_frame(run, frame.number), way_of_moving or way)


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
    model: list[str] = []
    if renderer.common.checkpoint is not None:
        model = [file_sha256(renderer.common.checkpoint / "model.safetensors")]
    elif renderer.common.base is not None:
        from dnrtrain.shipped import WEIGHTS

        model = [file_sha256(WEIGHTS)]
    light = ""
    if renderer.common.base is not None:
        light = base_renderer(run.workspace, run.settings, run.effect_plan).fingerprint
    return digest([BASE_VERSION, scene_fingerprint(run.workspace), renderer.decides(run), model, light])


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

"""All frames of a shot, those that are missing or out of date, and the movie of them."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ...core.ledger import Purpose
from ...core.workspace import digest
from ...raytrace.tasks import remembers_from
from ...workers.placement import HERE
from ...workers.task_list import TaskResult, run_tasks
from ...workers.view_tasks import is_made, warn_of_retries
from ..base_images import is_small
from ..stage import Run
from .frame_tasks import FrameTask, Way
from .records import ShotFrame
from .renderers import Renderer

FRAMES_VERSION = 9
FRAME_WORKER = "dnrpipe.stages.shots.frame_worker"
FRAMES_FOLDER, PICTURES_FOLDER = "frames", "pictures"
"""Of a shot's folder."""


def frame_path(folder: Path, frame: ShotFrame) -> Path:
    """A frame's scene-linear layers."""
    return folder / FRAMES_FOLDER / f"{frame.number:05d}.exr"


def picture_path(folder: Path, frame: ShotFrame) -> Path:
    """A frame as it is displayed."""
    return folder / PICTURES_FOLDER / f"{frame.number:05d}.png"


def frame_tasks(
    frames: Sequence[ShotFrame],
    folder: Path,
    way: Way,
    inputs: Any,
    numbers: Sequence[int] | None = None,
    trust: float = 1.0,
    *,
    alone: bool = False,
) -> list[FrameTask]:
    """The tasks that render the frames by ``way``. A frame of baked light remembers those before it, back to the last
    cut and to where its chunk begins (`tasks.CHUNK`). All are filtered with those next to them (`next_to`).

    inputs: of all that decides a frame but its view and way. numbers: places in ``frames`` to render; None: all.
    trust: see `FrameTask`. alone: no frame remembers, as training saw none that does: measured, 0.5 dB worse.
    """

    def task(place: int) -> FrameTask:
        frame = frames[place]
        first = place
        remembers = way.name != "path" and not alone
        if remembers:
            begin = remembers_from(place)
            while first > begin and goes_on(frames[first - 1], frame):
                first -= 1
        earlier = tuple(other.view for other in frames[first:place]) if remembers else None
        decided = [inputs, trust, frame.view.model_dump(mode="json"), way.model_dump(mode="json"), frame.lens]
        known = None if earlier is None else [first, *(other.model_dump(mode="json") for other in earlier)]
        return FrameTask(
            view=frame.view,
            way=way,
            lens=frame.lens,
            earlier=earlier,
            number=first if remembers else 0,
            trust=trust,
            seed=frame.number % (1 << 16),
            output=frame_path(folder, frame),
            picture=picture_path(folder, frame),
            fingerprint=digest([FRAMES_VERSION, *decided, known]),
        )

    def filtered(place: int) -> FrameTask:
        own = task(place)
        before, after = (None if other is None else task(other) for other in next_to(frames, place))
        prints = [None if each is None else each.fingerprint for each in (before, own, after)]
        others = {"before": before and before.alone, "after": after and after.alone}
        return own.model_copy(update={**others, "fingerprint": digest(prints)})

    return [filtered(place) for place in (range(len(frames)) if numbers is None else numbers)]


def next_to(frames: Sequence[ShotFrame], place: int) -> tuple[int | None, int | None]:
    """Places of the frames before and after one with which it is filtered. None: a cut, or the shot ends; things move,
    whose motion the filter does not know; a lens is out of focus, where no pixel shows one place alone; or three
    pictures are too large for the memory."""
    frame = frames[place]
    if frame.moving or frame.lens is not None or not is_small(frame.view):
        return None, None
    before, after = (
        other if 0 <= other < len(frames) and goes_on(frames[other], frame) else None
        for other in (place - 1, place + 1)
    )
    return before, after


def goes_on(before: ShotFrame, after: ShotFrame) -> bool:
    """Whether two frames belong together: of one camera and one size, and nothing has moved."""
    same = (before.view.width, before.view.height) == (after.view.width, after.view.height)
    return same and before.camera == after.camera and before.moving == after.moving


def is_whole(task: FrameTask) -> bool:
    """Whether both files of a frame are there, made from the same inputs."""
    return task.picture.exists() and is_made(task.data())


def in_succession(tasks: Sequence[FrameTask]) -> list[FrameTask]:
    """The tasks, each but the last with the one that follows it, which is rendered while it is written. Not of pictures
    so large that two of them would take too much memory."""
    after = [following if is_small(task.view) else None for task, following in pairwise(tasks)]
    return [task.model_copy(update={"following": one}) for task, one in zip(tasks, [*after, None], strict=False)]


def be_ready(run: Run, renderer: Renderer) -> None:
    """Start the run's kept process, which gets ready for the renderer's frames while this one goes on."""
    if run.kept is not None:
        run.kept.get(FRAME_WORKER, renderer.common.data(), run.log, renderer.environment)


def render_frames(
    run: Run,
    renderer: Renderer,
    tasks: Sequence[FrameTask],
    *,
    label: str,
    purpose: Purpose = "inference",
) -> None:
    """Render what is missing. Raises TasksFailed, after all others are done. Raises OSError: the disk is full.

    label: of the bar. purpose: what it is booked as.
    """

    def book(task: dict[str, Any], result: dict[str, Any], _workers: int) -> None:
        view = task["view"]
        run.book(
            purpose,
            "view",
            f"{Path(task['output']).parent.name}/{view['name']}",
            result["seconds"] + result["write_seconds"],
            cpu_seconds=result["cpu_seconds"],
            peak_mb=result["peak_mb"],
            width=view["width"],
            height=view["height"],
            spp=result["spp"] or None,
            detail={"way": result["way"], "ms": result["ms"]},
        )

    made: list[FrameTask] = []
    due: list[FrameTask] = []
    for task in tasks:
        if not task.picture.exists():  # a frame is both of its files
            task.output.unlink(missing_ok=True)
        (made if is_whole(task) else due).append(task)
    run.view_tasks(
        label,
        FRAME_WORKER,
        renderer.common.data(),
        [task.data() for task in (*made, *in_succession(due))],
        workers=1,  # its kernels keep all cores busy
        book=book,
        environment=renderer.environment,
        place=HERE,
        kept=run.kept,
    )


def pictures(folder: Path, frames: Sequence[ShotFrame]) -> Iterator[np.ndarray]:
    """The frames as they are displayed, uint8 [H, W, 3], one after the other: memory does not grow with the shot."""
    from PIL import Image

    for frame in frames:
        with Image.open(picture_path(folder, frame)) as image:
            yield np.asarray(image.convert("RGB"))


def frame_outcomes(
    run: Run, renderer: Renderer, tasks: Sequence[FrameTask], label: str
) -> Generator[TaskResult, None, None]:
    """Render frames to be measured, each with the whole machine -> their outcomes, in order, whatever is on disk.

    One that is tried again is rendered last: those after it wait for it.
    """
    outcomes = run_tasks(
        FRAME_WORKER,
        renderer.common.data(),
        [task.data() for task in tasks],
        workers=1,
        log=run.log,
        retried=warn_of_retries(label, run.console),
        environment=renderer.environment,
        kept=run.kept,
    )
    known: dict[Path, TaskResult] = {}
    with closing(outcomes):
        for task in tasks:
            while task.output not in known:
                outcome = next(outcomes)
                known[Path(outcome.task["output"])] = outcome
            yield known.pop(task.output)

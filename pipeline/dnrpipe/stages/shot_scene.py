"""What a scene file says of a shot, and its bundles at other frames than the one that is converted."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from dnrtrain.atomic import write_json

from ..blender.tasks import BakeOptions, PrepareAnswer, SceneAtCommon, SceneAtTask, ShotTask
from ..core.errors import UserError
from ..core.scene_files import read_conversion, read_summary
from ..core.scene_records import Conversion
from ..core.shot_records import ShotFacts
from ..core.workspace import Workspace, digest, sha256_now
from ..workers.task_list import run_tasks
from ..workers.view_tasks import warn_of_retries, worker_count
from .inspect_scene import require_file
from .prepare import BAKES, MAX_BAKE_ROUNDS, bake, open_scene
from .stage import Run

FRAME_VERSION = 3


def look_at_shot(scene: Path, frames: Sequence[int] | None, camera: str | None, log: Path) -> ShotFacts:
    """Ask the scene file for the cameras of a shot's frames, and for what changes over them.

    `core.cameras.shot_views` makes views of it.

    Args:
        frames: rising, of any number; None for the file's own range.
        camera: name of one; None for the active one, which markers of the file may switch.
        log: of the worker.

    Raises UserError: unusable input; no such camera, or one that cannot see or is not a perspective one.
    """
    require_file(scene)
    task = ShotTask(source=scene.resolve(), frames=None if frames is None else tuple(frames), camera=camera)
    return open_scene("dnrpipe.blender.shot", task, ShotFacts, log)[0]


def require_same_scene(workspace: Workspace) -> None:
    """Raises UserError: the scene file is no more the one that the workspace was made from, or it is gone."""
    source = Path(workspace.manifest.source.path)
    if not source.is_file():
        raise UserError(f"{source}: the scene file is gone; moving things are converted from it, frame by frame")
    if sha256_now(source) != workspace.manifest.source.sha256:
        raise UserError(f"{source}: has changed since it was prepared; run `dnrpipe shot {source} -w {workspace.root}`")


def scene_at(workspace: Workspace, frame: int) -> Path:
    """The folder of a frame's bundle: ``scene.xml``, meshes/ and textures/, as in scene/."""
    return workspace.root / "frames" / f"frame{frame:05d}"


def convert_frames(run: Run, frames: Sequence[int]) -> None:
    """Convert the scene at these frames, those that are missing or out of date, each into `scene_at`.

    Only what path tracing needs. Baked textures of the conversion serve again where they hold: a value that does not
    depend on the surface's place is not baked again for an object that moves.

    Raises UserError: nothing is visible at a frame, or the scene file is gone or has changed.
    """
    workspace = run.workspace
    prints = {frame: digest([FRAME_VERSION, run.scene_fingerprint, frame]) for frame in frames}
    todo = [frame for frame in frames if not _is_made(scene_at(workspace, frame), prints[frame])]
    if not todo:
        return
    started = time.monotonic()
    source = Path(workspace.manifest.source.path)
    require_same_scene(workspace)
    size = run.settings.passes.bake_size
    common = SceneAtCommon(
        source=source.resolve(),
        scene_dir=workspace.scene.resolve(),
        bakes=BakeOptions(folder=(workspace.root / BAKES).resolve(), size=size),
        lit=read_summary(workspace.scene).has_light,
    )
    refused: list[str] = []
    with run.console.bar("frames of the scene", len(todo)) as bar:
        for _ in range(MAX_BAKE_ROUNDS):
            waiting = []
            for frame, answer in _answers(run, common, todo, tuple(refused)):
                if answer.bakes is not None:
                    waiting.append((frame, answer.bakes))
                    continue
                require_same_scene(workspace)  # it may have been saved since
                folder = scene_at(workspace, frame)
                shutil.rmtree(folder, ignore_errors=True)
                _fresh(folder).rename(folder)
                write_json(folder / "prepared.json", Conversion(fingerprint=prints[frame], files={}).data())
                bar.advance()
            for frame, pending in waiting:
                refused += bake(run, source, _fresh(scene_at(workspace, frame)) / "geometry.npz", pending)
            todo = [frame for frame, _ in waiting]
            if not todo:
                run.book("inference", "scene", "convert frames", time.monotonic() - started)
                return
    raise RuntimeError(f"{source}: the same textures are to be baked again and again")


def _answers(
    run: Run, common: SceneAtCommon, frames: Sequence[int], refused: tuple[str, ...]
) -> Iterator[tuple[int, PrepareAnswer]]:
    """(frame, what its worker answers), as they come."""
    tasks = [
        SceneAtTask(frame=frame, output=_fresh(scene_at(run.workspace, frame)).resolve(), refused=refused)
        for frame in frames
    ]
    for outcome in run_tasks(
        "dnrpipe.blender.scene_at_frame",
        common.data(),
        [task.data() for task in tasks],
        workers=min(len(tasks), worker_count(run.settings.passes.workers)),
        log=run.log,
        retried=warn_of_retries("frame", run.console),
    ):
        if outcome.result is None:
            raise UserError(str(outcome.error))
        yield SceneAtTask.model_validate(outcome.task).frame, PrepareAnswer.model_validate(outcome.result)


def _fresh(folder: Path) -> Path:
    """Where a folder is filled until it is whole."""
    return folder.with_name(f"{folder.name}.new")


def _is_made(folder: Path, fingerprint: str) -> bool:
    return (folder / "prepared.json").is_file() and read_conversion(folder).fingerprint == fingerprint

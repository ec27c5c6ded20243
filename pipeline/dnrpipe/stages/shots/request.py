"""What `dnrpipe shot` was asked for, from the scene file to the finished shot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dnrtrain.contract import file_name

from ...core.errors import UserError
from ...workers.processes import KeptWorker
from ..session import Session
from ..shot_scene import require_same_scene
from ..trainer import perceptual_weights
from .check import held_out
from .make_shot import CHECKED, Shot, make_shot, plan_shot
from .open_shot import prepare_for, shot_of_cameras, shot_of_scene
from .options import Wanted
from .plan_shot import BAKED_WAYS, require_baked_light


@dataclass(frozen=True)
class ShotRequest:
    """See `dnrpipe shot --help`. numbers: of frames; None: the file's own, as with size, camera and name.

    camera_file: views instead of the file's animation. only_plan: nothing is rendered but the pilot.
    """

    numbers: tuple[int, ...] | None
    size: tuple[int, int] | None
    camera: str | None
    camera_file: Path | None
    wanted: Wanted
    name: str | None
    transparent: bool
    only_plan: bool


def carry_out(session: Session, request: ShotRequest) -> dict[str, Any]:
    """Make the shot, or plan it -> the command's JSON answer.

    Raises UserError: as the stages do, and where an LPIPS is wanted that cannot be measured, or baked light that the
    settings do not bake.
    """
    if request.wanted.lpips is not None and perceptual_weights(None) is None:
        raise UserError("--target-lpips: there are no weights here to measure it by; fetch them with `dnrpipe weights`")
    require_baked_light(session.settings, request.wanted)
    workspace, console = session.workspace, session.console
    if request.camera_file is not None:
        file = shot_of_cameras(request.camera_file, session, request.size)
    else:
        scene, log = Path(workspace.manifest.source.path), session.run.for_stage("prepare").log
        file = shot_of_scene(scene, request.numbers, request.camera, request.size, log)
        require_same_scene(workspace)  # what has been looked at is what the workspace holds
    view = file.frames[0].view
    name = file_name(request.name or (request.camera_file.stem if request.camera_file else file.frames[0].camera))
    cameras = ", ".join(dict.fromkeys(frame.camera for frame in file.frames))
    console.say(f"shot {name}: {len(file.frames)} frames, {view.width}x{view.height}, camera {cameras}")
    for warning in file.warnings:
        console.warn(warning)
    if request.wanted.way in BAKED_WAYS and any(frame.lens is not None for frame in file.frames):
        console.warn(f"--way {request.wanted.way}: the camera has depth of field, and its frames come out sharp")
    for thing, change in file.moving.items():
        console.say(f"  {thing} {change}: path-traced there")
    folder = workspace.root / "shots" / name
    prepare_for(session, folder, file.frames, held_out(file.frames, CHECKED))
    shot = Shot(
        name=name,
        frames=file.frames,
        moving=file.moving,
        fps=file.fps,
        background=not (request.transparent or file.transparent),
        wanted=request.wanted,
    )
    answer = {"workspace": str(workspace.root)}
    with KeptWorker() as kept:
        plan = plan_shot(session, shot, kept)
        return answer | (plan if request.only_plan else make_shot(session, shot, plan, kept)).data()

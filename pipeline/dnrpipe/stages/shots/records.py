"""The frames of a shot, its plan, and what became of it: ``plan.json`` and ``shot.json`` of its folder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict

from dnrtrain.contract import View
from dnrtrain.records import Record

from ...core.scene_records import Lens
from .frame_tasks import Way
from .options import Option

PLAN, RECORD = "plan.json", "shot.json"


class ShotFrame(BaseModel):
    """A frame of the shot.

    Args:
        number: of the scene's timeline. camera: its name.
        lens: of a camera with depth of field, scene units.
        moving: names of what is elsewhere, or otherwise, than in the frame that was converted.
    """

    model_config = ConfigDict(frozen=True)

    number: int
    camera: str
    view: View
    lens: Lens | None = None
    moving: tuple[str, ...] = ()


class ShotPlan(Record):
    """How a shot is to be made.

    Args:
        fingerprint: of all that it was made from.
        options: what was weighed. chosen: of them; why: in a sentence.
        trust: share of the shipped corrector's correction that is applied; None where it was not weighed.
        seconds: what it took, baked light included.
    """

    fingerprint: str
    options: tuple[Option, ...]
    chosen: Option
    why: str
    seconds: float
    trust: float | None = None


class Check(Record):
    """Held-out frames against references that were traced for it, over white; means over the frames.

    spp: samples per pixel of the references, in all. noise: mean square error of these, as a share of the frames'; psnr
    (dB) does not count it. flip: LDR-FLIP. seconds: what it took.
    """

    frames: tuple[int, ...]
    spp: int
    noise: float
    psnr: float
    ssim: float
    lpips: float | None
    flip: float
    seconds: float


class ShotRecord(Record):
    """A shot as it was made.

    Args:
        options: what was weighed. chosen: of them. why: in a sentence.
        still_way, moving_way: how frames were rendered that stand still, and that do not.
        expected, spent: seconds from the plan on. spent_before: seconds of the conversion, the pilot and baked light.
    """

    name: str
    scene: str
    frames: tuple[int, ...]
    cameras: tuple[str, ...]
    width: int
    height: int
    fps: float
    moving: dict[str, str]
    moving_frames: tuple[int, ...]
    options: tuple[Option, ...]
    chosen: Option
    why: str
    still_way: Way
    moving_way: Way | None
    expected: float
    spent_before: float
    spent: float
    check: Check | None
    movie: str | None


def facts(frames: Sequence[ShotFrame]) -> dict[str, Any]:
    """Frames, cameras and size for a `ShotRecord`."""
    view = frames[0].view
    return {
        "frames": tuple(frame.number for frame in frames),
        "cameras": tuple(dict.fromkeys(frame.camera for frame in frames)),
        "width": view.width,
        "height": view.height,
        "moving_frames": tuple(frame.number for frame in frames if frame.moving),
    }

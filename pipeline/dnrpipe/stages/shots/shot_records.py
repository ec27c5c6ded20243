"""What a shot is, what was expected of it, and what it became: ``shots/NAME/shot.json``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict

from dnrtrain.contract import View
from dnrtrain.records import Record

from ...core.scene_records import Lens
from .frame_tasks import Way

RECORD = "shot.json"


class Wanted(BaseModel):
    """What the user asked for. seconds: for all of the shot, from here on. psnr in dB, lpips (AlexNet)."""

    model_config = ConfigDict(frozen=True)

    seconds: float | None = None
    psnr: float | None = None
    lpips: float | None = None
    way: str | None = None


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


class Option(Record):
    """A way to make the shot, and what it is expected to give.

    Args:
        views: traced to train on before.
        before: seconds before the first frame, from here on. frame: seconds of a frame.
        seconds: of the shot, from here on. psnr, lpips: against the pilot's references; None where not known.
    """

    way: Way
    views: int = 0
    before: float
    frame: float
    seconds: float
    psnr: float | None
    lpips: float | None

    @property
    def told(self) -> str:
        return self.way.told + (f", trained on {self.views} frames" if self.views else "")

    def reaches(self, psnr: float | None, lpips: float | None) -> bool:
        """Whether the quality is expected to be at least so good. What is None does not count."""
        enough = psnr is None or (self.psnr is not None and self.psnr >= psnr)
        return enough and (lpips is None or self.lpips is None or self.lpips <= lpips)


class Check(Record):
    """Held-out frames against references that were traced for it, over white; means over the frames.

    spp: of the references. flip: LDR-FLIP. seconds: what it took.
    """

    frames: tuple[int, ...]
    spp: int
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


def choose(options: Sequence[Option], wanted: Wanted) -> tuple[Option, str]:
    """The option to carry out, and why.

    With a time: the best PSNR that fits in; the quickest where none does. With a quality: the cheapest that reaches it;
    the best where none does. With neither, the wanted quality is that of the neural renderer: the cheapest option that
    has both its PSNR and its LPIPS.

    Raises ValueError: no options.
    """
    if not options:
        raise ValueError("options: there are none")
    if wanted.way is not None:
        options = [option for option in options if option.way.name == wanted.way] or options

    def quality(option: Option) -> float:
        return -math.inf if option.psnr is None else option.psnr

    if wanted.seconds is not None:
        within = [option for option in options if option.seconds <= wanted.seconds]
        if not within:
            return min(options, key=lambda option: option.seconds), "the quickest; none fits in the time"
        return max(within, key=quality), "the best that fits in the time"
    if wanted.psnr is not None or wanted.lpips is not None:
        enough = [option for option in options if option.reaches(wanted.psnr, wanted.lpips)]
        if not enough:
            return max(options, key=quality), "the best; none is expected to reach what is wanted"
        return min(enough, key=lambda option: option.seconds), "the cheapest that is good enough"
    neural = [option for option in options if option.way.name == "neural"]
    if not neural:
        return max(options, key=quality), "the best of its kind"
    aim = max(neural, key=quality)
    enough = [option for option in options if option.reaches(aim.psnr, aim.lpips)]
    found = min(enough, key=lambda option: option.seconds)
    if found is aim:
        return aim, "nothing cheaper has its quality"
    return found, "it has the quality of the neural renderer, and is cheaper here"


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

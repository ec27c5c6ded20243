"""What training tells its caller. Schedules yield these; they never print."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from .records import Epoch, Selection

if TYPE_CHECKING:
    import numpy as np


class EpochEnd(Epoch):
    """One epoch is done and its checkpoint is on disk."""

    stage: str
    epochs: int
    device: str = "cpu"


@dataclass(frozen=True)
class Selected:
    """Step 1 is done.

    seconds, cpu_seconds: wall and process time of choosing, beside that of the epochs; 0 where a finished run is found
    again.
    """

    selection: Selection
    seconds: float = field(default=0.0, compare=False)
    cpu_seconds: float = field(default=0.0, compare=False)


class Diverged(Epoch):
    """An epoch diverged. Training goes on from the state before it, at a lower rate; ``text`` says so.

    The epoch's time was spent all the same.
    """

    text: str
    device: str = "cpu"


@dataclass(frozen=True)
class Note:
    """Something the user should know (weights missing, a loss term dropped, steps skipped)."""

    text: str


@dataclass(frozen=True)
class Previewed:
    """A view rendered by the model that training would leave if it ended now. It is for people to look at.

    image: display RGB over white, float32 [H, W, 3] in [0, 1]. psnr: in dB against the view's target, None without one.
    seconds: wall time of rendering; device: as in `EpochEnd`.
    """

    stage: str
    epoch: int
    epochs: int
    view: str
    image: np.ndarray
    psnr: float | None
    seconds: float
    device: str = "cpu"


Event = EpochEnd | Selected | Diverged | Note | Previewed

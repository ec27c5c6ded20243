"""Ways to make a shot, what they are expected to give and cost, and which is taken."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pydantic import BaseModel, ConfigDict

from dnrtrain.records import Record

from .frame_tasks import Way

NEAR = 0.5, 1.1
"""Decibels below, and times the LPIPS of, the best of baked light that cheaper frames of it may have: half as many rays
are half a decibel where a frame is good."""
SAME_PRICE = 1.05
"""Times the seconds of the cheapest that is near, within which the best is taken: seconds vary by more than that."""
SMOOTH_ENOUGH, SHARP_ENOUGH = 1.02, 1.2
"""Times the LPIPS of denoised frames that smoothed ones of as many rays may have: windows tell grain poorly, since the
references' own noise is in their LPIPS (`interior`: .112 and .107, in whole frames of 1280x720 .110 and .051). The
second is of smoothed ones with at least the PSNR, which grain takes away: they are but less sharp (`ship`, eight rays:
.067 and .058, in whole frames .039 and .035, which look alike)."""

USUAL = 31.0, 0.03
"""PSNR and LPIPS that base images of eight rays have on the pilot's windows, give or take (`food` 31.6 dB, .024; `ship`
32.4, .029; `drums` 29.7, .018). Five example scenes of ten have it by path tracing with QUICK samples, quickly
denoised, in no more time (31.6 to 36.5 dB): there light would not pay. The others are far from it (19.8 to 29.1 dB):
there it does, but for `jewels`, whose caustics baked light leaves out."""
STEADY = 2
"""Samples per pixel; with fewer, frames flicker."""
QUICK = 4
"""Samples per pixel that are path-traced first, quickly denoised: what a shot takes where they are good."""
PATIENCE = 8
"""Samples per pixel, as many as base images have rays, beyond which nobody waits who asked for nothing, unless it is
for base images that cost less than STEADY to QUICK path-traced samples and are as good."""


class Wanted(BaseModel):
    """What the user asked for. seconds: for all of the shot, from here on. psnr in dB, lpips (AlexNet). frames: to plan
    for, if more of the shot will follow."""

    model_config = ConfigDict(frozen=True)

    seconds: float | None = None
    psnr: float | None = None
    lpips: float | None = None
    way: str | None = None
    frames: int | None = None

    def planned(self, here: int) -> int:
        """Frames to plan for, of a shot of so many."""
        return max(self.frames or 0, here)

    @property
    def aimless(self) -> bool:
        """Neither a time nor a quality is wanted, nor baked light."""
        return self.seconds is None and self.psnr is None and self.lpips is None and self.way in (None, "path")


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

    def meets(self, wanted: Wanted) -> bool:
        """Whether the quality that the user asked for is expected. An LPIPS that was not measured does not meet one:
        else a single sample would. Training's, which nobody predicts, does: it is tried where nothing else meets it."""
        measured = wanted.lpips is None or self.lpips is not None or self.views > 0
        return measured and self.reaches(wanted.psnr, wanted.lpips)


def choose(options: Sequence[Option], wanted: Wanted) -> tuple[Option, str]:
    """The option to carry out, and why.

    With a time: the best PSNR that fits in; the quickest where none does. With a quality: the cheapest that reaches it;
    the best where none does. With neither, the wanted quality is the best of baked light's, with as few rays as cost it
    next to nothing (`NEAR`): the cheapest option that has both its PSNR and its LPIPS. Where STEADY to QUICK samples,
    path-traced, have more and what baked light usually has (`USUAL`), it is theirs, give or take as much. Where light
    is not weighed it is the usual, or the best that at most PATIENCE samples give.

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
        enough = [option for option in options if option.meets(wanted)]
        if not enough:
            return max(options, key=quality), "the best; none is expected to reach what is wanted"
        return min(enough, key=lambda option: option.seconds), "the cheapest that is good enough"
    baked = [option for option in options if option.way.name != "path"]
    if not baked:
        enough = [option for option in options if option.reaches(*USUAL) and option.way.spp >= STEADY]
        if not enough:
            few = [option for option in options if option.way.spp <= PATIENCE]
            return max(few or options, key=quality), f"the best of up to {PATIENCE} samples"
        return min(enough, key=lambda option: option.seconds), "as good as baked light usually is"

    def is_near(option: Option, other: Option) -> bool:
        return option.reaches(quality(other) - NEAR[0], None if other.lpips is None else other.lpips * NEAR[1])

    denoised = {own.way.spp: own for own in baked if own.way.name == "base" and not own.way.smooth}

    def is_clean(own: Option) -> bool:
        other = denoised.get(own.way.spp) if own.way.smooth else None
        if other is None or other.lpips is None or own.lpips is None:
            return True
        return own.lpips <= other.lpips * (SHARP_ENOUGH if quality(own) >= quality(other) else SMOOTH_ENOUGH)

    clean = [own for own in baked if is_clean(own)]
    usual = [own for own in clean if not own.way.smooth or own.way.spp <= PATIENCE]
    best = max(usual, key=quality)
    near = [own for own in usual if is_near(own, best)]
    cheapest = min(own.seconds for own in near)
    aim = max((own for own in near if own.seconds <= SAME_PRICE * cheapest), key=quality)
    few = [o for o in options if o.way.name == "path" and STEADY <= o.way.spp <= QUICK and o.reaches(*USUAL)]
    steady = min(few, key=lambda option: option.seconds, default=None)
    if steady is not None and not is_near(aim, steady):
        # Good already: light was baked to save time, not to have less than that.
        aim = min((steady, *(own for own in clean if is_near(own, steady))), key=lambda option: option.seconds)
    enough = [option for option in options if option.reaches(aim.psnr, aim.lpips)]
    found = min(enough, key=lambda option: option.seconds)
    if found is aim:
        return aim, "nothing cheaper has its quality" if aim in baked else "baked light is worse here"
    return found, f"it has the quality of the {aim.told}, and is cheaper here"

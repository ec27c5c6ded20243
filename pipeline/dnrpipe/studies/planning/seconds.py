"""Seconds of every stage from the pilot: straight lines, each with its slope and its start.

    view      t = pixels * (b * spp + c)        (c: denoiser and its guides, where views are denoised)
    stage     start of the workers + views * t / workers
    light     start of the worker + slope * texels^2 * paths
    base      start + views * t * (pixels / pilot's pixels)
    training  start + steps * t * (trained pixels / pilot's) + epochs * t of saving the state

Either clock: wall seconds, or processor seconds, which other work on the machine does not stretch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...core.errors import UserError
from ...stages import trust
from .records import Clock, Pilot, TracePart

TIME_SPREAD = 1.4
"""Intervals of seconds reach from 1/1.4 to 1.4 times the prediction: 34 of 40 runs that followed their pilot ended
within (docs/cost.md). A shared machine's speed drifts by so much from one minute to the next."""
RULE_SECONDS = 2.0
"""Allowed for a choice of views that trains nothing."""


@dataclass(frozen=True)
class ViewLine:
    """Seconds of one view on one worker."""

    per_sample: float
    per_pixel: float

    def at(self, spp: int, pixels: int) -> float:
        """Seconds of a view of ``pixels`` at ``spp`` samples a pixel."""
        return pixels * (self.per_sample * spp + self.per_pixel)


def view_line(part: TracePart, clock: Clock) -> ViewLine:
    """Least squares in relative error; where one coefficient would be below zero, the other alone."""
    times = np.array([max(getattr(p, clock), 1e-6) for p in part.points])
    rows = np.array([(p.spp * p.pixels, p.pixels) for p in part.points], float) / times[:, None]
    scale = np.linalg.norm(rows, axis=0)
    both = np.linalg.lstsq(rows / scale, np.ones(len(times)), rcond=None)[0] / scale
    if (both >= 0).all():
        return ViewLine(float(both[0]), float(both[1]))
    alone = rows.sum(axis=0) / scale**2  # each coefficient by itself
    errors = ((rows * alone - 1) ** 2).sum(axis=0)
    return ViewLine(float(alone[0]), 0.0) if errors[0] <= errors[1] else ViewLine(0.0, float(alone[1]))


def noise_at(part: TracePart, spp: int, raw: bool = False) -> float:
    """RMSE of a view at ``spp`` samples, display space: c * spp^-p through the pilot's points; 0 where unknown.

    p is 1/2 for raw pictures; denoised ones fall more slowly, so it is fitted, between 0 and 1/2. raw: of the pictures
    as they are traced, else as the settings use them.
    """
    groups: dict[int, list[float]] = {}
    for point in part.points:
        if rmse := point.raw_rmse if raw else point.noise_rmse:
            groups.setdefault(point.spp, []).append(rmse)
    if not groups:
        return 0.0
    x = np.log([float(n) for n in groups])
    y = np.array([math.log(float(np.sqrt(np.mean(np.square(values))))) for values in groups.values()])
    power = 0.5 if len(groups) < 2 else float(np.clip(-np.polyfit(x, y, 1)[0], 0.0, 0.5))
    return math.exp(float(np.mean(y + power * x)) - power * math.log(spp))


@dataclass(frozen=True)
class Work:
    """What decides the seconds beside the choice. pixels: of a view; trained: of a training step (a patch, maybe).

    light: (texels of the side, paths per texel) still to bake, or None. step1: its optimiser steps, on whole pictures;
    0 where views are chosen without training. tests: test views; evaluation_spp: samples of their references.
    """

    pixels: int
    trained: int
    light: tuple[int, int] | None
    step1: int
    tests: int
    evaluation_spp: int


@dataclass(frozen=True)
class Costs:
    """Seconds of stages by one clock."""

    pilot: Pilot
    work: Work
    clock: Clock

    def __post_init__(self) -> None:
        if self.pilot.trace is None or self.pilot.base is None or self.pilot.training is None:
            raise UserError("the pilot is not complete; run `dnrpipe plan` again")

    def select(self) -> float:
        """Choosing the views; a step of step 1 is taken to be as long as one of step 2 on as many pixels."""
        part = self.pilot.training
        assert part is not None
        return self.work.step1 * getattr(part, self.clock) * self.work.pixels / part.pixels or RULE_SECONDS

    def raytrace(self, views: int, spp: int) -> float:
        """Tracing, baked light and base images of the training views."""
        return self._traced(views, spp) + self.light() + self._base(views)

    def untrained(self) -> float:
        """Baked light, and the small traced views that say how far the shipped corrector is trusted."""
        assert self.pilot.base is not None
        pixels = min(self.work.pixels, trust.SIDE**2)
        return self.light() + self._traced(trust.VIEWS, trust.SPP, pixels) + self._start(self.pilot.base.startup)

    def finetune(self, steps: int, epochs: int) -> float:
        part = self.pilot.training
        assert part is not None
        step = getattr(part, self.clock) * self.work.trained / part.pixels
        between = part.between if self.clock == "seconds" else part.cpu_between
        return self._start(part.startup) + steps * step + epochs * between

    def evaluate(self) -> float:
        """References of the test views and their base images; measuring itself is not modelled."""
        if not self.work.tests:
            return 0.0
        return self._traced(self.work.tests, self.work.evaluation_spp) + self._base(self.work.tests)

    def light(self) -> float:
        """The baked light where it is not on disk yet."""
        part = self.pilot.light
        if part is None or self.work.light is None:
            return 0.0
        size, spp = self.work.light
        slope = getattr(part.bake, self.clock) / (part.bake.size**2 * part.bake.spp)
        return self._start(part.startup) + slope * size**2 * spp

    def _traced(self, views: int, spp: int, pixels: int | None = None) -> float:
        part = self.pilot.trace
        assert part is not None
        each = view_line(part, self.clock).at(spp, pixels or self.work.pixels)
        side_by_side = min(part.workers, views) if self.clock == "seconds" else 1
        return self._start(part.startup) + math.ceil(views / side_by_side) * each

    def _base(self, views: int) -> float:
        part = self.pilot.base
        assert part is not None
        return self._start(part.startup) + views * getattr(part, self.clock) * self.work.pixels / part.pixels

    def _start(self, seconds: float) -> float:
        """Starting processes is waiting more than work: it counts on the wall clock only."""
        return seconds if self.clock == "seconds" else 0.0

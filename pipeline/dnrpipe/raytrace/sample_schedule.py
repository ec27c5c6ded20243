"""Which view gets how many samples next, on the way to a noise target, within a time, or both.

Notation
    N, r, e    samples per pixel of a view so far; its relative noise; the standard error of r
    target     reached when r + e <= target. The e is the guard against lucky estimates: whoever stops at the first
               r <= target stops where r happens to be too small
    extrapolation  r falls as 1/sqrt(N): the next pass goes to N ((r + e) / target)², at most GROWTH times N
    greedy     one more sample takes r²/N off the squared noise r² (first order); within a time the next samples go
               where that is most per second. In equilibrium N is proportional to r sqrt(N) / sqrt(seconds a sample),
               which minimises the sum of r² over the views

Samples come in steps of STEP: one in each group. An odd number per group keeps Mitsuba to one kernel (divisions by
powers of two are compiled into another).
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

STEP = 8
FIRST = 3 * STEP
FEW = 10 * STEP
"""Below so many samples, a noise target is approached in single steps: three at once would be more than 15% past it."""
GROWTH = 8.0
MARGIN = 1.04
"""More samples than the extrapolation says: each pass that just misses the target costs another launch."""
SHARE = 0.5
"""Within a time, a pass adds at most this share of what is there: no view runs far past the equilibrium."""
PASS_SECONDS = 60.0
"""A pass is made no longer than about this: what is lost when the machine goes down."""


@dataclass(frozen=True)
class Goal:
    """noise: relative; seconds: wall clock for all views together; most: samples per pixel, at most.

    At least one of the first two is set.
    """

    noise: float | None
    seconds: float | None
    most: int

    @property
    def limit(self) -> int:
        """``most`` as whole steps."""
        return max(STEP, self.most // STEP * STEP)


@dataclass
class ViewProgress:
    """What is known of a view. passes: (samples, seconds) of those of this run, start-up of a worker left out."""

    spp: int = 0
    noise: float | None = None
    error: float | None = None
    seconds: float = 0.0
    passes: list[tuple[int, float]] = field(default_factory=list)
    busy: bool = False
    finished: bool = False

    @property
    def bound(self) -> float:
        """r + e."""
        return math.inf if self.noise is None else self.noise + (self.error or 0.0)


@dataclass(frozen=True)
class Step:
    """The next task: ``add`` samples to a view, or (add = 0) write its file; why: what ended it."""

    view: str
    add: int
    why: str = ""


class Schedule:
    """Hands out steps, one at a time per view. ``clock``: seconds, for tests."""

    def __init__(
        self,
        goal: Goal,
        views: Mapping[str, ViewProgress],
        workers: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.goal, self.views, self.workers, self.clock = goal, views, workers, clock
        self.finish_seconds = 0.0
        spent = sum(view.seconds for view in views.values()) / workers
        self.deadline = math.inf if goal.seconds is None else clock() + max(0.0, goal.seconds - spent)

    def next(self) -> Step | None:
        """The step for a worker that is free, or None where all that is left is under way."""
        idle = {name: view for name, view in self.views.items() if not (view.busy or view.finished)}
        step = self._step(idle)
        if step is not None:
            self.views[step.view].busy = True
        return step

    def passed(
        self, name: str, *, spp: int, noise: float, error: float, add: int, seconds: float, started: bool
    ) -> None:
        """A pass is over. started: the worker's first, whose seconds hold the compiling of kernels."""
        view = self.views[name]
        view.busy, view.spp, view.noise, view.error = False, spp, noise, error
        view.seconds += seconds
        if not started:
            view.passes.append((add, seconds))

    def finished(self, name: str) -> None:
        """The view's file is there, or it failed."""
        self.views[name].busy, self.views[name].finished = False, True

    @property
    def left(self) -> float:
        """Seconds until tracing must end, so that files can be written in time."""
        unfinished = sum(not view.finished for view in self.views.values())
        return self.deadline - self.clock() - self.finish_seconds * math.ceil(unfinished / self.workers)

    def _step(self, idle: Mapping[str, ViewProgress]) -> Step | None:
        if self.goal.seconds is not None:
            for name, view in idle.items():  # every view gets a first pass
                if not view.spp:
                    return Step(name, min(FIRST, self.goal.limit))
        best: tuple[float, Step] | None = None
        ended: Step | None = None
        for name, view in idle.items():
            add, why = self._samples(view)
            if not add:
                ended = ended or Step(name, 0, why)
            elif self.goal.seconds is None:
                return Step(name, add)  # view by view: each is done as early as can be
            elif best is None or self._worth(view) > best[0]:
                best = self._worth(view), Step(name, add)
        return best[1] if best else ended

    def _samples(self, view: ViewProgress) -> tuple[int, str]:
        """(samples to add now, why none: target, limit or time)."""
        if not view.spp:
            return min(FIRST, self.goal.limit), ""
        wanted = GROWTH
        if self.goal.noise is not None:
            if view.bound <= self.goal.noise:
                return 0, "target"
            wanted = min(GROWTH, MARGIN * (view.bound / self.goal.noise) ** 2)
        room = self.goal.limit - view.spp
        if room < STEP:
            return 0, "limit"
        add = view.spp * (wanted - 1)
        seconds = PASS_SECONDS
        if self.goal.seconds is not None:
            seconds = min(seconds, self.left)
            add = min(add, SHARE * view.spp)
        if self.goal.seconds is None and view.spp < FEW:
            few = min(math.ceil(add / STEP) * STEP, room // STEP * STEP)
            if few <= 2 * STEP:
                return few, ""
        add = min(max(math.ceil(add), FIRST), room, self._within(view, seconds))
        if add < min(FIRST, room):
            if self.goal.seconds is not None and self.left <= PASS_SECONDS:
                return 0, "time"
            add = min(FIRST, room)
        return _odd_steps(add, room, up=self.goal.seconds is None), ""

    def _cost(self, view: ViewProgress) -> tuple[float, float]:
        """(seconds of a pass before its first sample, seconds a sample): the line through the view's last passes."""
        if view.passes:
            (n, s), (m, t) = view.passes[-1], min(view.passes)
            if m < n and t < s:
                slope = (s - t) / (n - m)
                return max(0.0, s - slope * n), min(slope, s / n)
            return 0.0, s / n
        others = [s / n for other in self.views.values() for n, s in other.passes[-1:]]
        if others:
            return 0.0, statistics.median(others)
        return 0.0, view.seconds / view.spp if view.spp else 0.0

    def _within(self, view: ViewProgress, seconds: float) -> int:
        before, each = self._cost(view)
        return max(0, math.floor((seconds - before) / each)) if each > 0 else 1 << 30

    def _worth(self, view: ViewProgress) -> float:
        return (view.noise or 0.0) ** 2 / (view.spp * max(self._cost(view)[1], 1e-9))


def _odd_steps(samples: int, room: int, *, up: bool) -> int:
    """Whole steps, an odd number of them, at least one, none beyond ``room``; rounded up or down."""
    steps = max(1, min(samples, room) // STEP)
    if steps % 2 == 0:
        steps += 1 if up and (steps + 1) * STEP <= room else -1
    return steps * STEP

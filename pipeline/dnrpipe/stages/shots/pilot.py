"""What ways of rendering a shot give and cost, measured on small windows of a few of its frames.

Windows have the pixels of the finished frames: on pictures that are scaled down, denoised path tracing looks worse than
it is (`interior`, 640x360, 4 samples: 26.5 dB at 256x144, 30.0 in full), baked light hardly does. The check of the
finished frames (`check`) says how far off the windows were.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import View

from ...core.cameras import scaled_to, spread, window
from ...core.errors import UserError
from ..stage import Run
from ..trust import SHARES
from .frame_tasks import NETWORK, FrameTask, Way
from .records import ShotFrame
from .references import FEWEST, SEED, SPP, Truth, compared, decibels, display_of, shown
from .render_frames import frame_outcomes, goes_on, in_succession, next_to
from .renderers import Renderer

FRAMES, SIZE = 2, (192, 108)
"""Frames of the pilot, and pixels of a window."""
PLACES = ((0.2, 0.7), (0.75, 0.4))
"""Of the windows in a frame."""
LADDER = 1, 4, 8
"""Samples per pixel of path-traced pictures, at most a quarter of a reference's: else the denoiser's bias would not
show."""
REFERENCE = Way(name="path", spp=SPP)
WHOLE = 640
"""Pixels of a whole frame's longer side, at most: pixels of larger ones take as long."""
LEAD = 4
"""Frames before a frame of the pilot that it remembers."""
SAME, LEAST_LPIPS = 99.0, 1e-6
"""PSNR above which, and LPIPS below which, pictures are the same."""


_Kind = tuple[str, bool]
"""Name, and whether it is smoothed: path tracing is one kind, whatever the denoiser's quality."""


@dataclass(frozen=True)
class Measured:
    """A way on the pilot's windows. pixel: seconds per pixel of a whole frame, files included. start: seconds until its
    process renders. psnr: of all their pixels, dB. lpips: mean, or None where there are no weights. Windows without
    surfaces do not count, unless none has any: shows."""

    way: Way
    pixel: float
    start: float
    psnr: float
    lpips: float | None
    shows: bool = True


@dataclass(frozen=True)
class _Window:
    """key: of the window. picture: display RGB over white [1, 3, H, W]. spent: its seconds."""

    key: int
    picture: Any
    spent: float


class Pilot:
    """Renders windows of a shot's frames."""

    def __init__(self, run: Run, frames: Sequence[ShotFrame], folder: Path, lpips: Any) -> None:
        still = [i for i, frame in enumerate(frames) if not frame.moving]
        self.run, self.frames, self.folder, self.lpips = run, frames, folder, lpips
        self.display = display_of(run)
        chosen = spread(still or range(len(frames)), FRAMES)  # where all move: as converted
        self.windows = [(index, place) for index in chosen for place in PLACES]
        self.references: dict[int, Truth] = {}
        self.reference_seconds: dict[int, list[float]] = {}  # of each window's pictures
        self.starts: dict[bool, float] = {}
        """Seconds from a process' start to its first picture, by whether it path traces."""
        self.wholes: dict[_Kind, float] = {}
        """Seconds of a frame by its pixels over those of the frame's windows by theirs, of one way of each kind:
        windows show more than the sky, and each has a price of its own."""
        self.rows: dict[Way, list[_Window]] = {}

    def measure(self, renderer: Renderer, ways: Sequence[Way]) -> list[Measured]:
        """The ways on the windows, one after the other; of each neural one also the base image that it corrects,
        before it. The references come first where there are none yet; last a whole frame by a way of each kind.

        Raises UserError: a frame failed twice.
        """
        tasks: list[FrameTask] = []
        keys: list[int | None] = []  # the window, where it is measured
        drawn: dict[int, list[Any]] = {}
        tracing = ways[0].name == "path"
        references = [] if self.references else [REFERENCE] * FEWEST
        for turn, way in enumerate([*references, *ways]):
            for key, (index, place) in enumerate(self.windows):
                if turn < len(references):
                    steps = [self._task(way, index, place, None, len(tasks), SEED + turn)]
                else:
                    steps = self._steps(way, index, place, len(tasks))
                keys += [*[None] * (len(steps) - 1), key]
                tasks += steps
        kinds = {kind_of(way): [other for other in ways if kind_of(other) == kind_of(way)] for way in ways}
        examples = [of_kind[len(of_kind) // 2] for kind, of_kind in kinds.items() if kind not in self.wholes]
        if examples:
            index, earlier = self.windows[0][0], None if tracing else ()
            # The first of each readies what its size takes, and takes up to twice as long.
            asked = [way for way in examples for _ in (1, 2)]
            wholes = [self._task(way, index, None, earlier, len(tasks) + i, i) for i, way in enumerate(asked)]
            alone = [None, *wholes[:-1]]
            wholes = [task.model_copy(update={"before": one}) for task, one in zip(wholes, alone, strict=True)]
            keys += [None] * len(wholes)
            tasks += in_succession(wholes)
        found: dict[Way, list[_Window]] = {}
        start, writing, kept = None, 0.0, self.run.kept
        costs: list[tuple[float, float]] = []  # seconds of a task, and what of it is the network's
        label = "pilot: " + ("path tracing" if tracing else "base image and network")
        with (
            closing(frame_outcomes(self.run, renderer, tasks, "pilot")) as outcomes,
            self.run.console.bar(label, len(tasks)) as bar,
        ):
            for key, task, outcome in zip(keys, tasks, outcomes, strict=True):
                if outcome.result is None:
                    raise UserError(f"{label} failed twice: {outcome.error}; see {self.run.log}")
                self.run.book(
                    "training",
                    "view",
                    f"pilot/{task.way.name} {task.way.spp}",
                    outcome.result["seconds"],
                    cpu_seconds=outcome.result["cpu_seconds"],
                    peak_mb=outcome.result["peak_mb"],
                    width=task.view.width,
                    height=task.view.height,
                )
                spent = outcome.result["seconds"] + outcome.result["write_seconds"]
                network = outcome.result["ms"].get(NETWORK, 0.0) / 1000
                # Of a whole frame, what writing the one before took longer than rendering this one.
                costs.append((outcome.result["seconds"] + writing, network))
                writing = outcome.result["write_seconds"]
                if start is None:
                    asked = outcome.seconds if kept is None else time.monotonic() - kept.started
                    start = max(0.0, asked - spent)
                if key is not None and task.seed >= SEED:
                    drawn.setdefault(key, []).append(shown(self.display, task.output))
                    self.reference_seconds.setdefault(key, []).append(spent)
                elif key is not None:
                    if task.plain is not None:
                        row = _Window(key, shown(self.display, task.plain), spent - network)
                        found.setdefault(base_of(task.way), []).append(row)
                    row = _Window(key, shown(self.display, task.output), spent)
                    found.setdefault(task.way, []).append(row)
                bar.advance(note=task.way.told)
        self.starts.setdefault(tracing, start or 0.0)
        for way, (seconds, network) in zip(examples, costs[len(tasks) - 2 * len(examples) + 1 :: 2], strict=True):
            pixels = _pixels(tasks[-1].view)
            self._set_whole(way, found[way], seconds / pixels)
            if way.name == "neural":
                self._set_whole(base_of(way), found[base_of(way)], (seconds - network) / pixels)
        self.references |= {key: Truth.of(pictures) for key, pictures in drawn.items()}
        self.rows |= found
        return [self._measured(way, rows) for way, rows in found.items()]

    def trusted(self, ways: Sequence[Way]) -> tuple[float, list[Measured]]:
        """(the share of the shipped corrector's correction that does best on the windows; the ways with that share).

        ways: neural ones, measured with all of it. Pictures are mixed as they are displayed, which is close to what the
        network does (see `dnrtrain.correction`).
        """
        pairs = {way: list(zip(self.rows[base_of(way)], self.rows[way], strict=True)) for way in ways}
        everything = [both for rows in pairs.values() for both in rows]
        share = best_mix([(a.picture, b.picture, self.references[a.key].picture) for a, b in everything])
        mixed = {
            way: [replace(b, picture=a.picture.lerp(b.picture, share)) for a, b in rows] for way, rows in pairs.items()
        }
        return share, [self._measured(way, rows) for way, rows in mixed.items()]

    def price_of_reference(self) -> tuple[int, float]:
        """(samples per pixel of a reference, its seconds per pixel of a whole frame). The first of a window's pictures
        may have waited for a kernel."""
        return SPP, self._pixel([min(seconds) for seconds in self.reference_seconds.values()], REFERENCE)

    def _pixel(self, seconds: Sequence[float], way: Way) -> float:
        """Seconds per pixel of a whole frame. seconds: of each window."""
        return self.wholes[kind_of(way)] * float(np.mean(seconds)) / _pixels(self._view(*self.windows[0]))

    def _set_whole(self, way: Way, rows: Sequence[_Window], pixel: float) -> None:
        """rows: windows by the way. pixel: seconds of the first window's whole frame, by its pixels."""
        own = [row.spent for row in rows if self.windows[row.key][0] == self.windows[0][0]]
        self.wholes[kind_of(way)] = pixel * _pixels(self._view(*self.windows[0])) / float(np.mean(own))

    def _measured(self, way: Way, rows: Sequence[_Window]) -> Measured:
        every = []
        for row in rows:
            truth = self.references[row.key]
            every.append({**compared(row.picture, truth.picture, self.lpips), "error": truth.error(row.picture)})
        # A window without any surface is the same by every way, and would flatter them all.
        figures = [found for found in every if found["psnr"] < SAME] or every
        distances = [found["lpips"] for found in figures if "lpips" in found]
        return Measured(
            way=way,
            pixel=self._pixel([row.spent for row in rows], way),
            start=self.starts[way.name == "path"],
            psnr=decibels(float(np.mean([found["error"] for found in figures]))),
            lpips=float(np.mean(distances)) if distances else None,
            shows=any(found["psnr"] < SAME for found in every),
        )

    def _steps(self, way: Way, index: int, place: tuple[float, float], number: int) -> list[FrameTask]:
        """Tasks of which the last renders a window of a frame as it is in the shot. Those before render what it takes,
        or get the process ready for it. number: of the first of them."""
        before, after = next_to(self.frames, index)
        lead = [] if way.name == "path" else list(self._lead(index))
        first = lead[0] if lead else index

        def task(way: Way, at: int, number: int) -> FrameTask:
            earlier = None if way.name == "path" else tuple(self._view(i, place) for i in range(first, at))
            return self._task(way, at, place, earlier, number, at)

        steps = lead or ([index] if before is None else [before])
        # What a frame remembers are base images. The first one readies the network all the same: later, that would cost
        # the memory.
        ways = [way if i == 0 or at == before else base_of(way) for i, at in enumerate(steps)]
        ready = [task(*each, number + i) for i, each in enumerate(zip(ways, steps, strict=True))]
        number += len(ready)
        others = {
            "before": None if before is None else ready[-1],
            "after": None if after is None else task(way, after, number + 1),
        }
        return [*ready, task(way, index, number).model_copy(update=others)]

    def _lead(self, index: int) -> range:
        """Frames before one that it goes on from, at most LEAD."""
        first = index
        while first > 0 and index - first < LEAD and goes_on(self.frames[first - 1], self.frames[index]):
            first -= 1
        return range(first, index)

    def _view(self, index: int, place: tuple[float, float] | None) -> View:
        """A window of a frame; None: the whole frame, scaled to at most WHOLE."""
        view = self.frames[index].view
        return scaled_to(view, WHOLE) if place is None else window(view, *SIZE, place)

    def _task(
        self,
        way: Way,
        index: int,
        place: tuple[float, float] | None,
        earlier: tuple[View, ...] | None,
        number: int,
        seed: int,
    ) -> FrameTask:
        stem = f"{number:03d}-{way.name}"
        return FrameTask(
            view=self._view(index, place),
            way=way,
            lens=self.frames[index].lens,
            earlier=earlier,
            seed=seed,
            output=self.folder / f"{stem}.exr",
            picture=self.folder / f"{stem}.png",
            plain=self.folder / f"{stem}-plain.exr" if way.name == "neural" else None,
            fingerprint="",
        )


def _pixels(view: View) -> int:
    return view.width * view.height


def kind_of(way: Way) -> _Kind:
    """Of which a whole frame is timed for all."""
    return way.name, way.smooth


def base_of(way: Way) -> Way:
    """The base images that a neural way corrects."""
    return way.model_copy(update={"name": "base"})


def best_mix(pictures: Sequence[tuple[Any, Any, Any]]) -> float:
    """The share at which mixing the first with the second of each three pictures comes closest to the third."""

    def error(share: float) -> float:
        return sum(float((plain.lerp(other, share) - truth).square().mean()) for plain, other, truth in pictures)

    return min(SHARES, key=error)


def reckoned(
    measured: Sequence[Measured], counts: Sequence[int], prices: Sequence[tuple[int, float]] = ()
) -> list[Measured]:
    """A way with other numbers of samples per pixel, or rays, from what was measured with some.

    Quality of those that were not measured lies on the line through the two next to them: decibels and the logarithm of
    LPIPS by the logarithm of the samples. (`bricks`, 64 samples by 4 and 16: 38.05 dB, .0061; measured 38.08, .0050.)
    Seconds of all lie on one line by the samples, which fits those measured best: one picture that had to wait for
    something else on the machine would bend a line through two, even so far that many samples cost less than none.

    Args:
        measured: two or more, of several numbers.
        counts: those wanted, none below the least that was measured.
        prices: (samples, seconds per pixel) of pictures without such figures.
    """
    rungs = sorted(measured, key=lambda found: found.way.spp)
    known = [rung.way.spp for rung in rungs]
    fixed, each = _price_line([*zip(known, (rung.pixel for rung in rungs), strict=True), *prices])
    result = []
    for spp in counts:
        place = min(bisect_left(known, spp), len(rungs) - 1)
        found = rungs[place] if known[place] == spp else _on_line(rungs[place - 1], rungs[place], spp)
        result.append(replace(found, pixel=fixed + each * spp))
    return result


def _price_line(prices: Sequence[tuple[int, float]]) -> tuple[float, float]:
    """(seconds per pixel without samples, of each sample), none below zero, by the least squares of relative errors."""
    samples, seconds = np.array(prices, dtype=np.float64).T
    each, fixed = np.polyfit(samples, seconds, 1, w=1 / seconds)
    return (max(float(fixed), 0.0), float(each)) if each > 0 else (float(seconds.max()), 0.0)


def _on_line(low: Measured, high: Measured, spp: int) -> Measured:
    """Quality between or beyond two rungs; seconds as the first one's."""
    t = math.log2(spp / low.way.spp) / math.log2(high.way.spp / low.way.spp)
    lpips = None
    if low.lpips is not None and high.lpips is not None:
        lpips = max(low.lpips, LEAST_LPIPS) ** (1 - t) * max(high.lpips, LEAST_LPIPS) ** t
    way, psnr = low.way.model_copy(update={"spp": spp}), low.psnr + t * (high.psnr - low.psnr)
    return replace(low, way=way, psnr=psnr, lpips=lpips)

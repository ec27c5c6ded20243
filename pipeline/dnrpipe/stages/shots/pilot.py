"""What ways of rendering a shot give and cost, measured on small windows of a few of its frames.

Windows have the pixels of the finished frames: on pictures that are scaled down, denoised path tracing looks worse than
it is (`interior`, 640x360, 4 samples: 26.5 dB at 256x144, 30.0 in full), baked light hardly does. The check of the
finished frames (`check`) says how far off the windows were.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dnrtrain.contract import View
from dnrtrain.exr import read_exr

from ...core.cameras import spread, window
from ...core.errors import UserError
from ...core.images import over_white
from ...core.scene_files import read_frame
from ..stage import Run
from ..trust import SHARES
from .frame_tasks import COLOUR, NETWORK, FrameTask, Way
from .records import ShotFrame
from .render_frames import frame_outcomes
from .renderers import Renderer

if TYPE_CHECKING:
    from dnrtrain.display import DisplayTransform

FRAMES, SIZE = 2, (192, 108)
"""Frames of the pilot, and pixels of a window."""
PLACES = ((0.2, 0.7), (0.75, 0.4))
"""Of the windows in a frame."""
LADDER, MOST = (1, 4, 16), 64
"""Samples per pixel of path-traced pictures; and the most that are reckoned from them (`reckoned`)."""
REFERENCE = Way(name="path", spp=128)
REFERENCE_SEED = 1 << 16
"""Above the seeds of frames."""
LEAD = 4
"""Frames before a frame of the pilot that it remembers."""
SAME, LEAST_LPIPS = 99.0, 1e-6
"""PSNR above which, and LPIPS below which, pictures are the same."""


@dataclass(frozen=True)
class Measured:
    """A way on the pilot's windows. pixel: seconds per pixel, files included. start: seconds until its process renders.
    psnr: of all their pixels, dB. lpips: mean, or None where there are no weights. Windows without surfaces do not
    count, unless none has any."""

    way: Way
    pixel: float
    start: float
    psnr: float
    lpips: float | None


@dataclass(frozen=True)
class _Window:
    """key: of the window. picture: display RGB over white [1, 3, H, W]. spent: its seconds. start: those from the start
    of the process to its first picture."""

    key: int
    picture: Any
    spent: float
    start: float


class Pilot:
    """Renders windows of a shot's frames."""

    def __init__(self, run: Run, frames: Sequence[ShotFrame], folder: Path, lpips: Any) -> None:
        still = [i for i, frame in enumerate(frames) if not frame.moving]
        self.run, self.frames, self.folder, self.lpips = run, frames, folder, lpips
        self.display = display_of(run)
        chosen = spread(still or range(len(frames)), FRAMES)  # where all move: as converted
        self.windows = [(index, place) for index in chosen for place in PLACES]
        self.references: dict[int, Any] = {}
        self.rows: dict[Way, list[_Window]] = {}

    def measure(
        self, renderer: Renderer, ways: Sequence[Way], enough: Callable[[Measured], bool] | None = None
    ) -> list[Measured]:
        """The ways on the windows, one after the other in a process of its own; of each neural one also the base image
        that it corrects, before it.

        enough: told the first way once it is measured; the others are left out where it says so. (Asking after each
            way would disturb the seconds of the next.)

        Raises UserError: a frame failed twice.
        """
        tasks: list[FrameTask] = []
        keys: list[int | None] = []  # the window, where it is measured
        first, last = ways[0], ways[-1]
        if not self.references:
            ways = [REFERENCE, *ways]
        for way in ways:
            for key, (index, place) in enumerate(self.windows):
                lead = [] if way.name == "path" else list(self._lead(index))
                for number, at in enumerate([*lead, index]):
                    earlier = None if way.name == "path" else tuple(self._view(i, place) for i in lead[:number])
                    # What a frame remembers are base images. The first one readies the network all the same: later,
                    # that would cost the memory.
                    rendered = way if at == index or number == 0 else base_of(way)
                    keys.append(key if at == index else None)
                    tasks.append(self._task(rendered, at, place, earlier, len(tasks)))
        found: dict[Way, list[_Window]] = {}
        start: float | None = None
        label = "pilot: " + ("path tracing" if last.name == "path" else "base image and network")
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
                    width=task.view.width,
                    height=task.view.height,
                )
                spent = outcome.result["seconds"] + outcome.result["write_seconds"]
                if start is None:
                    start = max(0.0, outcome.seconds - spent)
                if key is not None:
                    if task.plain is not None:
                        network = outcome.result["ms"][NETWORK] / 1000
                        row = _Window(key, shown(self.display, task.plain), spent - network, start)
                        found.setdefault(base_of(task.way), []).append(row)
                    row = _Window(key, shown(self.display, task.output), spent, start)
                    found.setdefault(task.way, []).append(row)
                bar.advance(note=task.way.told)
                if not self.references and len(found.get(REFERENCE, [])) == len(self.windows):
                    self.references = {row.key: row.picture for row in found.pop(REFERENCE)}
                if enough is not None and len(found.get(first, [])) == len(self.windows):
                    if enough(self._measured(first, found[first])):
                        break
                    enough = None
        self.rows |= found
        return [self._measured(way, rows) for way, rows in found.items()]

    def trusted(self, ways: Sequence[Way]) -> tuple[float, list[Measured]]:
        """(the share of the shipped corrector's correction that does best on the windows; the ways with that share).

        ways: neural ones, measured with all of it. Pictures are mixed as they are displayed, which is close to what the
        network does (see `dnrtrain.correction`).
        """
        pairs = {way: list(zip(self.rows[base_of(way)], self.rows[way], strict=True)) for way in ways}
        everything = [both for rows in pairs.values() for both in rows]
        share = best_mix([(a.picture, b.picture, self.references[a.key]) for a, b in everything])
        mixed = {
            way: [replace(b, picture=a.picture.lerp(b.picture, share)) for a, b in rows] for way, rows in pairs.items()
        }
        return share, [self._measured(way, rows) for way, rows in mixed.items()]

    def _measured(self, way: Way, rows: Sequence[_Window]) -> Measured:
        every = [compared(row.picture, self.references[row.key], self.lpips) for row in rows]
        # A window without any surface is the same by every way, and would flatter them all.
        figures = [found for found in every if found["psnr"] < SAME] or every
        distances = [found["lpips"] for found in figures if "lpips" in found]
        view = self._view(*self.windows[0])
        errors = [10 ** (-found["psnr"] / 10) for found in figures]
        return Measured(
            way=way,
            pixel=float(np.mean([row.spent for row in rows])) / (view.width * view.height),
            start=rows[0].start,
            psnr=-10 * math.log10(float(np.mean(errors))),
            lpips=float(np.mean(distances)) if distances else None,
        )

    def _lead(self, index: int) -> range:
        """Frames before one that stand still like it, at most LEAD."""
        first = index
        while first > 0 and index - first < LEAD and not self.frames[first - 1].moving:
            first -= 1
        return range(first, index)

    def _view(self, index: int, place: tuple[float, float]) -> View:
        return window(self.frames[index].view, *SIZE, place)

    def _task(
        self, way: Way, index: int, place: tuple[float, float], earlier: tuple[View, ...] | None, number: int
    ) -> FrameTask:
        stem = f"{number:03d}-{way.name}"
        return FrameTask(
            view=self._view(index, place),
            way=way,
            lens=self.frames[index].lens,
            earlier=earlier,
            seed=REFERENCE_SEED if way == REFERENCE else 0,
            output=self.folder / f"{stem}.exr",
            picture=self.folder / f"{stem}.png",
            plain=self.folder / f"{stem}-plain.exr" if way.name == "neural" else None,
            fingerprint="",
        )


def base_of(way: Way) -> Way:
    """The base images that a neural way corrects."""
    return way.model_copy(update={"name": "base"})


def best_mix(pictures: Sequence[tuple[Any, Any, Any]]) -> float:
    """The share at which mixing the first with the second of each three pictures comes closest to the third."""

    def error(share: float) -> float:
        return sum(float((plain.lerp(other, share) - truth).square().mean()) for plain, other, truth in pictures)

    return min(SHARES, key=error)


def compared(picture: Any, truth: Any, lpips: Any) -> dict[str, float]:
    """psnr (dB), ssim and, where the pictures are large enough for it, lpips of display pictures [1, 3, H, W]."""
    import torch

    from dnrtrain.metrics import image_metrics

    everywhere = torch.ones_like(truth[:, :1])
    found = image_metrics(picture, truth, everywhere, None if lpips is None else {"alex": lpips})
    named = {"psnr": found["psnr"], "ssim": found["ssim"], "lpips": found["lpips_alex"]}
    return {name: value for name, value in named.items() if value is not None}


def display_of(run: Run) -> DisplayTransform:
    """The scene's display transform. Raises DamagedFile."""
    from dnrtrain.display import DisplayTransform

    return DisplayTransform(read_frame(run.workspace), run.workspace.scene)


def shown(display: DisplayTransform, path: Path) -> Any:
    """A frame's file as display RGB over white, torch [1, 3, H, W]. Raises DamagedFile."""
    channels, _ = read_exr(path)
    return over_white(display, np.stack([channels[name] for name in COLOUR], axis=-1)).clamp(0, 1)


def reckoned(measured: Sequence[Measured], most: int) -> list[Measured]:
    """Path tracing at all powers of two from the least samples measured to ``most``. Those that were not measured lie
    on the line through the two next to them: decibels and the logarithm of LPIPS by the logarithm of the samples,
    seconds by the samples. (`bricks`, 64 samples by 4 and 16: 38.05 dB, .0061; measured 38.08, .0050.)

    measured: two or more, of several samples.
    """
    rungs = sorted(measured, key=lambda found: found.way.spp)
    known = [rung.way.spp for rung in rungs]
    result = []
    spp = known[0]
    while spp <= most:
        place = min(bisect_left(known, spp), len(rungs) - 1)
        exact = rungs[place] if known[place] == spp else None
        result.append(exact or _on_line(rungs[place - 1], rungs[place], spp))
        spp *= 2
    return result


def _on_line(low: Measured, high: Measured, spp: int) -> Measured:
    t = math.log2(spp / low.way.spp) / math.log2(high.way.spp / low.way.spp)
    share = (spp - low.way.spp) / (high.way.spp - low.way.spp)
    lpips = None
    if low.lpips is not None and high.lpips is not None:
        lpips = max(low.lpips, LEAST_LPIPS) ** (1 - t) * max(high.lpips, LEAST_LPIPS) ** t
    return Measured(
        way=low.way.model_copy(update={"spp": spp}),
        pixel=low.pixel + share * (high.pixel - low.pixel),
        start=low.start,
        psnr=low.psnr + t * (high.psnr - low.psnr),
        lpips=lpips,
    )

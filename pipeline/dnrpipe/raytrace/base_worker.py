"""The base-image worker: renders the images that the network corrects (see `base_renderer`) into EXR files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dnrtrain.contract import FRESH_CHANNELS, View
from dnrtrain.exr import write_exr

from .base_renderer import CHAIN, FACING, SHOWN, BaseRenderer
from .denoise import denoise, exposure
from .engine import BundleWorker, masked
from .frames import Frames
from .history import History
from .light_worker import read_light
from .recorded import Stopwatch
from .smoothing import Smoother
from .tasks import CHUNK, BakedCommon, BaseAnswer, BaseTask, SampledCommon, remembers_from
from .temporal_filter import Finished, Latest, TemporalFilter

COLOUR = ("base.R", "base.G", "base.B", "base.A")
PREMULTIPLIED = tuple(f"{kind}.{c}" for kind in ("base", "diffuse", "albedo", "shown", "fresh") for c in "RGB")
LEAST_ALPHA = 1e-6
WITHIN = (*CHAIN, *SHOWN, *FACING)
"""Channels that no file holds."""
MOST_BESIDE = 1 << 20
"""Pixels of a frame up to which the next chunk's memory is kept beside this one's, 128 bytes of each."""
_Frame = tuple[View, int | None, bool]
"""That was seen, its rays per pixel, if not the workspace's, and whether it is smoothed."""


@dataclass
class _Memory:
    """What frames of a camera's way saw."""

    history: History
    seen: list[_Frame]

    @property
    def first(self) -> int:
        """The number of the first of them in the camera's way."""
        return self.history.number - len(self.seen)

    def leads_to(self, first: int, way: Sequence[_Frame]) -> bool:
        """Whether the way's last frame, and perhaps some before it, are yet to come."""
        return self.first == first and len(self.seen) < len(way) and self.seen == list(way[: len(self.seen)])

    def take(self, frame: _Frame, channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The channels with what was seen before (`History.take`)."""
        found = self.history.take(frame[0], channels)
        self.seen.append(frame)
        return found


class Worker(BundleWorker):
    """Renders base images. common: a `BakedCommon` or a `SampledCommon`, task: a `BaseTask`."""

    compiled_for = "base images need"

    def __init__(self, common: dict[str, Any]) -> None:
        kind = BakedCommon if common["kind"] == "baked" else SampledCommon
        self.common = kind.model_validate(common)
        super().__init__(common)
        dark = np.zeros((2, 2, 2, 2, 3), np.float32)
        light = read_light(self.common.light) if isinstance(self.common, BakedCommon) else dark
        scene = self.engine.scenes[str(self.bundle)]
        self.denoise = isinstance(self.common, BakedCommon) and self.common.denoise
        self.thin = isinstance(self.common, BakedCommon) and self.common.thin
        self.renderer = BaseRenderer(
            self.engine.mi, scene, light, gloss=not self.denoise, unit_scale=self.engine.unit_scale
        )
        self.smoother = Smoother(self.engine.mi)
        self.silhouettes: dict[tuple[int, int], Frames] = {}
        self.memory = _Memory(History(self.engine.mi), [])
        self.ahead: _Memory | None = None
        """What the next chunk of frames remembers."""
        self.filter, self.latest = TemporalFilter(self.engine.mi), Latest[list[tuple[View, int]], Finished]()
        """Frames that were filtered, or filtered with, by the way to each and the first one's number."""
        self.repaired = self.masked = 0  # pixels of the view at hand: samples left out, set to zero

    def __call__(self, asked: dict[str, Any]) -> BaseAnswer:
        task = BaseTask.model_validate(asked)
        view = task.view
        self.repaired = self.masked = 0
        watch, earlier = Stopwatch(), task.earlier
        if earlier is None:
            channels = self.channels(view)
        elif task.filtered:
            channels = self.filtered(view, earlier, task.number, task.after)
        else:
            channels = self.remembered(view, earlier, task.number)
        answer: BaseAnswer = {
            **watch.costs(),
            "kind": self.common.kind,
            "samples": self.common.samples,
            "repaired": self.repaired,
            "masked": self.masked,
        }
        header = {**answer, "fingerprint": task.fingerprint, "view": view.model_dump(mode="json")}
        write_exr(task.output, {name: plane for name, plane in channels.items() if name not in WITHIN}, header)
        return answer

    def channels(self, view: View, samples: int | None = None, *, smooth: bool = False) -> dict[str, np.ndarray]:
        """Base image and G-buffer of a view in scene units: linear Rec.709, float32 [H, W] each.

        samples: rays per pixel, if not the workspace's. smooth: by `smoothing`, not denoised as in the workspace.
        """
        channels = self.grainy(view, samples, smooth=smooth)
        if isinstance(self.common, SampledCommon):
            return channels | self._traced(self.common, view, channels)
        return self.finished(channels, smooth)

    def grainy(
        self, view: View, samples: int | None = None, number: int = 0, *, smooth: bool = False
    ) -> dict[str, np.ndarray]:
        """`channels` by the kernel alone: not denoised, not path-traced. number: see `BaseRenderer.frame`. smooth:
        they will be smoothed, not denoised."""
        renderer, tiles = self.renderer, smooth or not self.denoise
        thin = self.thin and not tiles
        channels = renderer.frame(view, samples or self.common.samples, number, tiles=tiles, thin=thin)
        self.repaired, self.masked = self.repaired + renderer.repaired, self.masked + renderer.masked
        channels["coverage"] = self._frames(view).coverage(view, channels["mask"] > 0.5, alpha=channels["base.A"])
        return channels

    def remembered(
        self,
        view: View,
        earlier: Sequence[View],
        number: int = 0,
        samples: int | None = None,
        *,
        smooth: bool = False,
    ) -> dict[str, np.ndarray]:
        """`channels` of a view, with what the frames ``earlier`` of a camera's way saw, the first of that number.

        Those that were the last to be seen, by as many rays for the same use, are not rendered again: one frame after
        the other costs one each, also where the next chunk begins (`remembers_from`).
        """
        way = [(other, samples, smooth) for other in (*earlier, view)]
        known = [memory for memory in (self.memory, self.ahead) if memory is not None and memory.leads_to(number, way)]
        self.memory = known[0] if known else _Memory(self.memory.history.beside(number), [])
        for frame, *_ in way[len(self.memory.seen) : -1]:
            self._taken(frame, samples, smooth)
        return self.finished(self._taken(view, samples, smooth), smooth)

    def filtered(
        self, view: View, earlier: Sequence[View], number: int = 0, after: View | None = None
    ) -> dict[str, np.ndarray]:
        """`remembered`, with a base image that is averaged with those of the frame before and the frame ``after``."""

        def seen(way: Sequence[View]) -> Finished:
            key = [(frame, number) for frame in way]
            return self.latest(key, lambda: as_finished(way[-1], self.remembered(way[-1], way[:-1], number)))

        way = [*earlier, view]
        before, own = seen(way[:-1]) if earlier else None, seen(way)
        return as_channels(self.filter(own, before, None if after is None else seen([*way, after])))

    def finished(self, channels: dict[str, np.ndarray], smooth: bool) -> dict[str, np.ndarray]:
        """Channels of `grainy`, smoothed, or denoised where the workspace's are; they are changed in place."""
        if smooth:
            return self.smoother(with_coverage(channels))
        return without_grain(channels, self.renderer) if self.denoise else channels

    def _taken(self, view: View, samples: int | None, smooth: bool) -> dict[str, np.ndarray]:
        """`grainy`, with what was seen before. What the next chunk remembers goes into a memory of its own, too."""
        memory, each, number = self.memory, (view, samples, smooth), self.memory.history.number
        channels = self.grainy(view, samples, number, smooth=smooth)
        begin = remembers_from(number + CHUNK - number % CHUNK)
        if memory.first < begin <= number and view.width * view.height <= MOST_BESIDE:
            if number == begin:
                self.ahead = _Memory(memory.history.beside(begin), [])
            if self.ahead is not None and self.ahead.seen == memory.seen[begin - memory.first :]:
                self.ahead.take(each, channels)
        return memory.take(each, channels)

    def _frames(self, view: View) -> Frames:
        """Finer silhouettes than the base image's few rays give, for views of one size."""
        size = (view.width, view.height)
        if size not in self.silhouettes:
            self.silhouettes[size] = Frames(self.engine, self.bundle, "path", 2, size)
        return self.silhouettes[size]

    def _traced(self, common: SampledCommon, view: View, channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        integrator, _ = self.engine.integrator(self.bundle, common.integrator, common.max_depth)
        sensor = self.engine.sensor(view)
        self.engine.compile(self.bundle, integrator, sensor, view)
        picture, _ = self.engine.frame(self.bundle, integrator, sensor, view, common.spp, common.seed)
        picture, lost = masked(picture.astype(np.float32))
        self.masked += lost
        found = channels | {name: picture[..., i] for i, name in enumerate(COLOUR)}
        clean = denoised(found)
        return clean | {"base.A": found["base.A"]} | {f"diffuse.{c}": clean[f"base.{c}"] for c in "RGB"}


def as_finished(view: View, channels: dict[str, np.ndarray]) -> Finished:
    """A base image as the temporal filter takes it."""
    return Finished(view, channels | {c: channels[f"base.{c}"] for c in "RGBA"})


def as_channels(layers: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What the filter makes of `as_finished`, as the base image's channels."""
    return {name: plane for name, plane in layers.items() if name not in "RGBA"} | {
        f"base.{c}": layers[c] for c in "RGB"
    }


def without_grain(channels: dict[str, np.ndarray], renderer: BaseRenderer) -> dict[str, np.ndarray]:
    """`with_coverage`, denoised.

    Where no surface of the renderer's scene lets light straight through, the diffuse part has no grain but at edges,
    and stays as it is: a denoiser would blur its textures.
    """
    image = with_coverage(channels)
    return image | denoised(image, diffuse=renderer.lets_through)


def with_coverage(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The channels with a base image whose alpha is the coverage, which has no grain at silhouettes.

    FRESH_CHANNELS hold the frame's own with its grain: the network may take of it what a denoiser smooths away. The
    planes are changed in place: copies of them are half a gigabyte of a 4K frame.
    """
    alpha = channels["coverage"]
    share = alpha / np.maximum(channels["base.A"], LEAST_ALPHA)
    for name in PREMULTIPLIED:
        if name in channels:
            channels[name] *= share
    own = dict(zip(FRESH_CHANNELS, (channels[name] for name in (*COLOUR[:3], "rays")), strict=True))
    return own | channels | {"base.A": alpha}


def denoised(channels: dict[str, np.ndarray], *, diffuse: bool = True) -> dict[str, np.ndarray]:
    """base.R/G/B without grain. diffuse: whether their diffuse part has some, too.

    The auxiliary images are not called clean: with the few rays that they come from, that is as good or better on most
    scenes (docs/experiments.md).
    """
    image = np.stack([channels[name] for name in COLOUR[:3]], axis=-1)
    albedo, normal = (np.stack([channels[name] for name in names], axis=-1) for names in (SHOWN, FACING))
    level = exposure(image)  # without the diffuse part it may be nearly black
    kept = [] if diffuse else [channels[f"diffuse.{c}"] for c in "RGB"]
    for i, plane in enumerate(kept):
        image[..., i] -= plane
    clean = denoise(image, albedo, normal, clean=False, quality="fast", scale=level)
    for i, plane in enumerate(kept):
        clean[..., i] += plane
    return {name: clean[..., i] for i, name in enumerate(COLOUR[:3])}

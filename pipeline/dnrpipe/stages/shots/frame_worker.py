"""The process that renders a shot's frames: scene, kernels and network are kept between them.

A frame's file holds scene-linear Rec.709, premultiplied (see `frame_tasks.LAYERS`); its picture goes through the
scene's view transform.
"""

from __future__ import annotations

import contextlib
import functools
import os
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.core.errors import UserError
from dnrpipe.core.images import over_white, rgba, write_png
from dnrpipe.core.settings import Settings
from dnrpipe.raytrace.background import Background
from dnrpipe.raytrace.base_worker import LEAST_ALPHA
from dnrpipe.raytrace.base_worker import Worker as BaseWorker
from dnrpipe.raytrace.denoise import denoise
from dnrpipe.raytrace.engine import Engine, masked, masked_channels
from dnrpipe.raytrace.frames import Frames
from dnrpipe.raytrace.recorded import Stopwatch, timed
from dnrpipe.raytrace.temporal_filter import Finished, Latest, TemporalFilter
from dnrtrain.dataset import view_in_memory
from dnrtrain.display import DisplayTransform
from dnrtrain.exr import compress_by, write_exr
from dnrtrain.model import render

from ..trainer import torch_device
from .frame_tasks import HALF, LAYERS, NETWORK, FrameAnswer, FrameCommon, FrameTask

GUIDE_RAYS = 16
"""Primary rays per pixel of the denoiser's auxiliary images: clean."""
MAX_RAYS = 1 << 22
"""Of a launch of the path tracer: bounds its memory."""
EACH = 16
"""Samples per pixel of a launch at most: a kernel is recorded for each number of them."""
Layers = dict[str, np.ndarray]


@dataclass(frozen=True)
class _Rendered:
    """A frame that is not written yet. layers: see `Worker.render`."""

    task: FrameTask
    layers: list[Layers]
    answer: FrameAnswer

    def shown(self, i: int) -> Finished:
        """Its picture, or (1) its base image alone."""
        return Finished(self.task.view, self.layers[i])


class Worker:
    """Renders frames. common: a `FrameCommon`; task: a `FrameTask`."""

    def __init__(self, common: dict[str, Any]) -> None:
        self.common = settings = FrameCommon.model_validate(common)
        compress_by(os.cpu_count() or 1)  # a file of a real shot takes as long as a third of its frame
        self.display = DisplayTransform(settings.frame, settings.scene)
        self.base = None if settings.base is None else BaseWorker(settings.base)
        self.engine = self.base.engine if self.base is not None else Engine(settings.variant, 0, [settings.bundle])
        if not self.engine.compiled:
            raise UserError("shots need a jit variant of Mitsuba (LLVM or CUDA); see `dnrpipe doctor`")
        self.frames = functools.cache(
            functools.partial(Frames, self.engine, settings.bundle, settings.integrator, settings.max_depth)
        )  # by (width, height)
        self.background = Background(self.engine, settings.bundle) if settings.background else None
        self.filter = TemporalFilter(self.engine.mi)
        self.latest = Latest[FrameTask, _Rendered]()
        """Frames that were rendered, not filtered."""

    @functools.cached_property
    def model(self) -> Any:
        """The network, on its device."""
        from dnrtrain.checkpoint import load_model
        from dnrtrain.shipped import corrector

        device = torch_device(Settings(device=self.common.device))
        if self.common.checkpoint is not None:
            return load_model(self.common.checkpoint, device)
        return corrector().to(device)

    def __call__(self, asked: dict[str, Any]) -> FrameAnswer:
        task = FrameTask.model_validate(asked)
        if task.before is None and task.after is None:
            self.latest.forget()  # the others are of a way that has ended, and large
        finished = self._finished(task)
        began, beside = time.monotonic(), 0.0
        with ThreadPoolExecutor(1) as writer:
            written = writer.submit(self._write, finished)
            if task.following is not None:
                # What goes wrong here does so again when the frame is asked for.
                with contextlib.suppress(Exception):
                    for each in task.following.takes:
                        self._once(each)
                beside = time.monotonic() - began
            written.result()
        return {**finished.answer, "write_seconds": time.monotonic() - began - beside}

    def _finished(self, task: FrameTask) -> _Rendered:
        """Filtered. The answer counts what the frame and the filter took, not what those next to it did."""
        before = task.before and self._once(task.before)
        own = self._once(task.alone)
        after = task.after and self._once(task.after)
        if before is None and after is None:
            return replace(own, task=task)
        ms, watch = dict(own.answer["ms"]), Stopwatch()

        def filtered(i: int) -> Layers:
            return self.filter(own.shown(i), before and before.shown(i), after and after.shown(i))

        layers = timed(ms, "temporal filter", lambda: [filtered(i) for i in range(len(own.layers))])
        costs = watch.costs()
        answer: FrameAnswer = {
            **own.answer,
            "seconds": own.answer["seconds"] + costs["seconds"],
            "cpu_seconds": own.answer["cpu_seconds"] + costs["cpu_seconds"],
            "peak_mb": costs["peak_mb"],
            "ms": {name: round(value, 2) for name, value in ms.items()},
        }
        return _Rendered(task, layers, answer)

    def _once(self, task: FrameTask) -> _Rendered:
        """Not filtered. task: one that stands `alone`."""
        return self.latest(task, lambda: self._rendered(task))

    def _rendered(self, task: FrameTask) -> _Rendered:
        ms: dict[str, float] = {}
        if task.way.name == "neural":
            assert self.model is not None  # loaded by now: that is no part of a frame
        watch = Stopwatch()
        found, lost = self.render(task, ms)
        answer: FrameAnswer = {
            **watch.costs(),
            "way": task.way.name,
            "spp": task.way.spp,
            "masked": lost,
            "ms": {name: round(value, 2) for name, value in ms.items()},
        }
        return _Rendered(task, found, answer)

    def _write(self, rendered: _Rendered) -> None:
        task, (layers, *plain) = rendered.task, rendered.layers
        header = {**rendered.answer, "fingerprint": task.fingerprint, "view": task.view.model_dump(mode="json")}
        for path in (task.output, task.picture):
            path.parent.mkdir(parents=True, exist_ok=True)
        task.picture.unlink(missing_ok=True)  # an older one beside a new frame would pass for its picture
        with ThreadPoolExecutor(1) as beside:  # a picture is compressed by one core
            picture = beside.submit(self._write_picture, task.picture, layers)
            write_exr(task.output, layers, header, half=HALF)
            picture.result()
        if task.plain is not None:
            write_exr(task.plain, plain[0], header, half=HALF)

    def render(self, task: FrameTask, ms: dict[str, float]) -> tuple[list[Layers], int]:
        """(channels of LAYERS, float32 [H, W] each, of the frame and, if wanted, of its base image; pixels that were
        not finite). ms: milliseconds of the parts."""
        if task.way.name == "path":
            found, lost = self._path(task, ms)
        else:
            found, lost = self._from_base(task, ms)
        if self.background is not None:
            behind = timed(ms, "background", self.background.frame, task.view)
            for layers in found:
                clear = 1 - np.clip(layers["A"], 0, 1)
                for i, name in enumerate("RGB"):
                    layers[name] = layers[name] + clear * behind[..., i]
                layers["A"] = np.ones_like(layers["A"])
        return found, lost

    def _write_picture(self, path: Path, layers: Layers) -> None:
        """As it is displayed, over white."""
        write_png(path, over_white(self.display, rgba(layers))[0].permute(1, 2, 0).numpy())

    def _from_base(self, task: FrameTask, ms: dict[str, float]) -> tuple[list[Layers], int]:
        if self.base is None:
            raise UserError(f"frame {task.view.name}: {task.way.told} need baked light")
        self.base.repaired = self.base.masked = 0
        if task.earlier is None:
            channels = timed(ms, "base image", self.base.channels, task.view, task.way.spp, smooth=task.way.smooth)
        else:
            asked = (task.view, task.earlier, task.number, task.way.spp)
            channels = timed(ms, "base image", self.base.remembered, *asked, smooth=task.way.smooth)
        lost = self.base.masked
        colours: list[np.ndarray] = []
        if task.way.name == "neural":
            colours.append(timed(ms, NETWORK, self._corrected, task, channels))
        if task.way.name == "base" or task.plain is not None:
            premultiplied = np.stack([channels[f"base.{c}"] for c in "RGB"], axis=-1)
            colours.append(premultiplied / np.maximum(channels["base.A"], LEAST_ALPHA)[..., None])
        alpha, others = channels["coverage"], {name: channels[name] for name in LAYERS if name in channels}
        return [
            others | {name: colour[..., i] * alpha for i, name in enumerate("RGB")} | {"A": alpha} for colour in colours
        ], lost

    def _corrected(self, task: FrameTask, channels: dict[str, np.ndarray]) -> np.ndarray:
        """The network's radiance, linear Rec.709, straight, float32 [H, W, 3]."""
        if self.common.checkpoint is None:
            self.model.settings = self.model.settings.model_copy(update={"trust": task.trust})
        data = view_in_memory(channels, self.common.frame, task.view, display=self.display, base="baked")
        radiance = render(self.model, data.to(next(self.model.parameters()).device)).radiance
        if radiance is None:
            raise UserError("shots need a model whose output is radiance: type --set model.output=log")
        return radiance[0].permute(1, 2, 0).numpy()

    def _path(self, task: FrameTask, ms: dict[str, float]) -> tuple[list[Layers], int]:
        view = task.view
        frames = self.frames((view.width, view.height))
        image, lost = masked(timed(ms, "path tracing", self._traced, task, frames))
        guide = timed(ms, "primary rays", frames.auxiliary, view, GUIDE_RAYS, task.seed)
        clean = timed(ms, "denoiser", denoise, image, guide.albedo, guide.normal, quality=task.way.quality)
        gbuffer, more = masked_channels(timed(ms, "G-buffer", frames.gbuffer, view))
        alpha = guide.coverage if task.lens is None else image[..., 3]
        layers = {name: clean[..., i] for i, name in enumerate("RGB")} | {"A": alpha}
        layers |= {name: gbuffer[name] for name in LAYERS if name in gbuffer}
        return [layers | {f"albedo.{c}": guide.albedo[..., i] for i, c in enumerate("RGB")}], lost + more

    def _traced(self, task: FrameTask, frames: Frames) -> np.ndarray:
        """Path-traced RGBA, premultiplied, float32 [H, W, 4], in launches that fit in memory."""
        view, spp = task.view, task.way.spp
        if task.lens is not None:
            integrator, _ = self.engine.integrator(self.common.bundle, self.common.integrator, self.common.max_depth)
            sensor = self.engine.sensor(view, task.lens)
            self.engine.compile(self.common.bundle, integrator, sensor, view)
            image, _ = self.engine.frame(self.common.bundle, integrator, sensor, view, spp, task.seed)
            return image.astype(np.float32)
        each = _at_once(task)
        launches = -(-spp // each)
        total = sum(frames.path(view, each, task.seed * 4096 + launch) for launch in range(launches))
        return np.asarray(total, np.float32) / launches


def _at_once(task: FrameTask) -> int:
    """Samples per pixel of one launch: a power of two, so that few kernels are compiled."""
    most = min(task.way.spp, EACH, MAX_RAYS // (task.view.width * task.view.height))
    return 1 << max(0, most.bit_length() - 1)

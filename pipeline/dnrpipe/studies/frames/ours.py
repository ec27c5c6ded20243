"""Our frames, from nothing but a camera: G-buffer and base image, the denoiser, then the network; each part timed.

G-buffer and base image come from one kernel of Mitsuba in this process. What it gives goes through the EXR files that
the trainer reads, which is not timed: a viewer would hand over memory.
"""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dnrtrain.checkpoint import load_model, read_record
from dnrtrain.contract import View
from dnrtrain.dataset import load_views
from dnrtrain.exr import write_exr
from dnrtrain.model import render_views

from ...core.errors import UserError
from ...raytrace.base_renderer import BaseRenderer
from ...raytrace.base_worker import as_channels, as_finished, denoised, with_coverage
from ...raytrace.history import History
from ...raytrace.light_worker import read_light
from ...raytrace.smoothing import Smoother
from ...raytrace.temporal_filter import KNOWN, Finished, TemporalFilter
from ...stages.base_images import light_path
from .scene import BenchScene, Clock

TIMED = ("none", "baked")
"""Base images that this benchmark can render frame by frame."""
NEURAL, BASE, SMOOTH = "neural", "base image alone", "base image, smoothed"
NEURAL_SMOOTH = "smoothed, neural"
REMEMBERS, FILTERED = ", remembers", ", filtered"
"""End the names of frames that remember the ones before, and of those of them that are filtered with the ones next to
them."""


def is_own(name: str) -> bool:
    """Whether the renderer of that name is ours, and not path tracing."""
    return name.startswith((NEURAL, BASE, SMOOTH, NEURAL_SMOOTH))


class Ours:
    """The workspace's fine-tuned model on the CPU, its base image, and that smoothed instead of denoised (`smoothing`).

    model is None, and frames have nothing neural, where the workspace has none: the base image alone is measured then.
    samples: rays per pixel of base images, each with the same model, whatever it was trained with; none: the
    workspace's. folder, light: another model and baked light than the workspace's. smoothed: False: none are.
    Raises UserError: the model has a base image that is not timed here, or its light is not baked.
    """

    def __init__(
        self,
        scene: BenchScene,
        samples: tuple[int, ...] = (),
        folder: Path | None = None,
        light: Path | None = None,
        *,
        smoothed: bool = True,
    ) -> None:
        folder = folder or scene.workspace.checkpoints("step2")
        self.scene = scene
        self.model = load_model(folder) if read_record(folder) is not None else None
        self.base: Literal["none", "raster", "baked", "direct", "path"] = (
            "baked" if self.model is None else self.model.settings.base
        )
        if self.base not in TIMED:
            raise UserError(f"{folder}: base image '{self.base}' cannot be timed here, only {', '.join(TIMED)}")
        self.renderer: BaseRenderer | None = None
        counts: tuple[int | None, ...] = (None,)
        if self.base == "baked":
            light = light or light_path(scene.workspace)
            if not light.exists():
                raise UserError(f"{light}: the light is not baked; run `dnrpipe finetune` with model.base=baked first")
            mitsuba_scene = scene.engine.scenes[str(scene.bundle)]
            gloss = not scene.settings.base.denoise
            self.renderer = BaseRenderer(
                scene.engine.mi, mitsuba_scene, read_light(light), gloss=gloss, unit_scale=scene.engine.unit_scale
            )
            counts = samples or (scene.settings.base.samples,)
        self.smoother = Smoother(scene.engine.mi)
        denoises = self.renderer is not None and scene.settings.base.denoise
        # Smoothed, denoised, or left as they are, base images have samples of their own (`sequence`).
        kinds = (None,) if not denoises else (True, False) if smoothed else (False,)
        self.histories = {(count, smooth): History(scene.engine.mi) for count in counts for smooth in kinds}
        self.filter = TemporalFilter(scene.engine.mi)
        self.last: dict[tuple[int | None, bool | None], list[tuple[Finished, dict[str, float]]]] = {}
        """Of the frames that remember, the last three, with ms by part."""

    def begin(self) -> None:
        """Forget the frames so far."""
        self.last = {}
        for history in self.histories.values():
            history.begin()

    def remember(self, view: View, clock: Clock) -> None:
        """Take in what a frame of a moving camera sees."""
        for (samples, smooth), history in self.histories.items():
            self._inputs(samples, smooth, view, clock, history)

    def frame(self, view: View, clock: Clock, *, remember: bool = False) -> dict[str, dict[str, Any]]:
        """By NEURAL, BASE, SMOOTH and NEURAL_SMOOTH, and the rays per pixel: {"picture": display RGB over white
        [1, 3, H, W], "parts": {name: ms}}.

        remember: with what earlier such frames saw, since `begin`; only of baked light.
        """
        result: dict[str, dict[str, Any]] = {}
        for (samples, smooth), history in self.histories.items():
            memory = history if remember else None
            channels, parts = self._inputs(samples, smooth, view, clock, memory)
            if self.renderer is not None and smooth is not None:
                channels, parts["coverage"] = clock.time(partial(with_coverage, channels))
                clean = partial(denoised, channels, diffuse=self.renderer.lets_through)
                found, ms = clock.time(partial(self.smoother, channels) if smooth else clean)
                channels, parts["smoothing" if smooth else "denoiser"] = channels | found, ms
            if remember and samples is not None:
                last = [*self.last.get((samples, smooth), []), (as_finished(view, channels), parts)]
                self.last[samples, smooth] = last[-KNOWN:]
            result |= self._shown(samples, smooth, view, channels, parts, clock, REMEMBERS if remember else "")
        return result

    def filtered(self, clock: Clock) -> dict[str, dict[str, Any]]:
        """As `frame`, of the frame before the last that remembers, filtered with those next to it."""
        result: dict[str, dict[str, Any]] = {}
        for (samples, smooth), last in self.last.items():
            (after, _), (own, parts), *before = reversed(last)
            found, ms = clock.time(partial(self.filter, own, before[0][0] if before else None, after))
            spent = {**parts, "temporal filter": ms}
            result |= self._shown(samples, smooth, own.view, as_channels(found), spent, clock, REMEMBERS + FILTERED)
        return result

    def _shown(
        self,
        samples: int | None,
        smooth: bool | None,
        view: View,
        channels: dict[str, np.ndarray],
        parts: dict[str, float],
        clock: Clock,
        end: str,
    ) -> dict[str, dict[str, Any]]:
        """A frame by its base image and by the network: see `frame`. end: of the names."""
        base, neural = (SMOOTH, NEURAL_SMOOTH) if smooth else (BASE, NEURAL)
        result: dict[str, dict[str, Any]] = {}
        if samples is not None:
            result[f"{base}, {samples} rays{end}"] = {"picture": self._picture(channels), "parts": dict(parts)}
        if self.model is not None:
            rays = "" if samples is None else f", {samples} rays"
            result[neural + rays + end] = self._neural(view, channels, parts, clock)
        return result

    def _neural(
        self, view: View, channels: dict[str, np.ndarray], parts: dict[str, float], clock: Clock
    ) -> dict[str, Any]:
        assert self.model is not None
        data = self._data(view, channels)
        picture, ms = clock.time(partial(render_views, self.model, data))
        return {"picture": picture.float(), "parts": {**parts, "network": ms}}

    def _picture(self, channels: dict[str, np.ndarray]) -> Any:
        """A base image as it is displayed."""
        alpha = channels["coverage"][..., None]
        base = np.stack([channels[f"base.{c}"] for c in "RGB"], axis=-1)
        straight = base / np.maximum(channels["base.A"], 1e-6)[..., None]
        return self.scene.shown(np.concatenate([straight * alpha, alpha], axis=-1))

    def _inputs(
        self, samples: int | None, smooth: bool | None, view: View, clock: Clock, history: History | None
    ) -> tuple[dict[str, np.ndarray], dict[str, float]]:
        """(channels, not denoised; ms by part). The base image's kernel gives the G-buffer, too. smooth: of
        ``histories``."""
        if self.renderer is None or samples is None:
            channels, ms = clock.time(partial(self.scene.frames.gbuffer, view))
            return channels, {"G-buffer": ms}
        number = 0 if history is None else history.number
        channels, ms = clock.time(partial(self.renderer.frame, view, samples, number, tiles=smooth is not False))
        mask, alpha = channels["mask"] > 0.5, channels["base.A"]
        coverage, finer = clock.time(partial(self.scene.frames.coverage, view, mask, alpha=alpha))
        parts = {"base image and G-buffer": ms, "silhouettes": finer}
        if history is not None:
            channels, parts["history"] = clock.time(partial(history.take, view, channels))
        return {**channels, "coverage": coverage}, parts

    def _data(self, view: View, channels: dict[str, np.ndarray]) -> Any:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "view.exr"
            write_exr(path, channels, {})
            return load_views(
                [path],
                None,
                self.scene.frame,
                cameras=[view],
                folder=self.scene.workspace.scene,
                target=False,
                base=self.base,
                base_files=[path] if self.renderer is not None else None,
            )

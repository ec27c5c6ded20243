"""The frame process: renders one view at a time, and keeps scene, kernels and network between them.

A worker of `dnrpipe.workers.processes`. What it renders (`mode`):

    neural      the neural renderer's picture                 base      the base image that it corrects
    normal, depth, uv, albedo, coverage                       the G-buffer
    reference   path-traced; every request for the same view adds samples
    error       FLIP between neural and reference so far
    nearest     the ray-traced picture of a training view

Base images remember the frames before (`raytrace.history`): those of a moving camera, and of one at rest, whose first
frame begins anew and whose every further frame adds rays.
"""

from __future__ import annotations

import base64
import functools
import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from dnrpipe.core.errors import UserError
from dnrpipe.core.images import eight_bit, flip_error, over_white, picture_of, rgba
from dnrpipe.core.settings import Settings
from dnrpipe.raytrace.base_worker import Worker as BaseWorker
from dnrpipe.raytrace.engine import Engine, masked, masked_channels
from dnrpipe.raytrace.frames import Frames
from dnrpipe.raytrace.history import History
from dnrpipe.raytrace.recorded import timed
from dnrpipe.stages.trainer import torch_device
from dnrtrain.checkpoint import load_model
from dnrtrain.contract import RASTER_CHANNELS, SceneFrame, View, require_channels
from dnrtrain.dataset import view_in_memory
from dnrtrain.display import DisplayTransform
from dnrtrain.exr import read_exr
from dnrtrain.model import render_views

BASE_ONLY = ("base", "albedo")
REMEMBERED = ("neural", "base", "error")
"""Modes that show a base image, or what is made of it."""


class Worker:
    """Renders pictures of one workspace.

    common: {"scene" folder, "frame", "checkpoint", "device" (setting), "kind" of base image, "bundle", "variant",
    "integrator", "max_depth", "base": common of the base image worker or None}.
    task: {"view" as JSON, "mode", "samples": rays per pixel of a base image, None for the model's own, "spp": to add to
    a reference, "fine": best quality, "file": for nearest}; the answer is {"picture": base64, "type", "ms": {stage:
    milliseconds}, "spp", "rays": per pixel of the base image, of all frames at rest, "repaired": pixels traced for this
    picture that were not finite, "width", "height"}.
    """

    def __init__(self, common: dict[str, Any]) -> None:
        self.common = common
        self.kind = common["kind"]
        self.bundle = Path(common["bundle"])
        self.frame = SceneFrame.model_validate(common["frame"])
        self.display = DisplayTransform(self.frame, Path(common["scene"]))
        self.base = BaseWorker(common["base"]) if common["base"] is not None else None
        self.engine = self.base.engine if self.base is not None else Engine(common["variant"], 0, [self.bundle])
        if not self.engine.compiled:
            raise UserError("the live view needs a jit variant of Mitsuba (LLVM or CUDA; see `dnrpipe doctor`)")
        self.device = torch_device(Settings(device=common["device"]))
        self.model = load_model(Path(common["checkpoint"]), self.device)
        tracing = (common["integrator"], int(common["max_depth"]))
        self.frames = functools.cache(
            functools.partial(Frames, self.engine, self.bundle, *tracing)
        )  # by (width, height)
        self.history = History(self.engine.mi) if self.kind == "baked" else None
        self.resting: View | None = None  # of the last frame, where that was at rest
        self.traced: tuple[str, np.ndarray, int] | None = None
        self.repaired = 0  # pixels of the current picture that were not finite

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        view, mode = View.model_validate(task["view"]), task["mode"]
        if mode in BASE_ONLY and self.base is None:
            raise UserError(f"{mode}: this model corrects no base image")
        ms: dict[str, float] = {}
        spp, rays, self.repaired = None, None, 0
        if mode == "nearest":
            picture = timed(ms, "file", self._file, Path(task["file"]))
        elif mode == "reference":
            picture, spp = timed(ms, "path tracing", self._reference, view, int(task["spp"]))
        else:
            self._begin(view, bool(task["fine"]))
            smooth = not task["fine"]  # the denoiser's time goes into rays and pixels of what moves
            part = "base image" if self.base else "G-buffer"
            channels = timed(ms, part, self._channels, view, task["samples"], smooth)
            if self.history is not None and mode in REMEMBERED:
                channels = timed(ms, "history", self.history.take, view, channels)
                rays = int(channels["rays"].max())
            if self.base is not None and self.base.denoise and mode in REMEMBERED:
                channels = timed(ms, "smoothing" if smooth else "denoiser", self.base.finished, channels, smooth)
            if mode in ("neural", "error"):
                picture = timed(ms, "network", self._neural, view, channels)
            else:
                picture = timed(ms, "colours", self._shown, mode, channels)
            if mode == "error":
                truth, spp = timed(ms, "path tracing", self._reference, view, int(task["spp"]))
                picture = timed(ms, "FLIP", flip_error, truth, picture)[1]
        data, kind = timed(ms, "encoding", encode, picture, bool(task["fine"]))
        return {
            "picture": base64.b64encode(data).decode("ascii"),
            "type": kind,
            "ms": {name: round(value, 2) for name, value in ms.items()},
            "spp": spp,
            "rays": rays,
            "repaired": self.repaired,
            "width": picture.shape[1],
            "height": picture.shape[0],
        }

    def _begin(self, view: View, fine: bool) -> None:
        """Begin the history anew where a camera comes to rest: what moved is good enough to move on, not to stay."""
        if self.history is not None and fine and view != self.resting:
            self.history.begin()
        self.resting = view if fine else None

    def _channels(self, view: View, samples: int | None, smooth: bool) -> dict[str, np.ndarray]:
        """Base image, which will be smoothed or denoised, and G-buffer, or the G-buffer alone."""
        if self.base is None:
            channels, lost = masked_channels(self.frames((view.width, view.height)).gbuffer(view))
            self.repaired += lost
            return channels
        self.base.repaired = self.base.masked = 0
        if self.history is None:
            channels = self.base.channels(view)
        else:
            rays = samples and min(samples, self.base.common.samples)
            channels = self.base.grainy(view, rays, self.history.number, smooth=smooth)
        self.repaired += self.base.repaired + self.base.masked
        return channels

    def _neural(self, view: View, channels: dict[str, np.ndarray]) -> np.ndarray:
        """Display RGB over white, float32 [H, W, 3] in [0, 1]."""
        data = view_in_memory(channels, self.frame, view, display=self.display, base=self.kind)
        return picture_of(render_views(self.model, data)[0])

    def _shown(self, mode: str, channels: dict[str, np.ndarray]) -> np.ndarray:
        """A channel as a picture over white, float32 [H, W, 3] in [0, 1]."""
        mask = channels["mask"][..., None] > 0.5
        if mode == "base":
            return self._over_white(rgba(channels, "base."))
        if mode == "albedo":
            values = np.clip(np.stack([channels[f"albedo.{c}"] for c in "RGB"], axis=-1), 0, 1) ** (1 / 2.2)
        elif mode == "normal":
            values = 0.5 + 0.5 * np.stack([channels[f"normal.{c}"] for c in "XYZ"], axis=-1)
        elif mode == "uv":
            values = np.stack([channels["uv.U"], channels["uv.V"], np.zeros_like(channels["uv.U"])], axis=-1)
        elif mode == "depth":
            near, far = self.frame.near, self.frame.far
            values = np.repeat(1 - np.clip((channels["depth.Z"] - near) / (far - near), 0, 1)[..., None], 3, axis=-1)
        else:
            return np.repeat(channels["coverage"][..., None], 3, axis=-1).astype(np.float32)
        return np.where(mask, values, 1).astype(np.float32)

    def _reference(self, view: View, spp: int) -> tuple[np.ndarray, int]:
        """(the mean of all samples that this view has had so far, as a picture; how many those are)."""
        key = view.model_copy(update={"name": "reference"}).model_dump_json()
        known = self.traced if self.traced is not None and self.traced[0] == key else None
        total, count = (known[1], known[2]) if known else (np.zeros((view.height, view.width, 4), np.float64), 0)
        sample, lost = masked(self.frames((view.width, view.height)).path(view, spp, seed=1 + count))
        self.repaired += lost
        total, count = total + np.asarray(sample, np.float64) * spp, count + spp
        self.traced = (key, total, count)
        return self._over_white((total / count).astype(np.float32)), count

    def _file(self, path: Path) -> np.ndarray:
        channels, _ = read_exr(path)
        require_channels(path, channels, RASTER_CHANNELS, "run `dnrpipe raytrace-selected`")
        return self._over_white(rgba(channels))

    def _over_white(self, image: np.ndarray) -> np.ndarray:
        """Linear premultiplied RGBA [H, W, 4] -> display RGB over white, float32 [H, W, 3]."""
        return over_white(self.display, image)[0].permute(1, 2, 0).numpy()


def encode(picture: np.ndarray, fine: bool) -> tuple[bytes, str]:
    """(bytes, media type) of display RGB [H, W, 3] in [0, 1]: JPEG in a hurry, else WebP of high quality."""
    image = Image.fromarray(eight_bit(picture))
    buffer = io.BytesIO()
    if fine:
        image.save(buffer, "WEBP", quality=95, method=1)
        return buffer.getvalue(), "image/webp"
    image.save(buffer, "JPEG", quality=85)
    return buffer.getvalue(), "image/jpeg"

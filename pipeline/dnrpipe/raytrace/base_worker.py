"""The base-image worker: renders the images that the network corrects (see :mod:`.base`) into EXR files."""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.errors import UserError
from dnrtrain.contract import View
from dnrtrain.exr import write_exr

from .base import BaseRenderer
from .denoise import denoise
from .engine import Engine
from .light_worker import read_light
from .units import scaled_view

COLOUR = ("base.R", "base.G", "base.B", "base.A")


class Worker:
    """Renders base images.

    common: {"bundle", "variant", "kind", "samples"}; kind baked: also "light" (its file); kinds direct and path: also
    "integrator", "max_depth", "spp", "seed": path-traced samples, denoised with albedo and normal, take the place of
    the colour.
    task: {"view": View as JSON, "output", "fingerprint"}
    """

    def __init__(self, common: dict[str, Any]) -> None:
        self.common = common
        self.bundle = Path(common["bundle"])
        self.engine = Engine(common["variant"], 0, [self.bundle])
        if not self.engine.compiled:
            raise UserError("base images need a jit variant of Mitsuba (LLVM or CUDA; see `dnrpipe doctor`)")
        baked = common["kind"] == "baked"
        light = read_light(Path(common["light"])) if baked else np.zeros((2, 2, 2, 3), np.float32)
        scene = self.engine.scenes[str(self.bundle)]
        self.renderer = BaseRenderer(self.engine.mi, scene, light, int(common["samples"]))
        self.warm = False

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        view = View.model_validate(task["view"])
        if not self.warm:
            self._channels(view)  # compiles the kernel, which is no cost of a frame
            self.warm = True
        started, cpu = time.monotonic(), time.process_time()
        channels = self._channels(view)
        numbers = {
            "seconds": time.monotonic() - started,
            "cpu_seconds": time.process_time() - cpu,
            "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "kind": self.common["kind"],
            "samples": self.common["samples"],
        }
        write_exr(
            Path(task["output"]),
            channels,
            {**numbers, "fingerprint": task["fingerprint"], "view": view.model_dump(mode="json")},
        )
        return numbers

    def _channels(self, view: View) -> dict[str, np.ndarray]:
        channels = self.renderer.frame(scaled_view(view, self.engine.unit_scale))
        channels["depth.Z"] = channels["depth.Z"] / self.engine.unit_scale
        if self.common["kind"] != "baked":
            channels |= self._traced(view, channels)
        return channels

    def _traced(self, view: View, channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """A few path-traced samples, denoised, as the colour."""
        common = self.common
        integrator, _ = self.engine.integrator(self.bundle, common["integrator"], int(common["max_depth"]))
        sensor = self.engine.sensor(view)
        picture, _ = self.engine.frame(self.bundle, integrator, sensor, view, int(common["spp"]), int(common["seed"]))
        picture = np.where(np.isfinite(picture).all(axis=-1, keepdims=True), picture, 0).astype(np.float32)
        albedo = np.stack([channels[f"albedo.{c}"] for c in "RGB"], axis=-1).clip(0, 1)
        normal = np.stack([channels[f"normal.{c}"] for c in "XYZ"], axis=-1)
        clean = denoise(picture, albedo, normal, threads=1)
        result = {name: clean[..., i] for i, name in enumerate(COLOUR)}
        return result | {f"diffuse.{c}": clean[..., i] for i, c in enumerate("RGB")}

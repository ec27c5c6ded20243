"""The ray-tracing worker: path-traces views of a Mitsuba bundle into EXR files.

Notation
    A, B     two independent half renders of a view, each spp/2 samples per pixel
    noise    estimated relative RMSE of (A+B)/2 in display space: rms((A-B)/2) / rms(value); of denoised views, A and
             B are denoised first: the noise that is left, not the denoiser's own error

Two halves cost nothing extra (their mean is the image) and give an unbiased estimate of the variance.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.effects.statistics import display
from dnrtrain.contract import View
from dnrtrain.exr import write_exr

from .denoise import denoise
from .engine import Engine
from .sensors import sensor_dict

REPAIR_ROUNDS = 3
AUXILIARY_SPP = 64


class Worker:
    """Loads the bundle once; each call traces one view.

    common: {"bundle": path of scene.xml, "variant": str, "threads": int}
    task: {"view": View as JSON, "output": path, "spp", "max_depth", "seed", "fingerprint"}, and optionally
    "integrator" (direct, path, volpath; default path), "lens" (see :func:`.sensors.sensor_dict`) and "denoise":
    R G B are then denoised, and what was traced is in the channels ``raw.R``, ``raw.G``, ``raw.B``.
    """

    def __init__(self, common: dict[str, Any]) -> None:
        self.bundle = Path(common["bundle"])
        self.engine = Engine(common["variant"], int(common["threads"]), [self.bundle])

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        view = View.model_validate(task["view"])
        spp, seed, depth = int(task["spp"]), int(task["seed"]), int(task["max_depth"])
        started, cpu = time.monotonic(), time.process_time()
        lens = task.get("lens")
        sensor = self.engine.sensor(view, lens)
        integrator, name = self.engine.integrator(self.bundle, task.get("integrator", "path"), depth)

        def render(samples: int, number: int) -> tuple[np.ndarray, int]:
            return self.engine.frame(self.bundle, integrator, sensor, view, samples, number)

        half_a, done_a = render((spp + 1) // 2, seed * 2)
        half_b, done_b = render(spp // 2, seed * 2 + 1) if spp > 1 else (half_a, 0)
        half_a, half_b, repaired, masked = _repair(render, half_a, half_b, max(1, spp // 2), seed)
        total = done_a + done_b
        image = (half_a * done_a + half_b * done_b) / total
        channels = {channel: image[..., i] for i, channel in enumerate("RGBA")}
        if task.get("denoise"):
            channels |= {f"raw.{channel}": image[..., i] for i, channel in enumerate("RGB")}
            halves = [image, half_a, half_b] if done_b else [image]
            clean = self._denoised(halves, view)
            channels |= {channel: clean[0][..., i] for i, channel in enumerate("RGB")}
            half_a, half_b = clean[1:] if done_b else (half_a, half_b)
        noise, noise_rmse = estimate_noise(half_a, half_b) if done_b else (None, None)
        numbers = {
            "spp": total,
            "max_depth": depth,
            "seed": seed,
            "integrator": name + ("+lens" if lens else ""),
            "variant": self.engine.variant,
            "seconds": time.monotonic() - started,
            "cpu_seconds": time.process_time() - cpu,
            "load_seconds": self.engine.load_seconds,
            "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "noise": noise,
            "noise_rmse": noise_rmse,
            "repaired": repaired,
            "masked": masked,
            "denoised": bool(task.get("denoise")),
        }
        write_exr(
            Path(task["output"]),
            channels,
            {**numbers, "fingerprint": task["fingerprint"], "view": view.model_dump(mode="json")},
        )
        return numbers

    def _denoised(self, images: list[np.ndarray], view: View) -> list[np.ndarray]:
        """The images [H, W, 4] without noise; one thread, so that bits repeat."""
        albedo, normal = self.engine.auxiliary(self.bundle, view, AUXILIARY_SPP)
        return [denoise(image, albedo, normal, threads=1).astype(np.float64) for image in images]


def _repair(
    render: Callable[[int, int], tuple[np.ndarray, int]],
    half_a: np.ndarray,
    half_b: np.ndarray,
    spp: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Non-finite pixels are traced again with other seeds; what stays is set to 0 and counted."""
    repaired = masked = 0
    halves = []
    for offset, half in enumerate((half_a, half_b)):
        bad = ~np.isfinite(half).all(axis=-1)
        for attempt in range(REPAIR_ROUNDS):
            if not bad.any():
                break
            again, _ = render(spp, 0x80000 + seed + 0x1000 * (attempt * 2 + offset))
            good = bad & np.isfinite(again).all(axis=-1)
            half[good] = again[good]
            repaired += int(good.sum())
            bad &= ~good
        half[bad] = 0.0
        masked += int(bad.sum())
        halves.append(half)
    return halves[0], halves[1], repaired, masked


def estimate_noise(half_a: np.ndarray, half_b: np.ndarray) -> tuple[float, float]:
    """(relative, absolute) RMSE of the mean of two independent halves, in sRGB display space over white.

    E[((A-B)/2)^2] = Var[(A+B)/2] for independent, equally noisy A and B (first order through the
    display curve). Absolute in display units [0, 1]; relative to the rms of the picture.
    """
    a, b = display(half_a), display(half_b)
    rmse = float(np.sqrt(np.mean(((a - b) / 2) ** 2)))
    level = float(np.sqrt(np.mean(((a + b) / 2) ** 2)))
    return (rmse / level if level > 0 else 0.0), rmse


__all__ = ["Worker", "estimate_noise", "sensor_dict"]

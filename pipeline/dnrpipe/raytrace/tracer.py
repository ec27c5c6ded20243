"""The ray-tracing worker: path-traces views of a Mitsuba bundle into EXR files.

Notation
    A, B     two independent half renders of a view, each spp/2 samples per pixel
    noise    estimated relative RMSE of (A+B)/2 in display space: rms((A-B)/2) / rms(value)

Two halves cost nothing extra (their mean is the image) and give an unbiased estimate of the variance.
"""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import View
from dnrtrain.exr import write_exr

from .visibility import camera_integrator

# Samples per kernel launch x pixels: bounds the wavefront's memory (about 1 GiB on the CPU).
MAX_WAVEFRONT = 4_000_000
REPAIR_ROUNDS = 3


class Worker:
    """Loads the bundle once; each call traces one view.

    common: {"bundle": path of scene.xml, "variant": str, "threads": int}
    task: {"view": View as JSON, "output": path, "spp", "max_depth", "seed", "fingerprint"}
    """

    def __init__(self, common: dict[str, Any]) -> None:
        import drjit as dr
        import mitsuba as mi

        mi.set_variant(common["variant"])
        mi.set_log_level(mi.LogLevel.Warn)
        self.mi = mi
        self.variant = common["variant"]
        started = time.monotonic()
        self.scene = mi.load_file(common["bundle"])
        self.load_seconds = time.monotonic() - started
        # One thread per worker: sums over samples are then in a fixed order, so the same seed gives the
        # same bits. Views run side by side in several workers instead. Only after loading: the parallel
        # scene loader waits for ever on an empty pool.
        dr.set_thread_count(max(0, int(common["threads"]) - 1))

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        mi = self.mi
        view = View.model_validate(task["view"])
        spp, seed = int(task["spp"]), int(task["seed"])
        started, cpu = time.monotonic(), time.process_time()
        sensor = mi.load_dict(sensor_dict(mi, view))
        integrator, integrator_name = camera_integrator(mi, self.scene, int(task["max_depth"]))
        half_a, done_a = self._render(sensor, integrator, view, (spp + 1) // 2, seed * 2)
        half_b, done_b = self._render(sensor, integrator, view, spp // 2, seed * 2 + 1) if spp > 1 else (half_a, 0)
        half_a, half_b, repaired, masked = self._repair(
            sensor, integrator, view, half_a, half_b, max(1, spp // 2), seed
        )
        total = done_a + done_b
        image = (half_a * done_a + half_b * done_b) / total
        noise, noise_rmse = estimate_noise(half_a, half_b) if done_b else (None, None)
        numbers = {
            "spp": total,
            "max_depth": int(task["max_depth"]),
            "seed": seed,
            "integrator": integrator_name,
            "variant": self.variant,
            "seconds": time.monotonic() - started,
            "cpu_seconds": time.process_time() - cpu,
            "load_seconds": self.load_seconds,
            "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "noise": noise,
            "noise_rmse": noise_rmse,
            "repaired": repaired,
            "masked": masked,
        }
        write_exr(
            Path(task["output"]),
            {name: image[..., i] for i, name in enumerate("RGBA")},
            {**numbers, "fingerprint": task["fingerprint"], "view": view.model_dump(mode="json")},
        )
        return numbers

    def _render(self, sensor: Any, integrator: Any, view: View, spp: int, seed: int) -> tuple[np.ndarray, int]:
        """Mean RGBA [H, W, 4] over ``spp`` samples, in launches that fit in memory."""
        chunk = max(1, min(spp, MAX_WAVEFRONT // (view.width * view.height)))
        total = np.zeros((view.height, view.width, 4), dtype=np.float64)
        done = launch = 0
        while done < spp:
            samples = min(chunk, spp - done)
            part = self.mi.render(
                self.scene,
                sensor=sensor,
                integrator=integrator,
                spp=samples,
                seed=((seed & 0xFFFFF) << 12) + launch,  # pyright: ignore[reportArgumentType]
            )
            total += np.array(part, dtype=np.float64) * samples
            done += samples
            launch += 1
        return total / done, done

    def _repair(
        self,
        sensor: Any,
        integrator: Any,
        view: View,
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
                again, _ = self._render(sensor, integrator, view, spp, 0x80000 + seed + 0x1000 * (attempt * 2 + offset))
                good = bad & np.isfinite(again).all(axis=-1)
                half[good] = again[good]
                repaired += int(good.sum())
                bad &= ~good
            half[bad] = 0.0
            masked += int(bad.sum())
            halves.append(half)
        return halves[0], halves[1], repaired, masked


def sensor_dict(mi: Any, view: View) -> dict[str, Any]:
    """Mitsuba ``perspective`` sensor of a view: box filter, RGBA film, off-centre principal point.

    Mitsuba looks along +Z with +X left; flipping X and Z takes our OpenGL axes there.
    The field of view is along x; pixels may be non-square only together with fl_x = fl_y.
    """
    to_world = view.matrix @ np.diag([-1.0, 1.0, -1.0, 1.0])
    if abs(view.fl_x - view.fl_y) > 1e-3 * view.fl_x:
        raise ValueError(
            f"view {view.name}: fl_x and fl_y differ ({view.fl_x:g}, {view.fl_y:g});"
            " Mitsuba has square pixels only: resample the camera file"
        )
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(0.5 * view.width / view.fl_x))),
        "fov_axis": "x",
        "principal_point_offset_x": (view.width / 2 - view.cx) / view.width,
        "principal_point_offset_y": (view.height / 2 - view.cy) / view.height,
        "near_clip": 1e-4,
        "far_clip": 1e7,
        "to_world": mi.ScalarTransform4f(to_world.tolist()),
        "film": {
            "type": "hdrfilm",
            "width": view.width,
            "height": view.height,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent"},
    }


def estimate_noise(half_a: np.ndarray, half_b: np.ndarray) -> tuple[float, float]:
    """(relative, absolute) RMSE of the mean of two independent halves, in sRGB display space over white.

    E[((A-B)/2)^2] = Var[(A+B)/2] for independent, equally noisy A and B (first order through the
    display curve). Absolute in display units [0, 1]; relative to the rms of the picture.
    """
    display = [_display_over_white(half) for half in (half_a, half_b)]
    rmse = float(np.sqrt(np.mean(((display[0] - display[1]) / 2) ** 2)))
    level = float(np.sqrt(np.mean(((display[0] + display[1]) / 2) ** 2)))
    return (rmse / level if level > 0 else 0.0), rmse


def _display_over_white(rgba: np.ndarray) -> np.ndarray:
    alpha = np.clip(rgba[..., 3:], 0.0, 1.0)
    straight = np.where(alpha > 0, rgba[..., :3] / np.maximum(alpha, 1e-6), 0.0)
    linear = np.clip(straight, 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return encoded * alpha + 1.0 - alpha

"""Worker that renders a view into one EXR with G-buffers, coverage and, where asked, rasterised colour."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.core.errors import UserError
from dnrpipe.raytrace.tasks import Costs
from dnrpipe.workers.processes import LocalWorker, WorkerDied
from dnrtrain.contract import GBUFFER_CHANNELS, RASTER_CHANNELS, View
from dnrtrain.exr import write_exr

from ..tasks import PassesAnswer, PassesCommon, PassesHeader, PassesTask
from .scratch import read_channels, scratch_folder

FAR_AWAY = 9e9  # Cycles writes depth 1e10 where a ray hits nothing
LAYER_PREFIX = "G."  # gbuffer_scene.GBUFFER_LAYER


class Worker:
    """Renders views of one prepared scene. common: a `PassesCommon`, task: a `PassesTask`."""

    def __init__(self, common: dict[str, Any]) -> None:
        self.common = PassesCommon.model_validate(common)
        data, module = self.common.data(), "dnrpipe.blender.passes.render_worker"
        kinds = ("gbuffer", "coverage", "raster")
        self.renderers = {kind: LocalWorker(module, {**data, "kind": kind}, None, {}) for kind in kinds}

    def __call__(self, task: dict[str, Any]) -> PassesAnswer:
        """Write the view's EXR. One frame at a time: processes side by side would spoil each other's seconds."""
        started, cpu = time.perf_counter(), time.process_time()
        wanted = PassesTask.model_validate(task)
        view = wanted.view
        with scratch_folder(view.width * view.height) as folder:
            frames = [self._render("gbuffer", view, folder)]
            channels, repaired = read_gbuffer(read_channels(folder / "gbuffer.exr", LAYER_PREFIX))
            gbuffer_seconds = time.perf_counter() - started
            frames.append(self._render("coverage", view, folder))
            channels["coverage"] = np.clip(read_channels(folder / "coverage.exr")["A"], 0, 1)
            geometry_seconds = time.perf_counter() - started
            if wanted.raster:
                frames.append(self._render("raster", view, folder))
                picture = read_channels(folder / "raster.exr")
                colour, bad = finite({name: picture[name] for name in RASTER_CHANNELS})
                channels |= colour
                repaired += bad
        seconds = time.perf_counter() - started
        header: PassesHeader = {
            "fingerprint": wanted.fingerprint,
            "view": view.name,
            "raster_engine": self.common.raster_engine if wanted.raster else None,
            "raster_samples": self.common.raster_samples if wanted.raster else 0,
            "repaired": repaired,
            "seconds": seconds,
            "gbuffer_seconds": gbuffer_seconds,
            "coverage_seconds": geometry_seconds - gbuffer_seconds,
            "raster_seconds": seconds - geometry_seconds if wanted.raster else 0.0,
        }
        write_exr(wanted.output, channels, dict(header))
        return {
            **header,
            "seconds": time.perf_counter() - started,
            "cpu_seconds": time.process_time() - cpu + sum(frame["cpu_seconds"] for frame in frames),
            "peak_mb": sum(frame["peak_mb"] for frame in frames),
        }

    def _render(self, kind: str, view: View, folder: Path) -> Costs:
        """Write ``KIND.exr`` into the folder. A renderer that died is replaced by the next call.

        Raises UserError for unusable input, RuntimeError when rendering fails or the renderer dies.
        """
        task = {"view": view.model_dump(mode="json"), "path": str(folder / f"{kind}.exr")}
        try:
            answer = self.renderers[kind].answer(task, threading.TIMEOUT_MAX)
        except WorkerDied as death:
            raise RuntimeError(f"the {kind} renderer {str(death).removeprefix('worker ')}") from None
        if "error" in answer:
            raise (RuntimeError if answer["retry"] or answer["errno"] else UserError)(answer["error"])
        return answer["result"]


def read_gbuffer(passes: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], int]:
    """Cycles' passes as the contract's channels (all but coverage), zero outside the mask.

    Cycles turns the shading normal with the geometric one towards the camera, so that both sides of
    a sheet differ. Returns the number of pixels that had to be repaired (non-finite, or no normal).
    """
    mask = (passes["Combined.A"] > 0.5) & (passes["Depth.Z"] < FAR_AWAY)
    found = {
        "depth.Z": passes["Depth.Z"],
        **{f"normal.{axis}": passes[f"Normal.{axis}"] for axis in "XYZ"},
        **{f"uv.{axis}": passes[f"UV.{axis}"] for axis in "UV"},
        **{f"position.{axis}": passes[f"Position.{axis}"] for axis in "XYZ"},
        "object.Id": passes["Object Index.X"],
    }
    found = {name: np.where(mask, values, np.float32(0)) for name, values in found.items()}
    found, repaired = finite(found)
    length = np.sqrt(sum(found[f"normal.{axis}"] ** 2 for axis in "XYZ"))
    lost = mask & (length < 1e-6)
    for axis in "XYZ":
        found[f"normal.{axis}"] /= np.where(length < 1e-6, 1, length)
    found["mask"] = mask.astype(np.float32)
    missing = set(GBUFFER_CHANNELS) - {"coverage"} - set(found)
    if missing:
        raise RuntimeError(f"G-buffer lacks {sorted(missing)}")
    return found, repaired + int(lost.sum())


def finite(channels: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], int]:
    """Zero the pixels that hold a non-finite number in any channel, and count them."""
    bad = ~np.logical_and.reduce([np.isfinite(values) for values in channels.values()])
    if bad.any():
        channels = {name: np.where(bad, np.float32(0), values) for name, values in channels.items()}
    return channels, int(bad.sum())

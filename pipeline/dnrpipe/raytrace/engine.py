"""Mitsuba in this process: one variant, bundles loaded once, frames as arrays."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dnrpipe.core.errors import UserError
from dnrtrain.contract import View

from . import plugins
from .auxiliary import auxiliary_integrator
from .recorded import Stopwatch, without_collection
from .second_targets import second_targets
from .sensors import row_of_sensors, scaled_lens, scaled_view, sensor_dict, unit_scale
from .tasks import BundleCommon
from .visibility import camera_integrator

# Samples per kernel launch x pixels: bounds the wavefront's memory (about 1 GiB on the CPU).
MAX_WAVEFRONT = 4_000_000
MAX_AUXILIARY = 1 << 24
"""The same of auxiliary images, whose rays carry less."""
LEAST_THREADS = 2
"""While a bundle loads: Mitsuba's EXR reader waits for a helper of its thread pool. With one core there is none."""
PASSES = "albedo:albedo,depth:depth,position:position,normal:sh_normal,geometric:geo_normal,uv:uv"


class Engine:
    """Renders views of bundles under one variant.

    Args:
        variant: of Mitsuba.
        threads: with 1, sums over samples have a fixed order, so that the same seed gives the same bits; views run side
            by side in several workers instead. 0: all cores.
        bundles: ``scene.xml`` files, variants of one scene in the same units.

    Plugins load one after the other: in parallel, Mitsuba 3.9 now and then fails at a sensor (bad_alloc, or
    basic_string::_M_create), takes no less time, and would wait for ever on an empty pool.
    Raises UserError: the scalar variant cannot render a bundle.
    """

    def __init__(self, variant: str, threads: int, bundles: Sequence[Path]) -> None:
        import drjit as dr
        import mitsuba as mi

        mi.set_variant(variant)
        mi.set_log_level(mi.LogLevel.Warn)
        plugins.register(mi)
        self.compiled = not variant.startswith("scalar")
        if self.compiled:
            self._targets = second_targets(mi)
        else:
            _refuse_instances(bundles)
        self.mi = mi
        self.variant = variant
        if dr.thread_count() < LEAST_THREADS:
            dr.set_thread_count(LEAST_THREADS)
        started = time.monotonic()
        self.scenes = {str(bundle): mi.load_file(str(bundle), parallel=False) for bundle in bundles}
        self.load_seconds = time.monotonic() - started
        self.unit_scale = unit_scale(bundles[0])
        if threads > 0:  # with an empty pool the caller's thread works, with any other it only waits
            dr.set_thread_count(threads if threads > 1 else 0)
        self._integrators: dict[tuple[str, str, int, bool], tuple[Any, str]] = {}
        self._sizes: set[tuple[int, int]] = set()

    def integrator(self, bundle: Path, kind: str, max_depth: int, passes: bool = False) -> tuple[Any, str]:
        """(integrator, its name for the file's header).

        Args:
            bundle: one of the engine's.
            kind, max_depth: see `visibility.camera_integrator`.
            passes: also compute Mitsuba's auxiliary channels, which cost time and are thrown away (for comparison).

        Raises UserError: the variant cannot leave caustics out.
        """
        if kind == "path-without-caustics" and not self.compiled:
            raise UserError("leaving caustics out needs a jit variant of Mitsuba (LLVM or CUDA); see `dnrpipe doctor`")
        key = (str(bundle), kind, max_depth, passes)
        if key not in self._integrators:
            inner, name = camera_integrator(self.mi, self.scenes[str(bundle)], max_depth, kind)
            if passes:
                inner, name = self.mi.load_dict({"type": "aov", "aovs": PASSES, "image": inner}), f"{name}+aov"
            self._integrators[key] = (inner, name)
        return self._integrators[key]

    def sensor(self, view: View, lens: dict[str, float] | None = None) -> Any:
        """A Mitsuba sensor for the view, in the bundles' units."""
        return self.mi.load_dict(self._camera(view, lens))

    def sensor_row(self, views: Sequence[View], lenses: Sequence[dict[str, float] | None]) -> Any:
        """One for views of the same size, whose pictures it shows side by side."""
        cameras = [self._camera(view, lens) for view, lens in zip(views, lenses, strict=True)]
        return self.mi.load_dict(row_of_sensors(cameras))

    def _camera(self, view: View, lens: dict[str, float] | None) -> dict[str, Any]:
        view, lens = scaled_view(view, self.unit_scale), scaled_lens(lens, self.unit_scale)
        return sensor_dict(self.mi, view, lens)

    def render(self, scene: Any, **options: Any) -> Any:
        """``mi.render`` with no garbage collection meanwhile."""
        with without_collection():
            return self.mi.render(scene, **options)

    def auxiliary(self, bundle: Path, view: View, spp: int) -> tuple[np.ndarray, np.ndarray, int]:
        """(albedo, shading normal in world space, number of pixels that were not finite and are 0); for the denoiser.

        The images, float32 [H, W, 3] each, are those of the module `auxiliary`.
        """
        scene = self.scenes[str(bundle)]
        if self.compiled:
            integrator = auxiliary_integrator(self.mi, scene)
        else:  # scalar variants, one ray at a time: the first surface, whatever it is
            integrator = self.mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        sensor, total, done = self.sensor(view), None, 0
        chunk = max(1, min(spp, MAX_AUXILIARY // (view.width * view.height)))
        for launch, start in enumerate(range(0, spp, chunk)):
            samples = min(chunk, spp - start)
            part = self.render(scene, sensor=sensor, integrator=integrator, spp=samples, seed=launch)
            image = np.array(part, dtype=np.float32)[..., -6:]
            if samples < spp:
                image *= samples / spp
            total, done = (image if total is None else total + image), done + samples
        assert total is not None and done == spp
        channels, lost = masked(total)
        return channels[..., :3].clip(0, 1), channels[..., 3:].clip(-1, 1), lost

    def compile(self, bundle: Path, integrator: Any, sensor: Any, view: View) -> None:
        """Render one sample per pixel where no picture of the size was, in no `Stopwatch`'s seconds: Mitsuba's own
        kernels are compiled for each. Arguments: of `frame`."""
        if (view.width, view.height) in self._sizes:
            return
        self._sizes.add((view.width, view.height))
        began = time.monotonic(), time.process_time()
        self.frame(bundle, integrator, sensor, view, 1, 0)
        Stopwatch.leave_out(*began)

    def frame(
        self, bundle: Path, integrator: Any, sensor: Any, view: View, spp: int, seed: int
    ) -> tuple[np.ndarray, int]:
        """(mean RGBA, float64 [H, W, 4], linear Rec.709, premultiplied; samples taken), in launches that fit in memory.

        Args:
            bundle: one of the engine's.
            integrator: of `integrator`.
            sensor: of `sensor` or `sensor_row`.
            view: of the picture's size; nothing else of it counts.
            spp: samples per pixel.
            seed: its lower 20 bits count.
        """
        chunk = max(1, min(spp, MAX_WAVEFRONT // (view.width * view.height)))
        total = np.zeros((view.height, view.width, 4), dtype=np.float64)
        done = launch = 0
        while done < spp:
            samples = min(chunk, spp - done)
            part = self.render(
                self.scenes[str(bundle)],
                sensor=sensor,
                integrator=integrator,
                spp=samples,
                seed=((seed & 0xFFFFF) << 12) + launch,
            )
            total += np.array(part, dtype=np.float64)[..., :4] * samples
            done += samples
            launch += 1
        return total / done, done


class BundleWorker:
    """A worker that loads one bundle when it starts.

    compiled_for: what needs a jit variant, in words; under a scalar one it raises UserError then. "": any will do.
    """

    compiled_for: ClassVar[str] = ""

    def __init__(self, common: dict[str, Any]) -> None:
        settings = BundleCommon.model_validate(common)
        self.bundle = settings.bundle
        self.engine = Engine(settings.variant, settings.threads, [self.bundle])
        if self.compiled_for and not self.engine.compiled:
            raise UserError(f"{self.compiled_for} a jit variant of Mitsuba (LLVM or CUDA; see `dnrpipe doctor`)")


def _refuse_instances(bundles: Sequence[Path]) -> None:
    """Mitsuba 3.9.1's scalar variants end with a segmentation fault on instances under hidden emitters."""
    for bundle in bundles:
        if '<shape type="instance"' in bundle.read_text(encoding="utf-8"):
            raise UserError(
                f"{bundle}: has instances, which Mitsuba's scalar variant cannot render;"
                " install LLVM (see `dnrpipe doctor`)"
            )


def masked(image: np.ndarray) -> tuple[np.ndarray, int]:
    """``image`` [H, W, C] with 0 in the pixels that hold a NaN or an infinity, and how many those are."""
    fine = np.isfinite(image).all(axis=-1, keepdims=True)
    lost = int(fine.size - np.count_nonzero(fine))
    return (np.where(fine, image, 0).astype(image.dtype) if lost else image), lost


def masked_channels(channels: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], int]:
    """The same of channels [H, W]: a pixel that is not finite in one of them becomes 0 in all.

    Nearly always there is nothing to do, and then it costs one addition a value: a sum is finite where its terms are.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        sums = [float(values.sum()) for values in channels.values()]
    if np.isfinite(sums).all():
        return dict(channels), 0
    bad = ~np.logical_and.reduce([np.isfinite(values) for values in channels.values()])
    return {name: np.where(bad, values.dtype.type(0), values) for name, values in channels.items()}, int(bad.sum())

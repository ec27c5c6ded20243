"""Pilot renders: small paired pictures that say how deep paths must be, and what an effect costs and changes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from .engine import Engine, masked
from .statistics import REFERENCE_DEPTH, DepthStep, cost, difference, display, enough, remaining, significance
from .tasks import CompareAnswer, CompareTask, DepthAnswer, DepthTask, PilotCommon, PilotConfig, PilotView

DEPTHS = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
MAX_DOUBLINGS = 2


class Worker:
    """Answers pilot tasks. common: a `PilotCommon`; task: a `DepthTask` or a `CompareTask`, as its "kind" says."""

    def __init__(self, common: dict[str, Any]) -> None:
        bundles: dict[str, list[Path]] = {}
        settings = PilotCommon.model_validate(common)
        for config in settings.configs:
            bundles.setdefault(config.variant, []).append(config.bundle)
        # What is compared is timed on one thread, which would stop the loader of a second variant. On several, sums
        # over samples have no fixed order: the last bits of a depth's figures may differ between runs.
        threads = 1 if len(settings.configs) > 1 and len(bundles) == 1 else 0
        self.masked = 0  # pixels of the task at hand that were not finite
        self.engines = {name: Engine(name, threads, list(dict.fromkeys(paths))) for name, paths in bundles.items()}

    def __call__(self, task: dict[str, Any]) -> DepthAnswer | CompareAnswer:
        self.masked = 0
        if task["kind"] == "depth":
            return self.path_depth(DepthTask.model_validate(task))
        return self.compare(CompareTask.model_validate(task))

    def path_depth(self, task: DepthTask) -> DepthAnswer:
        """Smallest depth within the tolerances, by bisection; more samples where noise is what decides.

        ``dnr_path`` traces paths: Mitsuba's ``path`` gives the same, but compiles a kernel per depth.

        Returns REFERENCE_DEPTH where no depth suffices.
        """
        started, cpu = time.monotonic(), time.process_time()
        if task.config.integrator == "path" and self.engines[task.config.variant].compiled:
            config = task.config.model_copy(update={"integrator": "path-of-any-depth"})
            task = task.model_copy(update={"config": config})
        spp = task.spp
        chosen, steps, noisy = self._bisect(task, spp)
        while noisy and spp < task.spp << MAX_DOUBLINGS:
            spp *= 2
            chosen, steps, noisy = self._bisect(task, spp)
        return {
            "max_depth": chosen,
            "spp": spp,
            "steps": [step.model_dump() for step in sorted(steps, key=lambda step: step.depth)],
            "seconds": time.monotonic() - started,
            "cpu_seconds": time.process_time() - cpu,
            "masked": self.masked,
        }

    def _bisect(self, task: DepthTask, spp: int) -> tuple[int, list[DepthStep], bool]:
        """(depth, steps looked at, whether the next smaller depth failed by its noise alone)."""
        deep = self._pictures(task.config, REFERENCE_DEPTH, task.views, spp)
        found: dict[int, DepthStep] = {}

        def step(depth: int) -> DepthStep:
            if depth not in found:
                shallow = self._pictures(task.config, depth, task.views, spp)
                found[depth] = remaining(depth, (deep - shallow)[..., :3], deep[..., :3], deep[..., 3])
            return found[depth]

        low, high = -1, len(DEPTHS)  # DEPTHS[low] fails, DEPTHS[high] suffices
        step(DEPTHS[0])  # what direct light alone would miss is part of the report
        while high - low > 1:
            middle = (low + high) // 2
            if enough(step(DEPTHS[middle]), task.tolerance, task.pixel_tolerance):
                high = middle
            else:
                low = middle
        failed = found[DEPTHS[low]] if low >= 0 else None
        noisy = failed is not None and failed.mean <= task.tolerance < failed.mean + failed.mean_error
        if high == len(DEPTHS):
            found[REFERENCE_DEPTH] = DepthStep(depth=REFERENCE_DEPTH, mean=0.0, mean_error=0.0, pixel=0.0)
        return (*DEPTHS, REFERENCE_DEPTH)[high], list(found.values()), noisy

    def compare(self, task: CompareTask) -> CompareAnswer:
        """What the first configuration costs over the second, and by how much their pictures differ.

        Same seeds for both; one after the other, view by view, after a first frame that compiles the kernels.
        """
        started = time.monotonic()
        configs, views = (task.with_effect, task.without_effect), task.views
        # Processor seconds do not move with other work on the machine, but they do not hold what a GPU does.
        on_gpu = any(config.variant.startswith("cuda") for config in configs)
        clock = time.perf_counter if on_gpu else time.process_time
        for config in configs:
            self._picture(config, config.max_depth, views[0], 1, 0)
        pictures: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
        seconds: tuple[list[float], list[float]] = ([], [])
        for index, entry in enumerate(views):
            for half in range(2):
                for which, config in enumerate(configs):
                    begun = clock()
                    pictures[which].append(
                        display(self._picture(config, config.max_depth, entry, task.spp, 2 * index + half))
                    )
                    seconds[which].append(clock() - begun)
        shape = (len(views), 2, *pictures[0][0].shape)
        both = [np.array(rows).reshape(shape) for rows in pictures]
        error = difference(both[0], both[1])
        price = cost(*(np.array(values).reshape(len(views), 2).sum(axis=1) for values in seconds))
        return {
            "cost": price.model_dump(),
            "error": error.model_dump(),
            "significance": significance(both[0], both[1]),
            "noise_with": _noise(both[0]),
            "noise_without": _noise(both[1]),
            "seconds_with": float(np.sum(seconds[0])),
            "seconds_without": float(np.sum(seconds[1])),
            "seconds": time.monotonic() - started,
            "masked": self.masked,
        }

    def _pictures(self, config: PilotConfig, depth: int, views: list[PilotView], spp: int) -> np.ndarray:
        """[V, 2, H, W, 4]: two halves of each view, all in one launch; a pixel's random numbers depend on its place and
        on ``spp`` alone."""
        engine = self.engines[config.variant]
        integrator = self._integrator(config, depth)
        both = [entry for entry in views for _ in range(2)]
        sensor = engine.sensor_row(
            [entry.view for entry in both], [entry.lens if config.lenses else None for entry in both]
        )
        view = both[0].view
        row = view.model_copy(update={"width": view.width * len(both)})
        picture = self._counted(engine.frame(config.bundle, integrator, sensor, row, spp, 0)[0])
        side_by_side = picture.reshape(view.height, len(views), 2, view.width, 4)
        return side_by_side.transpose(1, 2, 0, 3, 4)

    def _picture(self, config: PilotConfig, depth: int, entry: PilotView, spp: int, seed: int) -> np.ndarray:
        """[H, W, 4] linear Rec.709, premultiplied."""
        engine = self.engines[config.variant]
        integrator = self._integrator(config, depth)
        sensor = engine.sensor(entry.view, entry.lens if config.lenses else None)
        return self._counted(engine.frame(config.bundle, integrator, sensor, entry.view, spp, seed)[0])

    def _integrator(self, config: PilotConfig, depth: int) -> Any:
        engine = self.engines[config.variant]
        engine.mi.set_variant(engine.variant)
        return engine.integrator(config.bundle, config.integrator, depth, config.passes)[0]

    def _counted(self, picture: np.ndarray) -> np.ndarray:
        """The picture with 0 where it was not finite, which is counted."""
        picture, lost = masked(picture)
        self.masked += lost
        return picture


def _noise(pictures: np.ndarray) -> float:
    """RMSE of the mean of the two halves, display space, of [V, 2, H, W, 3]."""
    return float(np.sqrt(np.mean(((pictures[:, 0] - pictures[:, 1]) / 2) ** 2)))

"""Pilot renders: small paired pictures that say how deep paths must be, and what an effect costs and changes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.raytrace.statistics import (
    REFERENCE_DEPTH,
    DepthStep,
    cost,
    difference,
    display,
    enough,
    remaining,
    significance,
)
from dnrtrain.contract import View

from .engine import Engine
from .finite import masked

DEPTHS = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
MAX_DOUBLINGS = 2


class Worker:
    """Answers pilot tasks.

    common: {"configs": all configurations of the tasks to come}
    task "depth": {"config", "views", "spp", "tolerance", "pixel_tolerance"} -> :meth:`path_depth`
    task "compare": {"with", "without": configs, "views", "spp"} -> :meth:`compare`
    config: {"bundle": scene.xml, "integrator", "max_depth", "variant", "lenses", "passes"}
    view: {"view": View as JSON, "lens"}
    Answers also hold ``masked``: pixels of all pictures that were not finite, and count as black.
    """

    def __init__(self, common: dict[str, Any]) -> None:
        bundles: dict[str, list[Path]] = {}
        for config in common["configs"]:
            bundles.setdefault(config["variant"], []).append(Path(config["bundle"]))
        # One thread would stop the loader of a second variant.
        threads = 1 if len(bundles) == 1 else 0
        self.masked = 0  # pixels of the task at hand that were not finite
        self.engines = {name: Engine(name, threads, list(dict.fromkeys(paths))) for name, paths in bundles.items()}

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        self.masked = 0
        answer = self.path_depth(task) if task["kind"] == "depth" else self.compare(task)
        return answer | {"masked": self.masked}

    def path_depth(self, task: dict[str, Any]) -> dict[str, Any]:
        """Smallest depth within the tolerances, by bisection; more samples where noise is what decides.

        Path tracing is done by ``dnr_path``, which Mitsuba's ``path`` equals but for a kernel to compile per depth.

        Returns {"max_depth", "spp", "steps", "seconds", "cpu_seconds"}; REFERENCE_DEPTH where none suffices.
        """
        started, cpu = time.monotonic(), time.process_time()
        if task["config"]["integrator"] == "path" and self.engines[task["config"]["variant"]].compiled:
            task = {**task, "config": {**task["config"], "integrator": "path-of-any-depth"}}
        spp, tolerances = int(task["spp"]), (float(task["tolerance"]), float(task["pixel_tolerance"]))
        chosen, steps, noisy = self._bisect(task, spp, tolerances)
        for _ in range(MAX_DOUBLINGS):
            if not noisy:
                break
            spp *= 2
            chosen, steps, noisy = self._bisect(task, spp, tolerances)
        return {
            "max_depth": chosen,
            "spp": spp,
            "steps": [step.model_dump() for step in sorted(steps, key=lambda step: step.depth)],
            "seconds": time.monotonic() - started,
            "cpu_seconds": time.process_time() - cpu,
        }

    def _bisect(
        self, task: dict[str, Any], spp: int, tolerances: tuple[float, float]
    ) -> tuple[int, list[DepthStep], bool]:
        """(depth, steps looked at, whether the next smaller depth failed by its noise alone)."""
        deep = self._pictures({**task["config"], "max_depth": REFERENCE_DEPTH}, task["views"], spp)
        found: dict[int, DepthStep] = {}

        def step(depth: int) -> DepthStep:
            if depth not in found:
                shallow = self._pictures({**task["config"], "max_depth": depth}, task["views"], spp)
                found[depth] = remaining(depth, (deep - shallow)[..., :3], deep[..., :3], deep[..., 3])
            return found[depth]

        low, high = -1, len(DEPTHS)  # DEPTHS[low] fails, DEPTHS[high] suffices
        step(DEPTHS[0])  # what direct light alone would miss is part of the report
        while high - low > 1:
            middle = (low + high) // 2
            if enough(step(DEPTHS[middle]), *tolerances):
                high = middle
            else:
                low = middle
        noisy = (
            low >= 0
            and found[DEPTHS[low]].mean <= tolerances[0] < found[DEPTHS[low]].mean + found[DEPTHS[low]].mean_error
        )
        if high == len(DEPTHS):
            found[REFERENCE_DEPTH] = DepthStep(depth=REFERENCE_DEPTH, mean=0.0, mean_error=0.0, pixel=0.0)
            return REFERENCE_DEPTH, list(found.values()), noisy
        return DEPTHS[high], list(found.values()), noisy

    def compare(self, task: dict[str, Any]) -> dict[str, Any]:
        """What the first configuration costs over the second, and by how much their pictures differ.

        Same seeds for both; one after the other, view by view, after a first frame that compiles the kernels.
        """
        started = time.monotonic()
        configs, views, spp = (task["with"], task["without"]), task["views"], int(task["spp"])
        for config in configs:
            self._picture(config, views[0], 1, 0)
        pictures: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
        seconds: tuple[list[float], list[float]] = ([], [])
        for index, entry in enumerate(views):
            for half in range(2):
                for which, config in enumerate(configs):
                    cpu = time.process_time()
                    pictures[which].append(display(self._picture(config, entry, spp, 2 * index + half)))
                    seconds[which].append(time.process_time() - cpu)
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
        }

    def _pictures(self, config: dict[str, Any], views: list[dict[str, Any]], spp: int) -> np.ndarray:
        """[V, 2, H, W, 4]: two halves of each view; the seeds depend on view and half only."""
        rows = [
            [self._picture(config, entry, spp, 2 * index + half) for half in range(2)]
            for index, entry in enumerate(views)
        ]
        return np.array(rows)

    def _picture(self, config: dict[str, Any], entry: dict[str, Any], spp: int, seed: int) -> np.ndarray:
        engine = self.engines[config["variant"]]
        engine.mi.set_variant(engine.variant)
        bundle, view = Path(config["bundle"]), View.model_validate(entry["view"])
        integrator, _ = engine.integrator(
            bundle, config["integrator"], int(config["max_depth"]), bool(config.get("passes", False))
        )
        sensor = engine.sensor(view, entry.get("lens") if config.get("lenses", True) else None)
        picture, _ = engine.frame(bundle, integrator, sensor, view, spp, seed)
        picture, lost = masked(picture)
        self.masked += lost
        return picture


def _noise(pictures: np.ndarray) -> float:
    """RMSE of the mean of the two halves, display space, of [V, 2, H, W, 3]."""
    return float(np.sqrt(np.mean(((pictures[:, 0] - pictures[:, 1]) / 2) ** 2)))

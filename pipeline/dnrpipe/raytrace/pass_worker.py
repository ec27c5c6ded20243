"""The ray-tracing worker for targets: adds passes of samples to a view, and writes its EXR when told to.

What has been traced lies in a file of its own (:mod:`.samples`), so that any worker can go on with any view, also
after a crash or with another target. The decisions are :mod:`dnrpipe.raytrace.sample_schedule`'s.
"""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import View
from dnrtrain.exr import write_exr

from .engine import Engine
from .grouped import GroupedSensor
from .noise import GROUPS, group_noise
from .pictures import finished, repair
from .samples import Samples, read_samples


class Worker:
    """Loads the bundle once.

    common: as of :class:`.tracer.Worker`. task: as there, without "spp", and with
        "samples", "samples_fingerprint": path and fingerprint of what is traced so far
        "add": samples per pixel to add, a multiple of GROUPS; 0: write "output"
        "goal": what was asked for and what ended it, for the file's metadata
    """

    def __init__(self, common: dict[str, Any]) -> None:
        self.bundle = Path(common["bundle"])
        self.engine = Engine(common["variant"], int(common["threads"]), [self.bundle])
        self.started = False

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        view = View.model_validate(task["view"])
        samples = read_samples(Path(task["samples"]), task["samples_fingerprint"], view.height, view.width)
        return self._add(task, view, samples) if task["add"] else self._write(task, view, samples)

    def _add(self, task: dict[str, Any], view: View, samples: Samples) -> dict[str, Any]:
        """One pass. Returns the view's figures; "started": whether kernels were compiled in it."""
        first, self.started = not self.started, True
        started, cpu = time.monotonic(), time.process_time()
        integrator, _ = self._integrator(task)
        sensor = GroupedSensor(self.engine, self.bundle, view, task.get("lens"))
        facts = samples.facts
        each = max(1, int(task["add"]) // GROUPS)

        def render(_attempt: int = 0, _group: int = 0) -> np.ndarray:
            means, launches = sensor.render(integrator, each, int(task["seed"]), facts.launches)
            facts.launches += launches
            return means

        means = render()
        repaired, masked = repair(list(means), lambda attempt, group: render()[group])
        samples.add(means, each * GROUPS)
        facts.repaired, facts.masked = facts.repaired + repaired, facts.masked + masked
        noise = group_noise(samples.groups)
        facts.noise, facts.error = noise.relative, noise.error
        seconds = time.monotonic() - started
        facts.seconds += seconds
        facts.cpu_seconds += time.process_time() - cpu
        samples.save(Path(task["samples"]))
        answer = {
            "spp": facts.spp,
            "noise": facts.noise,
            "error": facts.error,
            "seconds": seconds,
            "started": first,
        }
        if task.get("rehearse"):  # how long writing will take, for a time that is to be kept
            began = time.monotonic()
            self._pictures(task, view, samples)
            answer["finish_seconds"] = time.monotonic() - began
        return answer

    def _write(self, task: dict[str, Any], view: View, samples: Samples) -> dict[str, Any]:
        """The view's EXR. Seconds are those since the ledger last heard of the view."""
        if not samples.facts.spp:
            raise RuntimeError(f"{task['samples']}: gone or damaged; run the same command to trace it again")
        started, cpu = time.monotonic(), time.process_time()
        channels, noise = self._pictures(task, view, samples)
        _, name = self._integrator(task)
        facts = samples.facts
        facts.seconds += time.monotonic() - started
        facts.cpu_seconds += time.process_time() - cpu
        numbers = {
            "spp": facts.spp,
            "max_depth": int(task["max_depth"]),
            "seed": int(task["seed"]),
            "integrator": name + ("+lens" if task.get("lens") else ""),
            "variant": self.engine.variant,
            "load_seconds": self.engine.load_seconds,
            "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            **noise,
            "repaired": facts.repaired,
            "masked": facts.masked,
            "denoised": bool(task.get("denoise")),
            "passes": facts.passes,
            **task["goal"],
        }
        header = {"seconds": facts.seconds, "cpu_seconds": facts.cpu_seconds, "fingerprint": task["fingerprint"]}
        write_exr(Path(task["output"]), channels, {**numbers, **header, "view": view.model_dump(mode="json")})
        new = {
            "seconds": facts.seconds - facts.booked_seconds,
            "cpu_seconds": facts.cpu_seconds - facts.booked_cpu_seconds,
        }
        earlier: dict[str, float] = {}
        if facts.booked_seconds:  # the ledger has them in an earlier record
            earlier = {"earlier_seconds": facts.booked_seconds, "earlier_cpu_seconds": facts.booked_cpu_seconds}
        facts.booked_seconds, facts.booked_cpu_seconds = facts.seconds, facts.cpu_seconds
        samples.save(Path(task["samples"]))
        return {**numbers, **new, **earlier}

    def _pictures(
        self, task: dict[str, Any], view: View, samples: Samples
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        noise, smooth = group_noise(samples.groups), bool(task.get("denoise"))
        image, halves = samples.mean, samples.halves
        return finished(self.engine, self.bundle, view, image, halves, noise, smooth, samples.groups)

    def _integrator(self, task: dict[str, Any]) -> tuple[Any, str]:
        return self.engine.integrator(self.bundle, task.get("integrator", "path"), int(task["max_depth"]))

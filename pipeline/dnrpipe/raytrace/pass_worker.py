"""The ray-tracing worker for targets: adds passes of samples to a view, and writes its EXR when asked to.

What has been traced lies in a file of its own (see `samples`), so that any worker can go on with any view, also
after a crash or with another target. The decisions are `sample_schedule`'s.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from dnrtrain.exr import write_exr

from .grouped import GroupedSensor
from .noise import GROUPS, group_noise
from .pictures import finished, repair
from .samples import Samples, read_samples
from .tasks import NoiseFigures, PassAnswer, PassTask, WriteAnswer, WriteTask, costs_since
from .tracer import ViewTracer


class Worker(ViewTracer):
    """common: a `BundleCommon`; task: a `PassTask`, or a `WriteTask` where "add" is 0."""

    started = False

    def __call__(self, task: dict[str, Any]) -> PassAnswer | WriteAnswer:
        return self._add(PassTask.model_validate(task)) if task["add"] else self._write(WriteTask.model_validate(task))

    def _add(self, task: PassTask) -> PassAnswer:
        first, self.started = not self.started, True
        samples = _samples(task)
        started, cpu = time.monotonic(), time.process_time()
        integrator, _ = self.integrator(task)
        sensor = GroupedSensor(self.engine, self.bundle, task.view, task.lens)
        facts = samples.facts
        each = max(1, task.add // GROUPS)

        def render(_attempt: int = 0, _group: int = 0) -> np.ndarray:
            means, launches = sensor.render(integrator, each, task.seed, facts.launches)
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
        samples.save(task.samples)
        answer: PassAnswer = {
            "spp": facts.spp,
            "noise": noise.relative,
            "error": noise.error,
            "seconds": seconds,
            "started": first,
        }
        if task.rehearse:  # how long writing will take, for a time that is to be kept
            began = time.monotonic()
            self._pictures(task, samples)
            answer["finish_seconds"] = time.monotonic() - began
        return answer

    def _write(self, task: WriteTask) -> WriteAnswer:
        samples = _samples(task)
        facts = samples.facts
        if not facts.spp:
            raise RuntimeError(f"{task.samples}: gone or damaged; run the same command to trace it again")
        started, cpu = time.monotonic(), time.process_time()
        channels, noise = self._pictures(task, samples)
        costs = costs_since(started, cpu)
        facts.seconds += costs["seconds"]
        facts.cpu_seconds += costs["cpu_seconds"]
        answer: WriteAnswer = {
            **self.answer(task, facts.spp, costs, noise, facts.repaired, facts.masked),
            "passes": facts.passes,
            "noise_target": task.goal.noise_target,
            "time_target": task.goal.time_target,
            "max_spp": task.goal.max_spp,
            "ended_by": task.goal.ended_by,
            "seconds": facts.seconds,
            "cpu_seconds": facts.cpu_seconds,
        }
        header = {**answer, "fingerprint": task.fingerprint, "view": task.view.model_dump(mode="json")}
        write_exr(task.output, channels, header)
        if facts.booked_seconds:  # the ledger has them in an earlier record
            answer["seconds"] -= facts.booked_seconds
            answer["cpu_seconds"] -= facts.booked_cpu_seconds
            answer["earlier_seconds"] = facts.booked_seconds
            answer["earlier_cpu_seconds"] = facts.booked_cpu_seconds
        facts.booked_seconds, facts.booked_cpu_seconds = facts.seconds, facts.cpu_seconds
        samples.save(task.samples)
        return answer

    def _pictures(self, task: PassTask | WriteTask, samples: Samples) -> tuple[dict[str, np.ndarray], NoiseFigures]:
        noise, image, halves = group_noise(samples.groups), samples.mean, samples.halves
        return finished(self.engine, self.bundle, task.view, image, halves, noise, task.denoise, samples.groups)


def _samples(task: PassTask | WriteTask) -> Samples:
    return read_samples(task.samples, task.samples_fingerprint, task.view.height, task.view.width)

"""Views traced to a noise level or within a time: passes of samples, handed out by `raytrace.sample_schedule`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dnrtrain.exr import read_metadata

from ..core.console import Console
from ..raytrace.sample_schedule import Goal, Schedule, Step, ViewProgress
from ..raytrace.samples import read_facts
from ..workers.task_list import TaskResult, run_tasks
from ..workers.view_tasks import Book, Failures, is_made, task_name
from .stage import Run


def sample_adaptively(
    run: Run,
    label: str,
    common: dict[str, Any],
    tasks: Sequence[dict[str, Any]],
    goal: Goal,
    *,
    workers: int,
    book: Book,
    environment: dict[str, str] | None,
) -> None:
    """Trace the views whose files are missing or out of date; one ledger record each, when its file is written.

    tasks: of `raytrace.pass_worker.Worker`, without "add" and "goal". Samples that are on disk count, whatever they
    were traced for. Raises TasksFailed after all other views are done when some failed twice.
    """
    due = {task_name(task): task for task in tasks if not is_made(task)}
    if not due:
        return
    count = max(1, min(workers, len(due)))
    schedule = Schedule(goal, {name: _known(task) for name, task in due.items()}, count)

    def make_task(step: Step) -> dict[str, Any]:
        asked = {"noise_target": goal.noise, "time_target": goal.seconds, "max_spp": goal.limit, "ended_by": step.why}
        rehearse = goal.seconds is not None and not schedule.finish_seconds
        return {**due[step.view], "add": step.add, "goal": asked, "rehearse": rehearse}

    def next_tasks(outcome: TaskResult) -> list[dict[str, Any]]:
        name, result = task_name(outcome.task), outcome.result
        if result is None or not outcome.task["add"]:
            schedule.finished(name)
        else:
            schedule.finish_seconds = max(schedule.finish_seconds, result.pop("finish_seconds", 0.0))
            schedule.passed(name, add=outcome.task["add"], **result)
        step = schedule.next()
        return [] if step is None else [make_task(step)]

    first = [make_task(step) for step in (schedule.next() for _ in range(count)) if step is not None]
    failures = Failures(label, run.console, run.log)
    outcomes = run_tasks(
        "dnrpipe.raytrace.pass_worker",
        common,
        first,
        workers=count,
        log=run.log,
        retried=failures.retried,
        environment=environment,
        next_tasks=next_tasks,
        place=run.place,
    )
    if goal.seconds is not None:
        bar = run.console.bar(f"{label}, seconds", math.ceil(schedule.deadline - schedule.clock()))
    else:
        bar = run.console.bar(label, len(tasks), len(tasks) - len(due))
    began = schedule.clock()
    with run.timed(f"{label}: processes"), bar as shown:
        for outcome in failures.noted(outcomes):
            written = outcome.result is not None and not outcome.task["add"]
            if written:
                assert outcome.result is not None
                book(outcome.task, outcome.result, outcome.side_by_side)
            if goal.seconds is not None:
                past = min(shown.total, int(schedule.clock() - began))
                shown.advance(past - shown.done, note=task_name(outcome.task))
            elif written or outcome.result is None:
                shown.advance(note=task_name(outcome.task))
    _tell(label, list(due.values()), goal, run.console)
    failures.report(len(tasks))


def _known(task: dict[str, Any]) -> ViewProgress:
    facts = read_facts(Path(task["samples"]), task["samples_fingerprint"])
    return ViewProgress(facts.spp, facts.noise, facts.error, facts.seconds)


def _tell(label: str, tasks: Sequence[dict[str, Any]], goal: Goal, console: Console) -> None:
    """One line on what was reached; a warning where the target was not, for want of samples."""
    found = [data for task in tasks if (data := read_metadata(Path(task["output"]))) is not None]
    noise = [data["raw_noise"] for data in found if data.get("raw_noise") is not None]
    if not noise:
        return
    spp = [data["spp"] for data in found]
    console.say(
        f"{label}: {min(spp)} to {max(spp)} spp, noise {100 * min(noise):.2f} to {100 * max(noise):.2f}% of the picture"
        + (" before the denoiser" if any(data.get("denoised") for data in found) else "")
    )
    if bias := [data["denoiser_bias"] for data in found if data.get("denoiser_bias") is not None]:
        console.say(
            f"{label}: the denoiser's own error, which more samples lower but do not average out, stands out of the"
            f" noise in {len(bias)} of {len(found)} views: {100 * min(bias):.2f} to {100 * max(bias):.2f}%"
        )
    short = [data["view"]["name"] for data in found if data.get("ended_by") == "limit"]
    if goal.noise is not None and short:
        console.warn(
            f"{label}: {len(short)} of {len(found)} views ({', '.join(short[:5])}{'…' if len(short) > 5 else ''}) have"
            f" more noise than {100 * goal.noise:g}% after {goal.limit} spp; raise raytrace.max_spp to go on"
        )

"""How long a fleet would take on so many nodes, reckoned from what its scenes have cost so far.

Notation
    slot    what one task occupies on a node: the share of its cores that a task had when it was measured
    step    tasks of one scene that may run side by side; the next step begins when all of them have ended
    chain   the steps of one scene

Tasks are taken first come, first served, by whatever slot is free, as the executor does. Steps that the driving machine
makes itself (conversion) wait for one of its own places. Sending files is not modelled beyond a constant per task.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from ..core.ledger import CostRecord

START = 4.0
"""Seconds until a worker has imported Blender or Mitsuba and read a scene; `tools.bench_ray` measures it."""
PER_TASK = 0.02
"""Seconds that a task takes on top, files included; as measured there."""


@dataclass(frozen=True)
class Step:
    """seconds: of each task. driver: made by the driving machine, one task after the other."""

    seconds: tuple[float, ...]
    driver: bool = False


def chain_of(records: Sequence[CostRecord]) -> list[Step]:
    """The steps of a scene, by its ledger. Views are lists of tasks; the rest is one task each; overhead of starting
    processes is left out, since a cluster has its own."""
    steps: list[Step] = []
    work = [record for record in records if record.unit != "overhead" and not record.cache_hit]
    for _, group in itertools.groupby(work, key=_kind):
        found = list(group)
        driver = found[0].stage == "prepare" and found[0].unit == "scene"
        if found[0].unit == "view":
            steps.append(Step(tuple(record.seconds for record in found)))
        else:
            steps.append(Step((sum(record.seconds for record in found),), driver))
    return steps


def _kind(record: CostRecord) -> tuple[str, str, str]:
    name = record.name.partition("/")[0] if record.unit == "view" else "" if record.unit == "epoch" else record.name
    return record.stage, record.unit, name


def makespan(
    chains: Sequence[Sequence[Step]],
    slots: int,
    *,
    drivers: int = 8,
    start: float = START,
    per_task: float = PER_TASK,
) -> float:
    """Seconds until the last chain has ended.

    Args:
        slots: of all nodes together.
        drivers: chains under way at once.
        start: seconds before the first task of a step on each slot that it gets.
    """
    waiting: deque[int] = deque(range(len(chains)))  # chains that have not begun
    ready: dict[bool, deque[tuple[int, float]]] = {False: deque(), True: deque()}  # by whether the driver makes them
    free = {False: slots, True: drivers}
    left = [0] * len(chains)
    next_step = [0] * len(chains)
    events: list[tuple[float, int, int, bool]] = []  # (time, tie, chain, driver)
    tie = itertools.count()
    clock, under_way = 0.0, 0

    def advance(chain: int) -> bool:
        """Queue the chain's next step; False where it has ended."""
        while next_step[chain] < len(chains[chain]):
            step = chains[chain][next_step[chain]]
            next_step[chain] += 1
            if step.seconds:
                left[chain] = len(step.seconds)
                starting = 0 if step.driver else min(slots, len(step.seconds))
                for number, seconds in enumerate(step.seconds):
                    extra = 0.0 if step.driver else per_task + (start if number < starting else 0.0)
                    ready[step.driver].append((chain, seconds + extra))
                return True
        return False

    while True:
        while waiting and under_way < drivers:
            under_way += advance(waiting.popleft())
        for driver in (False, True):
            while free[driver] and ready[driver]:
                chain, seconds = ready[driver].popleft()
                free[driver] -= 1
                heapq.heappush(events, (clock + seconds, next(tie), chain, driver))
        if not events:
            return clock
        clock, _, chain, driver = heapq.heappop(events)
        free[driver] += 1
        left[chain] -= 1
        if not left[chain] and not advance(chain):
            under_way -= 1


def forecast(ledgers: Sequence[Sequence[CostRecord]], scenes: int, slots: Sequence[int]) -> dict[int, float]:
    """Seconds by number of slots, for so many scenes of the kind that the ledgers are of."""
    known = [chain_of(records) for records in ledgers]
    chains = [known[number % len(known)] for number in range(scenes)]
    return {count: makespan(chains, count, drivers=max(8, count)) for count in slots}

"""How long a fleet would take on so many nodes, reckoned from what its scenes have cost so far.

Notation
    slot    what one of several tasks side by side occupies on a node; a node has as many as the machine of the ledgers
    step    tasks of one scene that may run side by side; the next step begins when all of them have ended
    chain   the steps of one scene

Tasks are taken first come, first served, by whatever node has room for them, as the executor does. A task that had the
machine for itself when it was measured (light, base images, training) takes a whole node. Steps that the driving
machine makes itself (conversion) wait for one of its own places. Sending files is not modelled beyond a constant per
task.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from ..core.ledger import CostRecord

START = 2.3
"""Seconds until a node's worker has imported Blender or Mitsuba and read a scene, and its files are there. Tracing on
one node takes 4.1 s more in its three lists than here (`tools.bench_ray`), where a worker takes 1 s."""
PER_TASK = 0.02
"""Seconds that a task takes on top, its files included; as measured there."""
DRIVEN = {("prepare", "convert"), ("select", "selection"), ("evaluate", "neural")}
"""(stage, what) that the driving machine makes itself."""


@dataclass(frozen=True)
class Step:
    """seconds: of each task. driver: made by the driving machine. whole: each task takes a node, not a slot."""

    seconds: tuple[float, ...]
    driver: bool = False
    whole: bool = False


def chain_of(records: Sequence[CostRecord]) -> list[Step]:
    """The steps of a scene, by its ledger. Views are lists of tasks; the rest is one task each. What the driver did
    between them ("everything else") is its own step; overhead of starting processes is left out, since a cluster has
    its own."""
    steps: list[Step] = []
    for kind, group in itertools.groupby((record for record in records if not record.cache_hit), key=_kind):
        found = list(group)
        if kind == STARTS:
            continue
        driver = kind in DRIVEN or found[0].unit == "overhead"
        if found[0].unit == "view" and kind[1] != TRAINING:
            alone = max(record.workers for record in found) == 1 and len(found) > 1
            steps.append(Step(tuple(record.seconds for record in found), driver, whole=alone and not driver))
        else:
            steps.append(Step((sum(record.seconds for record in found),), driver, not driver))
    return steps


TRAINING = "training"
STARTS = ("", "")


def _kind(record: CostRecord) -> tuple[str, str]:
    """(stage, what); records of the same kind after one another are one step."""
    what = record.name.partition("/")[0] if record.unit == "view" else record.name
    if record.unit == "epoch" or what == "preview":
        return record.stage, TRAINING
    if record.unit == "overhead" and what != "everything else":
        return STARTS
    return record.stage, what


def makespan(
    chains: Sequence[Sequence[Step]],
    nodes: int,
    *,
    slots: int = 1,
    drivers: int = 8,
    cores: int | None = None,
    start: float = START,
    per_task: float = PER_TASK,
) -> float:
    """Seconds until the last chain has ended.

    Args:
        slots: of each node.
        drivers: chains under way at once.
        cores: of the driving machine, one for each step that it makes itself; None: as many as drivers.
        start: seconds before the first task of a step on each slot that it may get.
    """
    waiting: deque[int] = deque(range(len(chains)))  # chains that have not begun
    ready: deque[tuple[int, float, int]] = deque()  # (chain, seconds, slots that it takes; 0: the driver's)
    free = [slots] * nodes
    places = drivers if cores is None else min(drivers, cores)
    left, next_step = [0] * len(chains), [0] * len(chains)
    events: list[tuple[float, int, int, int, int]] = []  # (time, tie, chain, node, slots)
    tie = itertools.count()
    clock, under_way = 0.0, 0

    def advance(chain: int) -> bool:
        """Queue the chain's next step; False where it has ended."""
        while next_step[chain] < len(chains[chain]):
            step = chains[chain][next_step[chain]]
            next_step[chain] += 1
            if step.seconds:
                width = 0 if step.driver else slots if step.whole else 1
                starting = 0 if step.driver else nodes * slots // width
                left[chain] = len(step.seconds)
                for number, seconds in enumerate(step.seconds):
                    extra = 0.0 if step.driver else per_task + (start if number < starting else 0.0)
                    ready.append((chain, seconds + extra, width))
                return True
        return False

    def place(width: int) -> int | None:
        """The node that a task begins on now: the fullest that has room. None: there is none."""
        if not width:
            return -1 if places else None
        fitting = [node for node in range(nodes) if free[node] >= width]
        return min(fitting, key=free.__getitem__) if fitting else None

    while True:
        while waiting and under_way < drivers:
            under_way += advance(waiting.popleft())
        for _ in range(len(ready)):
            chain, seconds, width = ready.popleft()
            node = place(width)
            if node is None:
                ready.append((chain, seconds, width))
                continue
            if width:
                free[node] -= width
            else:
                places -= 1
            heapq.heappush(events, (clock + seconds, next(tie), chain, node, width))
        if not events:
            return clock
        clock, _, chain, node, width = heapq.heappop(events)
        if width:
            free[node] += width
        else:
            places += 1
        left[chain] -= 1
        if not left[chain] and not advance(chain):
            under_way -= 1


def forecast(chains: Sequence[Sequence[Step]], scenes: int, nodes: int, *, slots: int, drivers: int) -> float:
    """Seconds for so many scenes like those of the chains. The driver is one more machine like a node."""
    like = [chains[number % len(chains)] for number in range(scenes)]
    return makespan(like, nodes, slots=slots, drivers=drivers, cores=slots)

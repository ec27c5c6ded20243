"""One selection by a rule, in a worker process: choose, take the time, write one JSON file."""

from __future__ import annotations

import functools
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from ...core.scene_files import split_views
from ...core.workspace import Workspace
from ...raytrace.tasks import costs_since
from ..cells.tasks import FileWorker, SelectionResult, StudyTask

if TYPE_CHECKING:
    from dnrtrain.selector.visibility import SurfaceVisibility


class RuleTask(StudyTask):
    """Choose ``budget`` of a pool's candidates by a rule -> `SelectionResult`."""

    policy: str
    budget: int


class Worker(FileWorker):
    TASK = TypeAdapter(RuleTask)

    def __init__(self, common: dict[str, Any]) -> None:  # without torch
        pass

    def answer(self, task: RuleTask) -> SelectionResult:
        from dnrtrain.selector.policies import untrained
        from dnrtrain.selector.protocol import Candidates

        views = split_views(Workspace.open(task.workspace))["train"]
        policy = untrained(task.policy)
        assert policy is not None  # a trained one is chosen by step 1
        visibility, wall, cpu = _look(task.workspace) if policy.needs_visibility else (None, 0.0, 0.0)
        candidates = Candidates.of_views(views, visibility)
        started = time.monotonic() - wall, time.process_time() - cpu
        choice = policy.choose(candidates, task.budget, task.seed)
        return SelectionResult(
            key=task.fingerprint,
            views=[views[i].name for i in choice.views],
            gains=choice.gains,
            why=choice.why,
            details=choice.details,
            **costs_since(*started),
        )


@functools.lru_cache(maxsize=1)
def _look(place: Path) -> tuple[SurfaceVisibility, float, float]:
    """What a pool's candidates see, and the wall and processor seconds that looking took.

    It is done once per process; its seconds are part of every selection that looks, as if that had done it itself.
    """
    from dnrtrain.selector.visibility import read_visibility

    workspace = Workspace.open(place)
    views = split_views(workspace)["train"]
    wall, cpu = time.perf_counter(), time.process_time()
    visibility = read_visibility([workspace.passes("train", view.name) for view in views], views)
    return visibility, time.perf_counter() - wall, time.process_time() - cpu

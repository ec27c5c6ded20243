"""One selection by a rule, in a worker process: choose, take the time, write one JSON file."""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.scene_files import split_views
from ...core.workspace import Workspace
from ..cells.tasks import FileWorker, SelectionResult, StudyTask

if TYPE_CHECKING:
    from dnrtrain.selector.visibility import SurfaceVisibility


class RuleTask(StudyTask):
    """Choose ``budget`` of a pool's candidates by a rule -> `SelectionResult`."""

    policy: str
    budget: int
    seed: int


class Worker(FileWorker):
    """Answers a `RuleTask`.

    A pool's visibility is made once per process; what that took is part of every selection that looks at it, as if
    it had made it itself.
    """

    def __init__(self, common: dict[str, Any]) -> None:  # without torch
        self.place: Path | None = None
        self.visibility, self.spent = None, (0.0, 0.0)

    def answer(self, task: dict[str, Any]) -> SelectionResult:
        return self._choose(RuleTask.model_validate(task))

    def _choose(self, task: RuleTask) -> SelectionResult:
        from dnrtrain.selector.policies import untrained
        from dnrtrain.selector.protocol import Candidates

        views = split_views(Workspace.open(task.workspace))["train"]
        policy = untrained(task.policy)
        assert policy is not None  # a trained one is chosen by step 1
        visibility, spent = self._look(task.workspace) if policy.needs_visibility else (None, (0.0, 0.0))
        candidates = Candidates.of_views(views, visibility)
        wall, cpu = time.perf_counter(), time.process_time()
        choice = policy.choose(candidates, task.budget, task.seed)
        return SelectionResult(
            key=task.fingerprint,
            views=[views[i].name for i in choice.views],
            gains=choice.gains,
            why=choice.why,
            details=choice.details,
            seconds=time.perf_counter() - wall + spent[0],
            cpu_seconds=time.process_time() - cpu + spent[1],
            peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        )

    def _look(self, place: Path) -> tuple[SurfaceVisibility, tuple[float, float]]:
        """What the pool's candidates see, and the (wall, processor) seconds that looking took."""
        from dnrtrain.selector.visibility import read_visibility

        if self.place != place or self.visibility is None:
            workspace = Workspace.open(place)
            views = split_views(workspace)["train"]
            wall, cpu = time.perf_counter(), time.process_time()
            self.visibility = read_visibility([workspace.passes("train", view.name) for view in views], views)
            self.place, self.spent = place, (time.perf_counter() - wall, time.process_time() - cpu)
        return self.visibility, self.spent

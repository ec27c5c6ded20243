"""One selection by active learning, in a worker process: train, choose, write one JSON file."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from dnrtrain.checkpoint import load_model
from dnrtrain.dataset import ViewSet
from dnrtrain.events import Diverged, EpochEnd
from dnrtrain.model import DNR
from dnrtrain.selector.protocol import Choice
from dnrtrain.settings import ModelSettings, Step1Settings
from dnrtrain.step1 import run_step1

from ...cells.cell import load_cell_views, training_cost
from ...cells.tasks import FileWorker, SelectionResult
from ..policies import ActiveSettings, ActiveTask
from .batches import choose_actively

CLOCKS = {"seconds": time.monotonic, "cpu_seconds": time.process_time}


class Worker(FileWorker):
    TASK = TypeAdapter(ActiveTask)

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        made = super().__call__(task)
        shutil.rmtree(Path(task["folder"]), ignore_errors=True)
        return made

    def answer(self, task: ActiveTask) -> SelectionResult:
        settings = task.settings
        views = load_cell_views(task.workspace, "train", raytraced=False, base="none")
        members = Members(
            views, settings.model, settings.select.step1, ActiveSettings(), task.seed, self.device, task.folder,
            task.fingerprint,
        )  # fmt: skip
        choice, cost = members.choose(task.policy, settings.select.most)
        return SelectionResult(
            key=task.fingerprint,
            views=[views.names[i] for i in choice.views],
            gains=choice.gains,
            why=choice.why,
            details=choice.details,
            **cost,
        )


@dataclass
class Members:
    """Coarse renderers that a policy trains for itself: runs of step 1 without an agent, each in a folder of its own.

    Args:
        views: all candidates, targets = rasterised images.
        model: the renderer's settings; its ``coarse()`` part is trained.
        step1: learning rates and precision; epochs are those of ``settings``.
        folder: of the runs. An interrupted one is continued where ``fingerprint`` is the same.
    """

    views: ViewSet
    model: ModelSettings
    step1: Step1Settings
    settings: ActiveSettings
    seed: int
    device: str
    folder: Path
    fingerprint: str

    def __post_init__(self) -> None:
        self.views = self.views.to(self.device)
        self.step1 = self.step1.model_copy(update={"epochs": self.settings.epochs, "validation_views": 0})
        self.folders: list[Path] = []
        self.trained = dict.fromkeys(CLOCKS, 0.0)
        """What the epochs of this process took."""

    def choose(self, policy: str, budget: int) -> tuple[Choice, dict[str, float]]:
        """The choice, and its wall and process seconds, those of interrupted runs included."""
        started = [clock() for clock in CLOCKS.values()]
        choice = choose_actively(policy, self.views, budget, self.seed, self.settings, self.train)
        cost = {}
        for (name, clock), start in zip(CLOCKS.items(), started, strict=True):
            looking = max(0.0, clock() - start - self.trained[name])
            cost[name] = looking + sum(getattr(training_cost(folder), name) for folder in self.folders)
        return choice, cost

    def train(self, views: list[int], batch: int, member: int) -> DNR:
        """A renderer trained on some candidates."""
        some, folder = self.views.subset(views), self.folder / f"{batch}-{member}"
        seed = int(np.random.SeedSequence([self.seed, batch, member]).generate_state(1)[0])
        events = run_step1(
            some, None, self.model, self.step1,
            policy="random", budget=len(some), seed=seed, device=self.device, checkpoints=folder,
            fingerprint=self.fingerprint,
        )  # fmt: skip
        for event in events:
            if isinstance(event, EpochEnd | Diverged):
                for name in CLOCKS:
                    self.trained[name] += getattr(event, name)
        self.folders.append(folder)
        return load_model(folder, self.device)

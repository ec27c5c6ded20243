"""How much active learning trains, and what its worker is asked; imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ....core.settings import Settings
from ...cells.tasks import StudyTask


@dataclass(frozen=True)
class ActiveSettings:
    """members: renderers of policy ensemble, at least 2; variance trains one. rounds: batches in which views are added
    to the first third of the budget. epochs: each renderer's passes over the views chosen so far."""

    members: int = 3
    rounds: int = 2
    epochs: int = 10


class ActiveTask(StudyTask):
    """Choose views of a pool by active learning -> `SelectionResult`. folder: of its trainings, removed at the end."""

    settings: Settings
    policy: str
    folder: Path

"""A scene file opened in a worker of its own, and what it means when that fails."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from ..blender.tasks import InspectAnswer, InspectTask, PrepareAnswer, PrepareTask
from ..core.errors import UserError
from ..workers.answers import answers
from ..workers.processes import Retry

Answer = TypeVar("Answer", PrepareAnswer, InspectAnswer)


def open_scene(module: str, task: PrepareTask | InspectTask, answer: type[Answer], log: Path) -> tuple[Answer, str]:
    """Run the task on a worker of ``module``: (its answer, why the first try failed or "").

    Raises UserError: both tries failed; says whether Blender itself died of the file. Raises OSError: a full disk.
    """
    failed: list[Retry] = []
    for outcome in answers(module, {}, [task.data()], workers=1, log=log, retried=failed.append):
        if outcome.died:
            raise UserError(f"{task.source}: Blender could not open it ({outcome.error}): damaged or truncated?")
        if outcome.result is None:
            raise UserError(str(outcome.error))
        return answer.model_validate(outcome.result), failed[0].reason if failed else ""
    raise AssertionError("run_tasks answers every task")

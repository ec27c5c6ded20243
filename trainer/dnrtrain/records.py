"""JSON files that selection and training write, as typed records. Imports no torch: other programs look at them.

selection.json                   Selection
checkpoints/*/checkpoint.json    Progress; the header of state.safetensors beside it holds the same
checkpoints/*/model.json         ModelRecord
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, ValidationError

from .atomic import write_json
from .contract import DamagedFile

PROGRESS = "checkpoint.json"
MODEL = "model.json"


class Record(BaseModel):
    """Keys of other versions are ignored. Fields that were not given are not written."""

    def data(self) -> dict[str, Any]:
        """The record as plain values, ready for JSON."""
        return self.model_dump(exclude_unset=True)


Model = TypeVar("Model", bound=BaseModel)


class Selection(Record):
    """The chosen views, in order.

    gains: what each view added when it was taken, in the policy's own measure (``details["measure"]``).
    why: one plain sentence per view.
    """

    policy: str
    budget: int
    seed: int
    views: list[str]
    gains: list[float] = Field(default_factory=list)
    why: list[str] = Field(default_factory=list)
    details: dict[str, Any] = Field(default_factory=dict)


class Epoch(Record):
    """One epoch of a training.

    losses: mean of each loss term over the epoch's steps. val: metrics on validation views, or {}. seconds: wall time;
    cpu_seconds: process time; steps: optimiser steps; skipped: those with a loss or gradient that was not finite;
    learning_rate: of the last step.
    """

    epoch: int
    losses: dict[str, float] = Field(default_factory=dict)
    val: dict[str, float] = Field(default_factory=dict)
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    steps: int = 0
    skipped: int = 0
    learning_rate: float = 0.0


class Restart(Record):
    """An epoch that diverged. scale: factor of the learning rate from there on."""

    epoch: int
    reason: str
    scale: float


class Progress(Record):
    """How far an unfinished training is.

    run: fingerprint of the run that may go on from here. epoch: epochs done. reward_mean: running mean loss of step 1's
    agent; reward_unit: running mean of its |r|. average_steps: steps in step 2's averaged weights.
    """

    run: str
    epoch: int = Field(ge=0)
    bfloat16: bool
    restarts: list[Restart] = Field(default_factory=list)
    history: list[Epoch]
    reward_mean: float | None = None
    reward_unit: float | None = None
    average_steps: int = 0


class ModelRecord(Record):
    """A finished step.

    Args:
        model: the renderer's settings; ``checkpoint.load_model`` validates them.
        fingerprint: of the caller's inputs; the header of the weights has the same.
        run: fingerprint of the run, settings included.
        selected, policy, budget, details, gains, why: step 1's choice, see `Selection`.
        choosing: wall and process seconds of that choice: ``seconds``, ``cpu_seconds``.
    """

    model: dict[str, Any]
    fingerprint: str
    run: str
    stage: str
    settings: dict[str, Any]
    seed: int
    bfloat16: bool
    restarts: list[Restart] = Field(default_factory=list)
    history: list[Epoch]
    policy: str = ""
    budget: int = 0
    selected: list[str] = Field(default_factory=list)
    details: dict[str, Any] = Field(default_factory=dict)
    gains: list[float] = Field(default_factory=list)
    why: list[str] = Field(default_factory=list)
    choosing: dict[str, float] = Field(default_factory=dict)
    views: list[str] = Field(default_factory=list)
    perceptual: bool = False


def write(path: Path, record: Record) -> None:
    """Write a record, atomically."""
    write_json(path, record.data())


def read(path: Path, kind: type[Model]) -> Model:
    """Read a record. Raises FileNotFoundError: there is none; DamagedFile: it does not read, or not as its kind."""
    try:
        return kind.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise DamagedFile(path, first_error(error)) from None


def first_error(error: ValidationError) -> str:
    """The first thing that is wrong, with its place, in one line."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return f"{where}: {first['msg']}" if where else first["msg"]

"""What the studies' workers are asked, and what their files hold.

Tasks travel as JSON. A task's answer is written to its ``output``, so that a task whose file is there is done.
Seconds are wall seconds of training; ``cpu_seconds`` are the processor's.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import AliasChoices, BaseModel, ConfigDict, Field, TypeAdapter

from dnrtrain.atomic import write_json

from ...core.settings import Settings


class PoolTask(BaseModel):
    """What `WorkerPool` needs of any task. label: in messages."""

    model_config = ConfigDict(frozen=True)

    output: Path
    label: str


class StudyTask(PoolTask):
    """fingerprint: of all that decides the answer; it names the files."""

    fingerprint: str
    workspace: Path
    seed: int


class TrainingTask(StudyTask):
    """Train in ``folder``.

    seconds: of training at most, None: the settings' epochs. pace: file of the seconds of an epoch, where ``seconds``
    limit them.
    """

    settings: Settings
    seconds: float | None
    pace: Path
    folder: Path


class FileWorker(ABC):
    """A worker that writes each answer to its task's ``output``.

    common: "threads" of torch, 0 = its own choice, and its "device".
    """

    TASK: ClassVar[TypeAdapter[Any]]
    """What it is asked."""

    def __init__(self, common: dict[str, Any]) -> None:
        import torch

        if common["threads"]:
            torch.set_num_threads(common["threads"])
        self.threads, self.device = torch.get_num_threads(), common["device"]

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        made = self.answer(self.TASK.validate_python(task)).model_dump(mode="json", by_alias=True, exclude_unset=True)
        write_json(Path(task["output"]), made)
        return made

    @abstractmethod
    def answer(self, task: Any) -> BaseModel:
        """What the file will hold; fields that were not given are left out."""


def files_of(folder: Path, fingerprint: str) -> dict[str, Any]:
    """A task's fingerprint, the folder of its trainings and its output beside that."""
    made = {"folder": folder / fingerprint, "output": folder / f"{fingerprint}.json"}
    return {"fingerprint": fingerprint, **made}


class Step1Task(TrainingTask):
    """Train step 1 -> `Step1Result`. policy: chooses the views."""

    kind: Literal["step1"] = "step1"
    policy: str

    def result(self) -> Step1Result:
        """What it gave, once it is done."""
        return Step1Result.model_validate_json(self.output.read_bytes())


class TrainingCost(BaseModel):
    """Sums over all epochs. steps: optimiser steps; skipped: those without an update."""

    seconds: float
    cpu_seconds: float
    steps: int
    skipped: int


class Step1Result(TrainingCost):
    """selected: the views that the policy chose. key: the task's fingerprint."""

    key: str
    selected: list[str]
    epochs: int


class CellTask(TrainingTask):
    """Train step 2, measure all test views -> `CellResult`.

    Args:
        network: False measures the base image alone.
        targets: folder under raytraced/ of the training views' pictures.
        coarse, coarse_cost: folder of step 1 and what that took; None where the network starts fresh.
        seconds: of both steps.
        full_step1: step 1 counts as its whole share of the seconds, whatever it took.
        folder: removed once the model is measured.
        picture: where one test view is kept, None: nowhere.
    """

    kind: Literal["cell"] = "cell"
    scene: str
    network: bool
    views: list[str]
    targets: str = "train"
    coarse: Path | None
    coarse_cost: Step1Result | None
    full_step1: bool
    picture: Path | None
    code: dict[str, Any]

    def result(self) -> CellResult:
        """What it gave, once it is done."""
        return CellResult.model_validate_json(self.output.read_bytes())


class Training(BaseModel):
    """What a cell's training took."""

    epochs: int
    step1: Step1Result | None
    step2: TrainingCost
    seconds: float
    cpu_seconds: float
    perceptual: bool


class CellResult(BaseModel):
    """A cell's file.

    Args:
        settings: "model" and "step2", as they were given.
        train_psnr: mean PSNR on the training views, dB.
        frame_ms, base_ms: median milliseconds of the network's frame and of a base image.
        tests: a row of metrics per test view.
        finished: unix seconds.
    """

    key: str
    scene: str
    seed: int
    settings: dict[str, dict[str, Any]]
    views: list[str]
    training: Training | None
    train_psnr: float | None
    frame_ms: float | None
    base_ms: float | None
    threads: int
    device: str
    tests: list[dict[str, Any]]
    code: dict[str, Any]
    finished: float

    @property
    def base(self) -> str:
        return self.settings["model"]["base"]


class ChoiceFile(BaseModel):
    """What a rule's selection, an active one and a step 1 have in common. views: in order. key: its fingerprint.
    peak_mb: of the process."""

    key: str
    views: list[str] = Field(validation_alias=AliasChoices("views", "selected"))
    seconds: float
    cpu_seconds: float
    peak_mb: float | None = None


class SelectionResult(ChoiceFile):
    """A selection's file, by a rule or by active learning."""

    gains: list[float]
    why: list[str]
    details: dict[str, Any]

"""What steps 1 and 2 share: epochs with checkpoints, the way back from a diverged one, and the events about them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import nn

from . import checkpoint
from .contract import ContractError, DamagedFile
from .dataset import Batch, ViewSet
from .events import Diverged, EpochEnd, Event, Note
from .losses import Step2Loss
from .model import DNR
from .preview import Preview
from .records import Epoch, ModelRecord, Progress
from .schedule import Averaged, EpochBook, Watch, adam, averaged_weights, learning_rate, validate
from .settings import Step1Settings, Step2Settings

Settings = TypeVar("Settings", Step1Settings, Step2Settings)


@dataclass(kw_only=True)
class TrainingRun(ABC, Generic[Settings]):
    """One run of a step. A subclass says how an epoch is trained, and what a checkpoint holds beside the renderer.

    Args:
        dnr: the renderer, on ``device``, as a new run starts with it.
        views: the training views, with targets.
        val: validation views with targets, or None.
        run: fingerprint of the run; only a checkpoint of the same run is continued.
        folder: where checkpoints and the model go.
        average: of the weights, where that becomes the model.
        preview: decides after which epochs to show a view.
        notes: what the caller should be told before training.
    """

    number: ClassVar[int]
    term: ClassVar[str]
    """Name of the loss term that shows whether an epoch diverged."""

    dnr: DNR
    views: ViewSet
    val: ViewSet | None
    settings: Settings
    seed: int
    run: str
    folder: Path
    device: str
    average: Averaged | None = None
    preview: Preview | None = None
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.views = self.views.to(self.device)
        self.val = None if self.val is None else self.val.to(self.device)
        self.dnr.train()
        rate, scale = self.settings.learning_rate, self.settings.texture_rate_scale
        self.optimiser = adam(self.trained(), rate, self.device, scale)
        self.watch = Watch()
        self.history: list[Epoch] = []

    # -- what a step adds ------------------------------------------------------------------------------

    @property
    @abstractmethod
    def steps_per_epoch(self) -> int: ...

    @abstractmethod
    def train_epoch(self, epoch: int, book: EpochBook) -> None:
        """Train one epoch and book its steps."""

    def first_views(self) -> Batch:
        """What the renderer is looked at with after an epoch."""
        return self.views.batch([0])

    def trained(self) -> list[nn.Module]:
        """Modules that the optimiser steps, and whose weights must stay finite."""
        return [self.dnr]

    def recorded(self) -> Sequence[DNR | Step2Loss]:
        """What may train as CUDA graphs."""
        return [self.dnr]

    def more_trouble(self) -> str | None:
        """What else shows that the epoch diverged, in words."""
        return None

    def more_state(self) -> tuple[checkpoint.Parts, dict[str, Any]]:
        """Further parts, and further fields of `Progress`, for a checkpoint."""
        return {}, {}

    def load_more(self, saved: checkpoint.State) -> None:
        """Take back what `more_state` gave."""

    # -- the run ---------------------------------------------------------------------------------------

    def finished(self) -> ModelRecord | None:
        """The record of this run if it was finished before."""
        record = checkpoint.read_record(self.folder)
        return record if record is not None and record.run == self.run else None

    def train(self) -> Iterator[Event]:
        """Train all epochs that are due, from the checkpoint if there is one."""
        epoch, epochs = self._restore(), self.settings.epochs
        for text in self.notes:
            yield Note(text)
        if epoch:
            yield Note(f"step {self.number} continues after epoch {epoch} of {epochs}")
        recorded = self.recorded()
        for part in recorded:
            part.record()
        try:
            while epoch < epochs:
                done = self._epoch(epoch)
                yield done
                if isinstance(done, EpochEnd):
                    epoch += 1
                    if self.preview is not None:
                        yield from self.preview.after(done, self.dnr, self.average)
        finally:
            for part in recorded:
                part.forget()

    def rate(self, step: int) -> float:
        """Learning rate of a step, counted from the first epoch on."""
        s = self.settings
        total = s.epochs * self.steps_per_epoch
        return self.watch.scale * learning_rate(step, total, s.learning_rate, s.learning_rate_end)

    def _epoch(self, epoch: int) -> EpochEnd | Diverged:
        """One epoch. Where it diverged, the state is that before it, at a lower rate."""
        book = EpochBook()
        self.train_epoch(epoch, book)
        with torch.no_grad():
            picture = self.dnr(self.first_views()).rgb
        reason = self.watch.trouble(book, self.term, self.history, picture, *self.trained()) or self.more_trouble()
        if reason is not None:
            text = f"step {self.number}: {self.watch.restart(epoch + 1, reason)}"
            saved = checkpoint.load_state(self.folder, self.run)
            if saved is None:
                path = self.folder / checkpoint.STATE
                raise ContractError(f"{path}: was removed or replaced while training; run the same command again")
            self._load(saved)
            self._save(epoch)
            return Diverged(**dict(book.entry(epoch + 1, 0.0, {})), text=text, device=self.device)
        with averaged_weights(self.dnr, self.average):
            scores = validate(self.dnr, self.val, self.settings.validation_views)
        entry = book.entry(epoch + 1, self.rate((epoch + 1) * self.steps_per_epoch - 1), scores)
        self.history.append(entry)
        self._save(epoch + 1)
        return EpochEnd(**dict(entry), stage=f"step{self.number}", epochs=self.settings.epochs, device=self.device)

    def save_model(self, fingerprint: str, **facts: Any) -> None:
        """Write the trained model. facts: what `ModelRecord` says of this step alone."""
        record = ModelRecord(
            model=self.dnr.settings.model_dump(mode="json"),
            fingerprint=fingerprint,
            run=self.run,
            stage=f"step{self.number}",
            settings=self.settings.model_dump(mode="json"),
            seed=self.seed,
            bfloat16=self.dnr.use_bfloat16,
            restarts=self.watch.restarts,
            history=self.history,
            **facts,
        )
        with averaged_weights(self.dnr, self.average):
            checkpoint.save_model(self.folder, self.dnr, record)

    # -- checkpoints -----------------------------------------------------------------------------------

    def _save(self, epoch: int) -> None:
        parts, fields = self.more_state()
        parts |= {"dnr": self.dnr.state_dict(), "adam": checkpoint.optimiser_tensors(self.optimiser)}
        if self.average is not None:
            parts["average"] = self.average.sums
            fields["average_steps"] = self.average.steps
        progress = Progress(
            run=self.run,
            epoch=epoch,
            bfloat16=self.dnr.use_bfloat16,
            restarts=self.watch.restarts,
            history=self.history,
            **fields,
        )
        checkpoint.save_state(self.folder, parts, progress)

    def _restore(self) -> int:
        """Load the state that this run was interrupted in -> epochs done. Else start afresh."""
        try:
            saved = checkpoint.load_state(self.folder, self.run)
        except DamagedFile as damage:
            self.notes.append(f"{damage.path}: damaged; training starts afresh")
            saved = None
        if saved is None:
            self._save(0)
            return 0
        self.watch.restarts = saved.progress.restarts
        self._load(saved)
        return saved.progress.epoch

    def _load(self, saved: checkpoint.State) -> None:
        self.dnr.use_bfloat16, self.history = saved.progress.bfloat16, saved.progress.history
        self.dnr.load_state_dict(saved.parts["dnr"])
        checkpoint.restore_optimiser(self.optimiser, saved.parts["adam"])
        if self.average is not None:
            self.average.restore(saved.parts["average"], saved.progress.average_steps)
        self.load_more(saved)

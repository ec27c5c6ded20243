"""What steps 1 and 2 share: epochs with checkpoints, the way back from a diverged one, and the events about them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from . import checkpoint
from .dataset import Batch, ViewSet
from .events import Diverged, EpochEnd, Event, Note
from .model import DNR
from .records import Epoch, ModelRecord, Progress
from .schedule import Averaged, EpochBook, Watch, adam, averaged_weights, validate
from .settings import Step1Settings, Step2Settings


class TrainingRun:
    """One run of a step. A subclass says how an epoch is trained, and what a checkpoint holds beside the renderer.

    Args:
        dnr: the renderer, on ``device``.
        settings: of the step.
        val: validation views with targets, or None.
        run: fingerprint of the run; only a checkpoint of the same run is continued.
        folder: where checkpoints and the model go.
        device: torch's.
    """

    number: ClassVar[int]
    term: ClassVar[str]
    """Name of the loss term that shows whether an epoch diverged."""

    def __init__(
        self,
        dnr: DNR,
        settings: Step1Settings | Step2Settings,
        val: ViewSet | None,
        run: str,
        folder: Path,
        device: str,
    ) -> None:
        self.dnr, self.val = dnr, None if val is None else val.to(device)
        self.run, self.folder, self.device = run, folder, device
        self.epochs, self.validation_views = settings.epochs, settings.validation_views
        self.optimiser = adam([dnr], settings.learning_rate, device, settings.texture_rate_scale)
        self.average: Averaged | None = None
        self.watch = Watch()
        self.history: list[Epoch] = []
        self.notes: list[str] = []

    # -- what a step adds ------------------------------------------------------------------------------

    def train_epoch(self, epoch: int, book: EpochBook) -> float:
        """Train one epoch and book its steps -> learning rate of the last step."""
        raise NotImplementedError

    def first_views(self) -> Batch:
        """What the renderer is looked at with after an epoch."""
        raise NotImplementedError

    def decide_precision(self) -> None:
        """Decide the renderer's precision at the start of a new run."""
        raise NotImplementedError

    def trained(self) -> list[nn.Module]:
        """Modules whose weights must stay finite."""
        return [self.dnr]

    def more_state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Further tensors, and further fields of `Progress`, for a checkpoint."""
        return {}, {}

    def load_more(self, saved: checkpoint.State) -> None:
        """Take back what `more_state` gave."""

    def after_epoch(self, done: EpochEnd) -> Iterator[Event]:
        """Further events after a good epoch."""
        yield from ()

    # -- the run ---------------------------------------------------------------------------------------

    def finished(self) -> ModelRecord | None:
        """The record of this run if it was finished before."""
        record = checkpoint.read_record(self.folder)
        return record if record is not None and record.run == self.run else None

    def train(self) -> Iterator[Event]:
        """Train all epochs that are due, from the checkpoint if there is one."""
        epoch = self._restore()
        for text in self.notes:
            yield Note(text)
        if epoch:
            yield Note(f"step {self.number} continues after epoch {epoch} of {self.epochs}")
        while epoch < self.epochs:
            done = self._epoch(epoch)
            yield done
            if isinstance(done, EpochEnd):
                epoch += 1
                yield from self.after_epoch(done)

    def _epoch(self, epoch: int) -> EpochEnd | Diverged:
        """One epoch. Where it diverged, the state is that before it, at a lower rate."""
        book, stage = EpochBook(), f"step{self.number}"
        rate = self.train_epoch(epoch, book)
        with torch.no_grad():
            picture = self.dnr(self.first_views()).rgb
        reason = self.watch.trouble(book, self.term, self.history, picture, *self.trained())
        if reason is not None:
            text = f"step {self.number}: {self.watch.restart(epoch + 1, reason)}"
            self._load(checkpoint.require_state(self.folder, self.run))
            self._save(epoch)
            lost = book.entry(epoch + 1, 0.0, {})
            return Diverged(stage, lost.epoch, text, lost.seconds, lost.cpu_seconds, lost.steps, self.device)
        with averaged_weights(self.dnr, self.average):
            scores = validate(self.dnr, self.val, self.validation_views)
        entry = book.entry(epoch + 1, rate, scores)
        self.history.append(entry)
        self._save(epoch + 1)
        return EpochEnd(
            stage,
            entry.epoch,
            self.epochs,
            entry.losses,
            scores,
            entry.seconds,
            entry.cpu_seconds,
            entry.steps,
            entry.skipped,
            self.device,
        )

    # -- checkpoints -----------------------------------------------------------------------------------

    def _save(self, epoch: int) -> None:
        tensors, fields = self.more_state()
        tensors |= checkpoint.prefixed("dnr", self.dnr.state_dict())
        tensors |= checkpoint.prefixed("adam", checkpoint.optimiser_tensors(self.optimiser))
        progress = Progress(
            run=self.run,
            epoch=epoch,
            bfloat16=self.dnr.use_bfloat16,
            restarts=self.watch.restarts,
            history=self.history,
            **fields,
        )
        checkpoint.save_state(self.folder, tensors, progress)

    def _restore(self) -> int:
        """Load the state that this run was interrupted in -> epochs done. Else start afresh."""
        saved = checkpoint.interrupted(self.folder, self.run, self.notes)
        if saved is None:
            self.decide_precision()
            self._save(0)
            return 0
        self.watch.restarts = saved.progress.restarts
        self._load(saved)
        return saved.progress.epoch

    def _load(self, saved: checkpoint.State) -> None:
        self.dnr.use_bfloat16, self.history = saved.progress.bfloat16, saved.progress.history
        self.dnr.load_state_dict(checkpoint.unprefixed("dnr", saved.tensors))
        checkpoint.restore_optimiser(self.optimiser, checkpoint.unprefixed("adam", saved.tensors))
        self.load_more(saved)

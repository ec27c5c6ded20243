"""Step 2: fine-tune the coarse DNR on the selected ray-traced views with six losses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from . import checkpoint
from .contract import ContractError
from .dataset import DIHEDRAL_ORDER, Batch, ViewSet
from .events import EpochEnd, Event, Note
from .losses import Step2Loss
from .model import DNR
from .perceptual import PerceptualLoss
from .precision import decide_bfloat16
from .preview import Preview, Previewer
from .records import ModelRecord
from .schedule import (
    STEP2,
    Averaged,
    EpochBook,
    averaged_weights,
    guarded_step,
    learning_rate,
    require_target,
    run_fingerprint,
    step_random,
)
from .settings import ModelSettings, Step2Settings
from .training_run import TrainingRun


def run_step2(
    views: ViewSet,
    val: ViewSet | None,
    coarse: Path,
    model: ModelSettings,
    settings: Step2Settings,
    *,
    seed: int,
    device: str,
    checkpoints: Path,
    fingerprint: str,
    weights: Mapping[str, Mapping[str, Tensor]] | None,
    preview: Preview | None = None,
) -> Iterator[Event]:
    """Fine-tune; yields an event per epoch and leaves ``model.safetensors`` and ``model.json``.

    Args:
        views: the M selected views, targets = ray-traced images.
        val: views with held-out targets, or None.
        coarse: folder of the finished step 1; with ``start = fresh`` it is not read.
        model: of the renderer.
        seed: of new weights, of the order of steps, of patches and flips.
        device: torch's.
        checkpoints: this step's own folder; see `run_step1` on resuming.
        fingerprint: of the caller's inputs.
        weights: from ``weights.load_weights``; None drops L_p with a note, and the record says
            ``"perceptual": false``.
        preview: a view to show now and then while training goes on. It changes nothing of what is trained.

    Raises:
        ContractError: no finished step 1, of other model settings, or views without targets.
    """
    require_target(views, "step 2")
    notes: list[str] = []
    start = (
        DNR(model, seed).to(device) if settings.start == "fresh" else _from_coarse(coarse, model, seed, device, notes)
    )
    wants_perceptual = settings.loss.perceptual > 0
    perceptual = None
    if weights is not None and wants_perceptual:
        perceptual = PerceptualLoss(weights["vgg"]).to(device)
    record = checkpoint.read_record(coarse) if settings.start == "coarse" else None
    parts = [
        model.model_dump(), settings.model_dump(), seed, device, perceptual is not None,
        None if record is None else record.run,
    ]  # fmt: skip
    run = run_fingerprint(fingerprint, views, parts)
    step = _Step2(views, val, start, settings, Step2Loss(settings, perceptual), seed, run, Path(checkpoints), device)
    step.notes += notes
    step.previewer = None if preview is None else Previewer(preview, device)
    if step.finished() is not None:
        yield Note("step 2 is finished already")
        return
    if wants_perceptual and perceptual is None:
        yield Note("perceptual weights are missing: training goes on without the loss term L_p")
    yield from step.train()
    made = ModelRecord(
        model=step.dnr.settings.model_dump(mode="json"),
        fingerprint=fingerprint,
        run=run,
        stage="step2",
        settings=settings.model_dump(mode="json"),
        seed=seed,
        views=list(views.names),
        perceptual=perceptual is not None,
        bfloat16=step.dnr.use_bfloat16,
        restarts=step.watch.restarts,
        history=step.history,
    )
    with averaged_weights(step.dnr, step.average):
        checkpoint.save_model(step.folder, step.dnr, made)


def _from_coarse(folder: Path, model: ModelSettings, seed: int, device: str, notes: list[str]) -> DNR:
    """Step 1's renderer. Where ``model`` has parts that the coarse one lacks, those start fresh, and a note says so."""
    coarse = checkpoint.load_model(folder, device)
    if coarse.settings == model:
        return coarse
    if coarse.settings != model.coarse():
        raise ContractError(f"{folder}: was trained with other model settings; run `dnrpipe select` again")
    dnr = DNR(model, seed).to(device)
    known, own = coarse.state_dict(), dnr.state_dict()
    # The last layer says how the picture comes about, which a base image changes.
    fits = {
        name: value
        for name, value in known.items()
        if name in own and own[name].shape == value.shape and not name.startswith("renderer.head.")
    }
    dnr.load_state_dict(fits, strict=False)
    dnr.use_bfloat16 = coarse.use_bfloat16
    notes.append(f"step 2 takes {len(fits)} of {len(own)} tensors from step 1; the others start fresh")
    return dnr


class _Step2(TrainingRun):
    number, term = 2, "photometric"

    def __init__(
        self,
        views: ViewSet,
        val: ViewSet | None,
        dnr: DNR,
        settings: Step2Settings,
        loss: Step2Loss,
        seed: int,
        run: str,
        folder: Path,
        device: str,
    ) -> None:
        super().__init__(dnr, settings, val, run, folder, device)
        self.views, self.settings, self.loss, self.seed = views.to(device), settings, loss, seed
        self.dnr.train()
        self.steps_per_epoch = -(-len(views) // settings.batch)
        self.average = Averaged(self.dnr, settings.ema) if settings.ema else None
        self.previewer: Previewer | None = None

    def train_epoch(self, epoch: int, book: EpochBook) -> float:
        s = self.settings
        order = step_random(self.seed, STEP2, epoch, -1).permutation(len(self.views))
        total = s.epochs * self.steps_per_epoch
        rate = s.learning_rate
        for step in range(self.steps_per_epoch):
            random = step_random(self.seed, STEP2, epoch, step)
            chosen = order[step * s.batch : (step + 1) * s.batch]
            batch = self.views.batch([int(i) for i in chosen])
            batch = random_patch(batch, s.patch, random)
            if s.augment:
                batch = batch.augment(int(random.integers(DIHEDRAL_ORDER)))
            assert batch.target is not None
            rate = learning_rate(epoch * self.steps_per_epoch + step, total, s.learning_rate, s.learning_rate_end)
            rate *= self.watch.scale
            loss, terms = self.loss(self.dnr(batch), batch.target, random, bfloat16=self.dnr.use_bfloat16)
            taken = guarded_step(self.optimiser, loss, rate)
            book.count(taken)
            if taken and self.average is not None:
                self.average.update()
            values = torch.stack([loss, *terms.values()]).detach().tolist()
            book.add(**dict(zip(["total", *terms], values, strict=True)))
        return rate

    def first_views(self) -> Batch:
        return random_patch(self.views.batch([0]), self.settings.patch, np.random.default_rng(0))

    def decide_precision(self) -> None:
        if self.settings.precision != "auto" or self.settings.start == "fresh":  # else as step 1 decided
            self.dnr.use_bfloat16 = decide_bfloat16(self.settings.precision, self.device)

    def more_state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        if self.average is None:
            return {}, {}
        return checkpoint.prefixed("average", self.average.sums), {"average_steps": self.average.steps}

    def load_more(self, saved: checkpoint.State) -> None:
        if self.average is not None:
            self.average.restore(checkpoint.unprefixed("average", saved.tensors), saved.progress.average_steps)

    def after_epoch(self, done: EpochEnd) -> Iterator[Event]:
        if self.previewer is not None:
            yield from self.previewer.after(done, self.dnr, self.average)


def random_patch(batch: Batch, side: int, random: np.random.Generator) -> Batch:
    """The same random ``side``×``side`` window of all maps; 0, or no smaller than the image: all of it.

    Memory and time of a step then depend on the window, not on the image.
    """
    height, width = batch.mask.shape[-2:]
    if side == 0 or (side >= height and side >= width):
        return batch
    top = int(random.integers(max(1, height - side + 1)))
    left = int(random.integers(max(1, width - side + 1)))
    return batch.crop(top, left, side)

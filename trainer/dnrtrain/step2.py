"""Step 2: fine-tune the coarse DNR on the selected ray-traced views with six losses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from . import checkpoint
from .contract import ContractError
from .dataset import DIHEDRAL_ORDER, Batch, ViewSet
from .events import Event, Note
from .losses import Step2Loss
from .model import DNR
from .perceptual import PerceptualLoss
from .precision import decide_bfloat16
from .preview import Preview
from .schedule import STEP2, Averaged, EpochBook, guarded_step, require_target, run_fingerprint, step_random
from .settings import ModelSettings, Step2Settings
from .shipped import with_corrector
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
        coarse: folder of the finished step 1; read only with ``start = coarse``.
        seed: of new weights, of the order of steps, of patches and flips.
        checkpoints: this step's own folder; see `run_step1` on resuming.
        weights: from ``weights.load_weights``; None drops L_p with a note, and the record says
            ``"perceptual": false``.
        preview: a view to show now and then while training goes on. It changes nothing of what is trained.

    Raises:
        ContractError: no finished step 1, of other model settings, or views without targets.
    """
    require_target(views, "step 2")
    notes: list[str] = []
    from_coarse = settings.start == "coarse"
    if from_coarse:
        dnr = _from_coarse(coarse, model, seed, device, notes)
    else:
        dnr = (DNR if settings.start == "fresh" else with_corrector)(model, seed).to(device)
    if settings.precision != "auto" or not from_coarse:  # else as step 1 decided
        dnr.use_bfloat16 = decide_bfloat16(settings.precision, device)
    wants_perceptual = settings.loss.perceptual > 0
    perceptual = None
    if weights is not None and wants_perceptual:
        perceptual = PerceptualLoss(weights["vgg"], settings.perceptual_weights).to(device)
    record = checkpoint.read_record(coarse) if from_coarse else None
    parts = [
        model.model_dump(), settings.model_dump(), seed, device, perceptual is not None,
        None if record is None else record.run,
    ]  # fmt: skip
    step = _Step2(
        dnr=dnr,
        views=views,
        val=val,
        settings=settings,
        loss=Step2Loss(settings, perceptual),
        seed=seed,
        run=run_fingerprint(fingerprint, views, parts),
        folder=Path(checkpoints),
        device=device,
        average=Averaged(dnr, settings.ema) if settings.ema else None,
        notes=notes,
        preview=preview,
    )
    if step.finished() is not None:
        yield Note("step 2 is finished already")
        return
    if wants_perceptual and perceptual is None:
        yield Note("perceptual weights are missing: training goes on without the loss term L_p")
    yield from step.train()
    step.save_model(fingerprint, views=list(views.names), perceptual=perceptual is not None)


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


@dataclass(kw_only=True)
class _Step2(TrainingRun[Step2Settings]):
    number, term = 2, "photometric"

    loss: Step2Loss

    def recorded(self) -> Sequence[DNR | Step2Loss]:
        return [self.dnr, self.loss]

    @property
    def steps_per_epoch(self) -> int:
        return -(-len(self.views) // self.settings.batch)

    def train_epoch(self, epoch: int, book: EpochBook) -> None:
        s = self.settings
        order = step_random(self.seed, STEP2, epoch, -1).permutation(len(self.views))
        for step in range(self.steps_per_epoch):
            random = step_random(self.seed, STEP2, epoch, step)
            chosen = order[step * s.batch : (step + 1) * s.batch]
            batch = self.views.batch([int(i) for i in chosen])
            batch = random_patch(batch, s.patch, random)
            if s.augment:
                batch = batch.augment(int(random.integers(DIHEDRAL_ORDER)))
            assert batch.target is not None
            loss, terms = self.loss(self.dnr(batch), batch.target, random, bfloat16=self.dnr.use_bfloat16)
            taken = guarded_step(self.optimiser, loss, self.rate(epoch * self.steps_per_epoch + step))
            book.count(taken)
            if taken and self.average is not None:
                self.average.update()
            values = torch.stack([loss, *terms.values()]).detach().tolist()
            book.add(**dict(zip(["total", *terms], values, strict=True)))

    def first_views(self) -> Batch:
        return random_patch(self.views.batch([0]), self.settings.patch, np.random.default_rng(0))


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

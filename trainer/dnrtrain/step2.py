"""Step 2: fine-tune the coarse DNR on the selected ray-traced views with six losses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from . import checkpoint
from .contract import ContractError
from .dataset import DIHEDRAL_ORDER, Batch, ViewSet
from .events import Diverged, EpochEnd, Event, Note
from .losses import Step2Loss
from .model import DNR
from .perceptual import PerceptualLoss
from .precision import decide_bfloat16
from .preview import Preview, Previewer
from .schedule import (
    STEP2,
    Averaged,
    EpochBook,
    Watch,
    adam,
    averaged_weights,
    guarded_step,
    learning_rate,
    require_target,
    run_key,
    step_random,
    validate,
)
from .settings import ModelSettings, Step2Settings


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
        checkpoints: this step's own folder; see :func:`dnrtrain.step1.run_step1` on resuming.
        weights: from :func:`dnrtrain.weights.load_weights`; None drops L_p with a note, and the record says
            ``"perceptual": false``.
        preview: a view to show now and then while training goes on. It changes nothing of what is trained.

    Raises:
        ContractError: no finished step 1, of other model settings, or views without targets.
    """
    run = _Step2(views, val, coarse, model, settings, seed, device, checkpoints, fingerprint, weights)
    run.previewer = None if preview is None else Previewer(preview, device)
    yield from run.events()


class _Step2:
    """One run's state."""

    def __init__(
        self,
        views: ViewSet,
        val: ViewSet | None,
        coarse: Path,
        model: ModelSettings,
        settings: Step2Settings,
        seed: int,
        device: str,
        folder: Path,
        fingerprint: str,
        weights: Mapping[str, Mapping[str, Tensor]] | None,
    ) -> None:
        require_target(views, "step 2")
        self.views, self.val = views.to(device), None if val is None else val.to(device)
        self.settings, self.seed, self.device = settings, seed, device
        self.folder, self.fingerprint = Path(folder), fingerprint
        self.notes: list[str] = []
        self.dnr = DNR(model, seed).to(device) if settings.start == "fresh" else self._from_coarse(coarse, model)
        self.dnr.train()
        self.wants_perceptual = settings.loss.perceptual > 0
        perceptual = None
        if weights is not None and self.wants_perceptual:
            perceptual = PerceptualLoss(weights["vgg"]).to(device)
        self.loss = Step2Loss(settings, perceptual)
        record = checkpoint.read_record(coarse) if settings.start == "coarse" else None
        parts = [
            model.model_dump(), settings.model_dump(), seed, device, perceptual is not None,
            None if record is None else record.get("run"),
        ]  # fmt: skip
        self.key = run_key(fingerprint, views, parts)
        self.steps_per_epoch = -(-len(views) // settings.batch)
        self.optimiser = adam([self.dnr], settings.learning_rate, device, settings.texture_rate_scale)
        self.average = Averaged(self.dnr, settings.ema) if settings.ema else None
        self.watch = Watch()
        self.history: list[dict] = []
        self.previewer: Previewer | None = None

    def _from_coarse(self, folder: Path, model: ModelSettings) -> DNR:
        """Step 1's renderer; where ``model`` has parts that the coarse one lacks, those start fresh."""
        coarse = checkpoint.load_model(folder, self.device)
        if coarse.settings == model:
            return coarse
        if coarse.settings != model.coarse():
            raise ContractError(f"{folder}: was trained with other model settings; run `dnrpipe select` again")
        dnr = DNR(model, self.seed).to(self.device)
        known, own = coarse.state_dict(), dnr.state_dict()
        # The last layer says how the picture comes about, which a base image changes.
        fits = {
            name: value
            for name, value in known.items()
            if name in own and own[name].shape == value.shape and not name.startswith("renderer.head.")
        }
        dnr.load_state_dict(fits, strict=False)
        dnr.use_bfloat16 = coarse.use_bfloat16
        self.notes.append(f"step 2 takes {len(fits)} of {len(own)} tensors from step 1; the others start fresh")
        return dnr

    def events(self) -> Iterator[Event]:
        record = checkpoint.read_record(self.folder)
        if record is not None and record.get("run") == self.key:
            yield Note("step 2 is finished already")
            return
        if self.wants_perceptual and self.loss.perceptual is None:
            yield Note("perceptual weights are missing: training goes on without the loss term L_p")
        first = self._restore()
        for text in self.notes:
            yield Note(text)
        if first:
            yield Note(f"step 2 continues after epoch {first} of {self.settings.epochs}")
        epoch = first
        while epoch < self.settings.epochs:
            done = self._epoch(epoch)
            yield done
            if self.previewer is not None and isinstance(done, EpochEnd):
                yield from self.previewer.after(done, self.dnr, self.average)
            epoch += isinstance(done, EpochEnd)
        info = {
            "fingerprint": self.fingerprint,
            "run": self.key,
            "stage": "step2",
            "settings": self.settings.model_dump(mode="json"),
            "seed": self.seed,
            "views": list(self.views.names),
            "perceptual": self.loss.perceptual is not None,
            "bfloat16": self.dnr.use_bfloat16,
            "restarts": self.watch.restarts,
            "history": self.history,
        }
        with averaged_weights(self.dnr, self.average):
            checkpoint.save_model(self.folder, self.dnr, info)

    def _epoch(self, epoch: int) -> EpochEnd | Diverged:
        """One epoch; where it diverged, the state is that before it, at a lower rate."""
        s, book = self.settings, EpochBook()
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
        reason = self.watch.trouble(book, "photometric", self.history, self._picture(), self.dnr)
        if reason is not None:
            text = self.watch.restart(epoch + 1, reason)
            self._load(checkpoint.require_state(self.folder, self.key))
            self._save(epoch)
            spent = book.entry(epoch + 1, 0.0, {})
            return Diverged(
                "step2",
                epoch + 1,
                f"step 2: {text}",
                spent["seconds"],
                spent["cpu_seconds"],
                spent["steps"],
                self.device,
            )
        with averaged_weights(self.dnr, self.average):
            scores = validate(self.dnr, self.val, s.validation_views)
        entry = book.entry(epoch + 1, rate, scores)
        self.history.append(entry)
        self._save(epoch + 1)
        return EpochEnd(
            "step2",
            epoch + 1,
            s.epochs,
            entry["losses"],
            scores,
            entry["seconds"],
            entry["cpu_seconds"],
            entry["steps"],
            entry["skipped"],
            self.device,
        )

    @torch.no_grad()
    def _picture(self) -> Tensor:
        """The first view as the weights of now render it."""
        return self.dnr(random_patch(self.views.batch([0]), self.settings.patch, np.random.default_rng(0))).rgb

    def _save(self, epoch: int) -> None:
        tensors = checkpoint.prefixed("dnr", self.dnr.state_dict())
        tensors |= checkpoint.prefixed("adam", checkpoint.optimiser_tensors(self.optimiser))
        info = {
            "run": self.key,
            "epoch": epoch,
            "bfloat16": self.dnr.use_bfloat16,
            "restarts": self.watch.restarts,
            "history": self.history,
        }
        if self.average is not None:
            tensors |= checkpoint.prefixed("average", self.average.sums)
            info["average_steps"] = self.average.steps
        checkpoint.save_state(self.folder, tensors, info)

    def _restore(self) -> int:
        """Load the state of an interrupted run of the same key; -> epochs done. Else start afresh."""
        saved = checkpoint.interrupted(self.folder, self.key, self.notes)
        if saved is None:
            if self.settings.precision != "auto" or self.settings.start == "fresh":  # else as step 1 decided
                self.dnr.use_bfloat16 = decide_bfloat16(self.settings.precision, self.device)
            self._save(0)
            return 0
        self.watch.restarts = saved.info.get("restarts", [])
        self._load(saved)
        return int(saved.info["epoch"])

    def _load(self, saved: checkpoint.Saved) -> None:
        self.dnr.use_bfloat16, self.history = saved.info["bfloat16"], saved.info["history"]
        checkpoint.load_module(self.dnr, checkpoint.unprefixed("dnr", saved.tensors))
        checkpoint.restore_optimiser(self.optimiser, checkpoint.unprefixed("adam", saved.tensors))
        if self.average is not None:
            self.average.restore(checkpoint.unprefixed("average", saved.tensors), saved.info["average_steps"])


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

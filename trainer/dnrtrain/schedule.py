"""What steps 1 and 2 share: learning rate, seeds per step, guarded optimiser steps, epoch books.

All randomness of a step derives from (seed, stage, epoch, step): nothing depends on what ran before in
the process, so an interrupted run goes on bit for bit (CPU, same thread count).
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .aggregator import Aggregator
from .contract import ContractError
from .dataset import ViewSet
from .metrics import psnr, ssim
from .model import DNR, render_views
from .records import Epoch, Restart

STEP1, STEP2 = 1, 2
GRADIENT_NORM = 10.0
"""Gradients are scaled down to this norm: far above ordinary steps, it only tames outliers."""
BLOWN_UP = 10.0
"""Photometric loss of display images in [0, 1] that no untrained network has: the weights have blown up."""
WORSE = 10.0
"""An epoch whose loss is so many times that of the best one has diverged, unless both are below NOTHING_LOST."""
NOTHING_LOST = 0.1
SLOWER = 0.1
"""Factor of the learning rate at each restart."""
MAX_RESTARTS = 6
"""A training that diverges once more than this, at a millionth of its learning rate, is refused."""


def step_random(seed: int, stage: int, epoch: int, step: int) -> np.random.Generator:
    """The random generator of one step. ``step`` −1 is the epoch's own (orders), epoch −1 the stage's."""
    return np.random.default_rng([seed, stage, epoch + 1, step + 1])


def learning_rate(step: int, steps: int, start: float, end: float) -> float:
    """Exponential decay from ``start`` (first step) to ``end`` (last step)."""
    return start * (end / start) ** (step / (steps - 1)) if steps > 1 else start


def adam(modules: list[nn.Module], rate: float, device: str, texture_rate_scale: float = 1.0) -> torch.optim.Adam:
    """Adam (0.9, 0.999). Fused: on dense textures it is an order of magnitude faster than the loop.

    Each parameter group carries ``scale``: what `guarded_step` multiplies its rate by. Texels of the surface are seen
    by few pixels of few views, so they may want a larger rate than the networks (DNR uses ten times it). Those of the
    depth and normal textures are met by every view; they learn at the networks' rate.
    """
    parts = [part for module in modules for part in module.modules()]
    texels = {id(p) for part in parts if isinstance(part, Aggregator) for p in part.surface_texels()}
    parameters = [p for module in modules for p in module.parameters()]
    groups = [
        {"params": [p for p in parameters if id(p) not in texels], "scale": 1.0},
        {"params": [p for p in parameters if id(p) in texels], "scale": texture_rate_scale},
    ]
    fused = device == "cpu" or device.startswith("cuda")
    return torch.optim.Adam([g for g in groups if g["params"]], lr=rate, betas=(0.9, 0.999), fused=fused)


def guarded_step(optimiser: torch.optim.Optimizer, loss: Tensor, rate: float) -> bool:
    """Back-propagate and step; False (and no change of weights or moments) on a non-finite loss or gradient."""
    optimiser.zero_grad(set_to_none=True)
    if not torch.isfinite(loss):
        return False
    loss.backward()
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    gradients = [p.grad for p in parameters if p.grad is not None]
    norm = nn.utils.get_total_norm(gradients)
    if not torch.isfinite(norm):
        optimiser.zero_grad(set_to_none=True)
        return False
    if norm > GRADIENT_NORM:
        nn.utils.clip_grads_with_norm_(parameters, GRADIENT_NORM, norm)
    for group in optimiser.param_groups:
        group["lr"] = rate * group["scale"]
    optimiser.step()
    return True


class Averaged:
    """Exponential moving average of a module's parameters, bias-corrected as Adam's moments are.

    Late weights of a noisy training differ from step to step; their average is what renders best.
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        self.decay, self.steps = decay, 0
        self.parameters = dict(module.named_parameters())
        self.sums = {name: torch.zeros_like(p, requires_grad=False) for name, p in self.parameters.items()}

    @torch.no_grad()
    def update(self) -> None:
        """Take in the parameters as they are now (once per optimiser step)."""
        self.steps += 1
        torch._foreach_lerp_(list(self.sums.values()), list(self.parameters.values()), 1.0 - self.decay)

    def weights(self) -> dict[str, Tensor]:
        """The average so far; the parameters themselves before the first step."""
        if self.steps == 0:
            return {name: p.detach().clone() for name, p in self.parameters.items()}
        correction = 1.0 - self.decay**self.steps
        return {name: value / correction for name, value in self.sums.items()}

    def restore(self, sums: dict[str, Tensor], steps: int) -> None:
        """Go on from saved ``sums`` and ``steps``."""
        self.steps = steps
        for name, value in sums.items():
            self.sums[name].copy_(value)


@contextmanager
def averaged_weights(module: nn.Module, average: Averaged | None) -> Iterator[None]:
    """``module`` with the averaged weights inside the block, its own again after it; None changes nothing."""
    if average is None:
        yield
        return
    own = {name: p.detach().clone() for name, p in module.named_parameters()}
    module.load_state_dict(average.weights(), strict=False)  # buffers stay
    try:
        yield
    finally:
        module.load_state_dict(own, strict=False)


@dataclass
class Watch:
    """Notices epochs that diverged. ``scale`` multiplies the learning rate; it falls at every restart.

    restarts: one per diverged epoch; part of a run's checkpoint.
    """

    restarts: list[Restart] = field(default_factory=list)

    @property
    def scale(self) -> float:
        return self.restarts[-1].scale if self.restarts else 1.0

    def trouble(
        self, book: EpochBook, term: str, history: Sequence[Epoch], picture: Tensor, *modules: nn.Module
    ) -> str | None:
        """What shows that the epoch in ``book`` diverged, in words; None when it did not.

        term: name of the photometric loss, in ``book`` and in the entries of ``history`` (the good epochs so far).
        picture: any training view as the weights render it now: losses are those *before* each step.
        modules: whose weights must be finite.
        """
        if 2 * book.skipped > book.steps:
            return f"{book.skipped} of {book.steps} steps were not finite"
        if not all(bool(torch.isfinite(p).all()) for module in modules for p in module.parameters()):
            return "weights are not finite"
        level = float(picture.square().mean())
        if not level < BLOWN_UP:
            return f"its weights render a mean square of {level:.3g} in display space"
        loss = book.means().get(term)
        if loss is None:
            return None
        best = min((entry.losses.get(term, loss) for entry in history), default=loss)
        if loss > BLOWN_UP or loss > max(WORSE * best, NOTHING_LOST):
            return f"its {term} loss is {loss:.3g}" + (f" after {best:.3g}" if history else "")
        return None

    def restart(self, epoch: int, reason: str) -> str:
        """Book a restart of ``epoch`` (one-based) at a lower rate -> the line that says so.

        Raises ContractError after MAX_RESTARTS: lower rates do not help.
        """
        if len(self.restarts) == MAX_RESTARTS:
            raise ContractError(
                f"training diverges in epoch {epoch} ({reason}) even at {self.scale:.2g} of its learning rate;"
                " look at the training images, or lower the learning rate"
            )
        self.restarts.append(Restart(epoch=epoch, reason=reason, scale=self.scale * SLOWER))
        return (
            f"epoch {epoch} diverged ({reason}): back to the weights after epoch {epoch - 1},"
            f" learning rate times {self.scale:.2g} from here"
        )


@dataclass
class EpochBook:
    """Sums of one epoch."""

    wall: float = field(default_factory=time.monotonic)
    cpu: float = field(default_factory=time.process_time)
    sums: dict[str, float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    steps: int = 0
    skipped: int = 0

    def add(self, **terms: float) -> None:
        """Book loss terms of a step; non-finite ones belong to skipped steps and are left out."""
        for name, value in terms.items():
            if np.isfinite(value):
                self.sums[name] = self.sums.get(name, 0.0) + value
                self.counts[name] = self.counts.get(name, 0) + 1

    def count(self, taken: bool) -> None:
        self.steps += 1
        self.skipped += not taken

    def means(self) -> dict[str, float]:
        return {name: total / self.counts[name] for name, total in self.sums.items()}

    def entry(self, epoch: int, rate: float, val: dict[str, float]) -> Epoch:
        return Epoch(
            epoch=epoch,
            losses=self.means(),
            val=val,
            seconds=time.monotonic() - self.wall,
            cpu_seconds=time.process_time() - self.cpu,
            steps=self.steps,
            skipped=self.skipped,
            learning_rate=rate,
        )


def run_fingerprint(fingerprint: str, views: ViewSet, parts: Sequence[Any]) -> str:
    """What a checkpoint must share with a run to continue it: a hash of the caller's fingerprint and all settings."""
    text = json.dumps([fingerprint, list(views.names), list(views.size), *parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def require_target(views: ViewSet, what: str) -> Tensor:
    """The views' target images. Raises ContractError when they were loaded without."""
    if views.tensors.target is None:
        raise ContractError(f"{what}: the views have no target images; load them with targets")
    return views.tensors.target


def validate(model: DNR, val: ViewSet | None, limit: int) -> dict[str, float]:
    """Mean psnr, ssim and mse over at most ``limit`` evenly spaced validation views; {} without any."""
    if val is None or len(val) == 0 or limit == 0:
        return {}
    chosen = np.unique(np.linspace(0, len(val) - 1, min(limit, len(val))).round().astype(int))
    views = val.subset([int(i) for i in chosen])
    rendered, target = render_views(model, views), require_target(views, "validation").cpu()
    return {
        "psnr": float(psnr(rendered, target).mean()),
        "ssim": float(ssim(rendered, target).mean()),
        "mse": float((rendered - target).square().mean()),
    }

"""Training of the shipped corrector: no scene in it, trained on many scenes, used on scenes that it never saw.

Notation
    x      a base image of a view and its guides: of k rays per pixel, or with what earlier frames of a camera's way saw
    y      its path-traced reference, display space over white

Each step draws scenes, one view and one x of each, and a square of it, then disturbs what must not matter: the
symmetries of the square, the order of the colour channels, the level of light. References are noisy and not denoised:
noise averages out over steps, a denoiser's softness would be learned (Lehtinen et al. 2018). Structural and perceptual
terms would take noise for structure, so they are small or none.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from . import checkpoint
from .dataset import DIHEDRAL_ORDER, Batch
from .losses import Step2Loss
from .metrics import psnr
from .model import DNR, base_picture
from .precision import decide_bfloat16
from .pretraining_data import SceneMaps, joined
from .records import Epoch, Progress
from .schedule import Averaged, adam, averaged_weights, guarded_step
from .settings import CORRECTOR, LossWeights, ModelSettings, Step2Settings

LOSS = Step2Settings(
    loss=LossWeights(photometric=0.0, ssim=0.02, perceptual=0.0, total_variation=0.0, regularisation=0.0),
    frequency_norm="ortho",
)
TYPICAL, LEAST = 0.02, 0.005
"""Mean absolute error of a base image: where its picture counts as much as in L1, and what is added to it."""
RATE, RATE_END = 1e-3, 2e-5
RATE_ONWARDS = 4e-4
"""The first rate where training goes on from weights."""
EMA = 0.999
STOPS = 1.0
"""The level of light varies by so many stops up and down."""


def pretrain(
    training: list[SceneMaps],
    held_out: list[SceneMaps],
    folder: Path,
    *,
    model: ModelSettings = CORRECTOR,
    seconds: float,
    batch: int = 4,
    side: int = 64,
    seed: int = 0,
    begin: DNR | None = None,
    every: float = 120.0,
) -> Iterator[dict[str, Any]]:
    """Train for so many seconds in all; yields a record every ``every`` seconds, the last one at the end.

    Args:
        folder: holds the state of an interrupted training, which goes on if all that decides it is the same.
        side: of the squares, pixels.
        begin: a corrector to go on from; None: fresh.
    """
    dnr, first_rate = DNR(model, seed), RATE if begin is None else RATE_ONWARDS
    if begin is not None:
        dnr.load_state_dict(begin.state_dict())
    dnr.use_bfloat16 = decide_bfloat16("auto", "cpu")
    optimiser = adam([dnr], RATE, "cpu")
    average = Averaged(dnr, EMA)
    spent, step = 0.0, 0
    scenes = [one.scene.seed for one in training]
    run = f"pretrain {model.model_dump_json()} {seed} {batch} {side} {scenes} {begin and _checksum(begin)}"
    saved = checkpoint.load_state(folder, run)
    if saved is not None:
        dnr.load_state_dict(saved.parts["dnr"])
        checkpoint.restore_optimiser(optimiser, saved.parts["adam"])
        average.restore(saved.parts["average"], saved.progress.average_steps)
        step, spent = saved.progress.epoch, saved.progress.history[-1].seconds
    loss_of = Step2Loss(LOSS, None)
    total = 0.0
    count = 0
    told = spent
    clock = time.monotonic()
    dnr.train()
    while spent < seconds:
        random = np.random.default_rng([seed, step])
        rate = first_rate * (RATE_END / first_rate) ** min(1.0, spent / seconds)
        drawn = [training[int(index)].draw(random, side) for index in random.integers(len(training), size=batch)]
        pictures = joined([disturbed(picture, random) for picture in drawn])
        assert pictures.target is not None
        output = dnr(pictures)
        loss, _ = loss_of(output, pictures.target, random, bfloat16=dnr.use_bfloat16)
        loss = loss + photometric(output.rgb, pictures)
        if guarded_step(optimiser, loss, rate):
            average.update()
            total, count = total + float(loss.detach()), count + 1
        step += 1
        spent += time.monotonic() - clock
        clock = time.monotonic()
        if spent - told >= every or spent >= seconds:
            told = spent
            moments = checkpoint.optimiser_tensors(optimiser)
            parts: checkpoint.Parts = {"dnr": dnr.state_dict(), "adam": moments, "average": average.sums}
            done = [Epoch(epoch=step, seconds=spent)]
            progress = Progress(
                run=run, epoch=step, bfloat16=dnr.use_bfloat16, history=done, average_steps=average.steps
            )
            checkpoint.save_state(folder, parts, progress)
            with averaged_weights(dnr, average):
                checkpoint.save(folder / "corrector.safetensors", dnr.state_dict(), {"settings": model.model_dump()})
                found = judge(dnr, held_out)
            yield {"seconds": round(spent), "step": step, "loss": total / max(count, 1), **found}
            total, count, clock = 0.0, 0, time.monotonic()


def _checksum(model: DNR) -> str:
    found = hashlib.sha256()
    for name, weights in sorted(model.state_dict().items()):
        found.update(name.encode())
        found.update(weights.detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()


def photometric(rgb: Tensor, batch: Batch) -> Tensor:
    """Mean absolute error, of each picture over its base image's: one that is good already counts as much as a poor
    one, as in decibels."""
    assert batch.target is not None
    error = (rgb - batch.target).abs().mean(dim=(1, 2, 3))
    start = (base_picture(batch) - batch.target).abs().mean(dim=(1, 2, 3))
    return (error * TYPICAL / (start + LEAST)).mean()


def disturbed(batch: Batch, random: np.random.Generator) -> Batch:
    """One of the symmetries of the square, another order of colours, another level of light."""
    batch = batch.augment(int(random.integers(DIHEDRAL_ORDER)))
    order = torch.as_tensor(random.permutation(3))
    gain = float(2.0 ** random.uniform(-STOPS, STOPS))
    linear, display = batch.target, batch.display
    assert linear is not None and display is not None and batch.base is not None and batch.noise is not None
    assert batch.diffuse is not None and batch.albedo is not None and batch.fresh is not None
    linear = torch.cat([linear[:, order] * gain, linear[:, 3:]], dim=1)
    return replace(
        batch,
        base=batch.base[:, order] * gain,
        fresh=batch.fresh[:, order] * gain,
        diffuse=batch.diffuse[:, order] * gain,
        albedo=batch.albedo[:, order],
        noise=batch.noise * gain,
        target=display.over_white(linear[:, :3], linear[:, 3:]),
    )


@torch.no_grad()
def judge(dnr: DNR, scenes: list[SceneMaps]) -> dict[str, Any]:
    """Mean PSNR over white of base images and of their corrections, by kind of base image and by scene."""
    dnr.eval()
    rows: list[tuple[int, str, float, float]] = []
    for scene in scenes:
        for view in range(len(scene.scene.views)):
            for chosen in scene.scene.inputs:
                batch = scene.batch(view, chosen)
                display, linear = batch.display, batch.target
                assert display is not None and linear is not None
                target = display.over_white(linear[:, :3], linear[:, 3:])
                both = [float(psnr(p.clamp(0, 1), target)) for p in (base_picture(batch), dnr(batch).rgb)]
                rows.append((scene.scene.seed, chosen, both[0], both[1]))
    dnr.train()
    mean = lambda chosen: [round(float(np.mean([r[i] for r in chosen])), 3) for i in (2, 3)]  # noqa: E731
    by_input = {k: mean([r for r in rows if r[1] == k]) for k in sorted({r[1] for r in rows})}
    by_scene = {s: mean([r for r in rows if r[0] == s]) for s in sorted({r[0] for r in rows})}
    return {"psnr": mean(rows), "by_input": by_input, "by_scene": by_scene}

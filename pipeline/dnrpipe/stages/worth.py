"""How many views are worth their seconds (``--budget auto``): training is tried on a few small traced views first.

Notation
    g      dB that training on two small views gains over the shipped corrector on two others; the views change places
    M      views
    G(M)   dB that training on M views is expected to gain: g (M / 2)^GROWTH
    c      seconds of a view: its ray tracing, and its share of the training
    w      dB that a second is worth (``select.worth`` / 60)

A view is traced as long as it gains more than it costs: G'(M) > w c. GROWTH is from three
scenes (docs/experiments.md).
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel

from ..core.errors import UserError
from ..core.settings import MOST_VIEWS
from ..workers.view_tasks import worker_count
from .stage import Run
from .trainer import load, perceptual_weights, torch_device, trained_pixels
from .trust import SPLIT, SPP, best_share, mean_psnr, traced_small

if TYPE_CHECKING:
    from dnrtrain.dataset import ViewSet
    from dnrtrain.model import DNR

GROWTH = 0.42
EPOCHS = 20
"""Of a trial."""


class Worth(BaseModel, frozen=True):
    """gain: g. seconds: c. views: how many are worth it. expected: G of them."""

    gain: float
    seconds: float
    views: int
    expected: float

    @property
    def told(self) -> str:
        """One line for the user."""
        tried = f"training on two small views gains {self.gain:+.2f} dB on two others"
        if not self.views:
            return f"{tried}: not worth {self.seconds:.1f} s a view; the shipped corrector renders as it is"
        return f"{tried}: {self.views} views, {self.seconds:.1f} s each, are worth it (about {self.expected:+.1f} dB)"


def worth(run: Run, candidates: int) -> Worth:
    """Try it, and decide. At most MOST_VIEWS, and all candidates. Raises UserError: there is but one."""
    from dnrtrain.shipped import corrector

    if candidates < 2:
        raise UserError("--budget auto: one candidate view is too few to try it; name a number of views")
    settings = run.settings
    small = traced_small(run)
    halves = [range(first, len(small), 2) for first in range(2)]
    views, noisy = (load(run.workspace, small, SPLIT, raytraced=True, raw=raw, base="baked") for raw in (False, True))
    started, cpu = time.monotonic(), time.process_time()
    with run.console.bar("what training gains", len(halves)) as bar:
        found = []
        for train, test in (halves, halves[::-1]):
            before = corrector()
            best_share(before, noisy.subset(train), views.subset(train))
            found.append(trial(run, before, views.subset(train), views.subset(test)))
            bar.advance()
    spent = time.monotonic() - started
    run.book("training", "scene", "trial of training", spent, cpu_seconds=time.process_time() - cpu, device="cpu")
    gain, step = (float(np.mean([one[k] for one in found])) for k in range(2))
    cameras, (width, height) = settings.cameras, views.size
    traced = [r.seconds for r in run.workspace.ledger.read() if r.name.startswith(f"{SPLIT}/") and not r.cache_hit]
    scale = cameras.width * cameras.height * settings.raytrace.spp / (width * height * SPP)
    tracing = min(traced, default=0.0) * scale / worker_count(settings.raytrace.workers)  # the others compiled kernels
    pixels = trained_pixels(settings, cameras.width, cameras.height) / trained_pixels(settings, width, height)
    seconds = tracing + settings.finetune.step2.epochs * step * pixels
    count = views_worth(gain, seconds, settings.select.worth / 60, min(candidates, MOST_VIEWS))
    return Worth(gain=gain, seconds=seconds, views=count, expected=expected_gain(gain, count))


def trial(run: Run, before: DNR, training: ViewSet, held_out: ViewSet) -> tuple[float, float]:
    """(dB gained over the shipped corrector, as far as it is trusted, on the held-out views, seconds of an optimiser
    step)."""
    from dnrtrain.checkpoint import finished_record, load_model, step_seconds
    from dnrtrain.step2 import run_step2

    settings = run.settings
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        events = run_step2(
            training,
            None,
            folder,
            run.effect_plan.model(settings.model),
            settings.finetune.step2.model_copy(update={"epochs": EPOCHS, "start": "pretrained"}),
            seed=settings.finetune.seed,
            device=torch_device(settings),
            checkpoints=folder,
            fingerprint="trial",
            weights=perceptual_weights(None),
        )
        for _ in events:
            pass
        step, _ = step_seconds(finished_record(folder))
        after = load_model(folder).cpu()
        return mean_psnr(after, held_out)[1] - mean_psnr(before, held_out)[1], step


def expected_gain(gain: float, views: int) -> float:
    """G(M), dB; 0 without views."""
    return gain * (views / 2) ** GROWTH if views else 0.0


def views_worth(gain: float, seconds: float, price: float, most: int) -> int:
    """The M with the largest G(M) - w c M, from 0 to ``most``. gain: g. seconds: c. price: w."""
    if gain <= 0:
        return 0
    left = [expected_gain(gain, count) - price * seconds * count for count in range(most + 1)]
    return int(np.argmax(left))

"""One view, rendered now and then while step 2 trains: for people to look at, never for a decision.

It changes no bit of the trained weights: it draws no random numbers, and it restores the network's weights and mode.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

from .dataset import ViewSet
from .events import EpochEnd, Previewed
from .metrics import psnr
from .model import DNR, render_views
from .schedule import Averaged, averaged_weights

SHARE = 0.03
"""Of the training time, at most, goes into pictures between the first and the last one."""


class Preview:
    """Decides after which epochs a picture is due: the first of this process, the last, and between them after
    ``seconds`` of training, or more where pictures would take more than SHARE of the time.

    views: exactly one, with a target where its PSNR is wanted.
    """

    def __init__(self, views: ViewSet, seconds: float) -> None:
        if len(views) != 1:
            raise ValueError(f"a preview shows one view, not {len(views)}")
        if not seconds > 0:
            raise ValueError(f"seconds between previews must be above 0, got {seconds}")
        self.views, self.pause = views, seconds
        self.trained: float | None = None  # seconds since the last picture; None before the first

    def after(self, epoch: EpochEnd, model: DNR, average: Averaged | None) -> Iterator[Previewed]:
        """A picture if one is due. What the caller does with it counts as its cost: the generator waits for that."""
        if self.trained is not None:
            self.trained += epoch.seconds
            if self.trained < self.pause and epoch.epoch < epoch.epochs:
                return
        started = time.monotonic()
        training = model.training
        model.eval()
        try:
            with averaged_weights(model, average):
                picture = render_views(model, self.views)
        finally:
            model.train(training)
        target = self.views.tensors.target
        score = None if target is None else float(psnr(picture, target.cpu().float()).mean())
        yield Previewed(
            epoch.stage,
            epoch.epoch,
            epoch.epochs,
            self.views.names[0],
            picture[0].permute(1, 2, 0).contiguous().numpy(),
            score,
            time.monotonic() - started,
            epoch.device,
        )
        self.trained, self.pause = 0.0, max(self.pause, (time.monotonic() - started) / SHARE)

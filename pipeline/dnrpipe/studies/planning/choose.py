"""The views, samples and steps that a budget of time or a wanted PSNR calls for: a grid is looked at whole."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

from ..cells.request import epochs_of
from .quality import Quality
from .records import Choice, Interval, Pilot, Prediction, Seconds
from .seconds import TIME_SPREAD, Costs, noise_at

VIEWS = (4, 6, 8, 10, 12, 16, 20, 25, 32, 40, 50, 65, 80, 100, 150, 200)
SAMPLES = (4, 8, 16, 32, 64, 128, 256, 512, 1024)
STEPS = tuple(round(50 * 1.2**n) for n in range(30))
"""50 to 9,900: so dense that a budget of time is filled."""
NEAR = 0.02
"""dB within which two choices count as equally good: the cheaper one is taken."""


@dataclass(frozen=True)
class Predictor:
    """Costs, by either clock, and quality of any choice. batch: views a step."""

    pilot: Pilot
    wall: Costs
    processor: Costs
    quality: Quality
    batch: int

    def choice(self, views: int, spp: int, steps: int) -> Choice:
        """The choice of about so many steps: whole passes over the views, one at least."""
        epochs = epochs_of(steps, views, self.batch)
        return Choice(views=views, spp=spp, epochs=epochs, steps=epochs * math.ceil(views / self.batch))

    def predict(self, choice: Choice) -> Prediction:
        """What the choice is expected to cost and give."""
        assert self.pilot.trace is not None
        views, steps, epochs = choice.views, choice.steps, choice.epochs
        stages = {
            "select": self.wall.select(),
            "raytrace": self.wall.raytrace(views, choice.spp),
            "finetune": self.wall.finetune(steps, epochs),
        }
        total = sum(stages.values())
        within = Interval(expected=total, low=total / TIME_SPREAD, high=total * TIME_SPREAD)
        return Prediction(
            choice=choice,
            seconds=Seconds(**stages, evaluate=self.wall.evaluate(), total=within),
            cpu_seconds=self.processor.select()
            + self.processor.raytrace(views, choice.spp)
            + self.processor.finetune(steps, epochs),
            psnr=self.quality.predict(views, steps, noise_at(self.pilot.trace, choice.spp)),
        )

    def grid(self, candidates: int) -> Iterator[Prediction]:
        """All choices with at most ``candidates`` views."""
        views = sorted({*(n for n in VIEWS if n <= candidates), candidates})
        for wanted in itertools.product(views, SAMPLES, STEPS):
            yield self.predict(self.choice(*wanted))


def best_within(grid: list[Prediction], seconds: float) -> Prediction | None:
    """The highest expected PSNR within ``seconds`` of expected time; None where nothing is so fast."""
    within = [p for p in grid if p.seconds.total.expected <= seconds]
    return cheapest_of_the_best(within) if within else None


def cheapest_of_the_best(found: list[Prediction]) -> Prediction:
    """Of those whose expected PSNR is as good as the highest, within ``NEAR``, the one of the least expected time."""
    top = max(p.psnr.expected for p in found)
    return min((p for p in found if p.psnr.expected >= top - NEAR), key=lambda p: p.seconds.total.expected)


def cheapest_reaching(grid: list[Prediction], psnr: float) -> Prediction | None:
    """The least expected time whose expected PSNR is at least ``psnr``; None where nothing reaches it."""
    enough = [p for p in grid if p.psnr.expected >= psnr]
    return min(enough, key=lambda p: p.seconds.total.expected) if enough else None


def budgets(grid: list[Prediction]) -> list[Prediction]:
    """The best choice within each of a row of budgets, from the cheapest choice on, each twice the one before.

    Ends where more time buys less than a tenth of a decibel.
    """
    limit = min(p.seconds.total.expected for p in grid) * 1.01
    rows: list[Prediction] = []
    while len(rows) < 12:
        found = best_within(grid, limit)
        assert found is not None  # the cheapest choice fits
        if rows and found.psnr.expected < rows[-1].psnr.expected + 0.1:
            break
        rows.append(found)
        limit = max(limit, found.seconds.total.expected) * 2
    return rows

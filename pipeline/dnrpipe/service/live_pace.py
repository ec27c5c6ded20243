"""Adapts resolution and samples to measured frame times while the camera moves.

level    share of the side, rays per pixel of the base image (None: the model's own)
budget   milliseconds that a frame may take
"""

from __future__ import annotations

from dataclasses import dataclass, field

BUDGET = 90.0
LEVELS: tuple[tuple[float, int | None], ...] = ((1.0, None), (1.0, 2), (1.0, 1), (0.5, 2), (0.5, 1))
START = 2
STEP = 32
"""Sides are multiples of this: the U-Net halves them."""
SMOOTHING = 0.3
SLACK = 0.45
"""Below this share of the budget the pace tries a finer level, which costs about twice as much."""
MIN_FRAMES = 8
"""Frames at a level before it may change."""


@dataclass
class Pace:
    """Chooses a level by frame times. The first frame at a level compiles its kernels and does not count."""

    budget: float = BUDGET
    level: int = START
    _mean: float | None = None
    _frames: int = 0
    _known: set[tuple[int, int]] = field(default_factory=set)

    def pick(self, size: int) -> tuple[int, int | None]:
        """(side in pixels, samples) of the next moving frame, of a view of ``size``² at rest."""
        share, samples = LEVELS[self.level]
        return size if share == 1 else max(2 * STEP, round(share * size / STEP) * STEP), samples

    def record(self, size: int, milliseconds: float) -> None:
        """Record the time of a moving frame of a view of `size`²; change the level where that calls for it."""
        if (self.level, size) not in self._known:
            self._known.add((self.level, size))
            return
        mean = self._mean
        self._mean = milliseconds if mean is None else mean + SMOOTHING * (milliseconds - mean)
        self._frames += 1
        if self._frames < MIN_FRAMES:
            return
        if self._mean > self.budget and self.level + 1 < len(LEVELS):
            self._move(1)
        elif self._mean < SLACK * self.budget and self.level > 0:
            self._move(-1)

    def _move(self, step: int) -> None:
        self.level += step
        self._mean, self._frames = None, 0

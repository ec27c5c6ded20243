"""What is unsure in a view's pixels, summed up over pieces of surface seen from about one direction.

A piece is a cell of the atlas (`dnrtrain.selector.visibility`) from one of the bins of directions. Two pictures of one
piece tell about the same: that is how policies that look at pixels keep from choosing alike views.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dnrtrain.dataset import ViewSet
from dnrtrain.model import DNR
from dnrtrain.selector.geometry import BINS, direction_bins
from dnrtrain.selector.visibility import GRID

COUNT = GRID * GRID * BINS


@dataclass(frozen=True)
class Pieces:
    """What one view sees: E pieces, ascending.

    keys    int64 [E] cell · BINS + bin of direction
    pixels  float64 [E] pixels that show it, as a share of the view's pixels
    unsure  float64 [E] what is unsure in these pixels, summed up, over the view's pixels
    """

    keys: np.ndarray
    pixels: np.ndarray
    unsure: np.ndarray


def cells_of(views: ViewSet, view: int) -> np.ndarray:
    """Cell of each pixel inside the view's mask, in the order of its rows: int64 [P]."""
    maps = views.batch([view])
    inside = maps.mask[0, 0].cpu().numpy() > 0.5
    u, v = (0.5 * maps.uv[0, k].cpu().numpy()[inside] + 0.5 for k in range(2))
    column, row = (np.clip((value * GRID).astype(np.int64), 0, GRID - 1) for value in (u, v))
    return row * GRID + column


def pieces_of(views: ViewSet, view: int, unsure: np.ndarray) -> Pieces:
    """The view's pieces. unsure: [P], of each pixel inside its mask."""
    maps = views.batch([view])
    inside = maps.mask[0, 0].cpu().numpy() > 0.5
    view_directions = maps.view_dir[0].cpu().numpy()[:, inside]
    bins = (direction_bins() @ view_directions).argmax(axis=0)
    keys, place = np.unique(cells_of(views, view) * BINS + bins, return_inverse=True)
    share = 1.0 / inside.size
    return Pieces(
        keys,
        np.bincount(place, minlength=len(keys)) * share,
        np.bincount(place, np.asarray(unsure, np.float64), len(keys)) * share,
    )


def seen_cells(views: ViewSet, some: Iterable[int]) -> np.ndarray:
    """Which cells any of ``some`` sees: bool [GRID²]."""
    seen = np.zeros(GRID * GRID, bool)
    for view in some:
        seen[cells_of(views, view)] = True
    return seen


class Observed(ABC):
    """How often the views taken so far show each piece; 1 is a view of it with the mean number of pixels."""

    def __init__(self, table: list[Pieces]) -> None:
        pixels, number = np.zeros(COUNT), np.zeros(COUNT)
        for one in table:
            pixels[one.keys] += one.pixels
            number[one.keys] += 1.0
        self.usual = np.where(number > 0, pixels / np.maximum(number, 1.0), 1.0)
        self.observed = np.zeros(COUNT)

    def observations(self, pieces: Pieces) -> np.ndarray:
        """Of one view: [E]."""
        return pieces.pixels / self.usual[pieces.keys]

    def take(self, pieces: Pieces) -> None:
        self.observed[pieces.keys] += self.observations(pieces)

    @abstractmethod
    def gain(self, pieces: Pieces) -> float:
        """What taking a view would add."""


class Doubt(ABC):
    """What is unsure in the pixels of all views, by renderers that were trained on the views ``kept``.

    BATCH: what one more view would make of it. MODELS: how many renderers it takes, None: `ActiveSettings.members`.
    """

    MEASURE: ClassVar[str]
    WORD: ClassVar[str]
    BATCH: ClassVar[type[Observed]]
    MODELS: ClassVar[int | None] = None

    def __init__(self, models: list[DNR], views: ViewSet, kept: list[int], seed: int) -> None:
        self.models, self.views, self.seen = models, views, seen_cells(views, kept)
        self.pixels, self.variance, self.unseen = 0, 0.0, 0

    @abstractmethod
    def unsure(self, view: int) -> np.ndarray:
        """Of each pixel inside the view's mask, [P]; counts them."""

    @abstractmethod
    def facts(self) -> dict[str, float]:
        """Means over the pixels that were counted."""

    def unseen_pixels(self, view: int) -> np.ndarray:
        """Whether each pixel shows surface that no view of the training sees, bool [P]; counts them."""
        unseen = ~self.seen[cells_of(self.views, view)]
        self.pixels += len(unseen)
        self.unseen += int(unseen.sum())
        return unseen

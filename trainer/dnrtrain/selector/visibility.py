"""What each candidate sees of the surface, from its G-buffer: sparse, made view by view.

The surface is the scene's atlas, cut into a grid of cells. What a view sees of a cell is how many of its pixels
fall there and their mean view direction. A cell covers a fixed piece of surface, so pixels per cell are
the resolution at which the view samples it: near, facing, unoccluded views have many.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..contract import ContractError, View, require_channels
from ..exr import read_exr

if TYPE_CHECKING:
    from ..dataset import ViewSet

GRID = 64
"""Cells per side of the atlas."""
LOOK_SIDE = 256
"""Of larger images every k-th pixel is looked at, so that about this many a side remain (256 to 511)."""
CHANNELS = ("uv.U", "uv.V", "mask")


@dataclass(frozen=True)
class SurfaceVisibility:
    """What N views see: a table of E entries, those of view i at ``start[i]:start[i + 1]``; cells ascend within a view.

    grid             cells per side of the atlas; cell = row · grid + column, column by U and row by V
    start            int64 [N + 1]
    cells            int32 [E]
    pixels           float32 [E] pixels that fall on the cell, as a share of the view's pixels
    view_directions  float32 [E, 3] unit world-space direction from the surface to the camera, mean over those pixels
    seen             float32 [N] share of the view's pixels that hit a surface
    pictures         uint64 [N] hash of what is seen in which pixel: equal for duplicates
    """

    grid: int
    start: np.ndarray
    cells: np.ndarray
    pixels: np.ndarray
    view_directions: np.ndarray
    seen: np.ndarray
    pictures: np.ndarray

    def __len__(self) -> int:
        return len(self.seen)

    def of(self, view: int) -> slice:
        """Where the view's cells lie."""
        return slice(int(self.start[view]), int(self.start[view + 1]))

    def take(self, order: np.ndarray) -> SurfaceVisibility:
        """The views at ``order``, in that order."""
        counts = np.diff(self.start)[order]
        start = np.concatenate([[0], np.cumsum(counts)])
        where = np.arange(start[-1]) + np.repeat(self.start[:-1][order] - start[:-1], counts)
        return SurfaceVisibility(
            self.grid,
            start,
            self.cells[where],
            self.pixels[where],
            self.view_directions[where],
            self.seen[order],
            self.pictures[order],
        )


def read_visibility(
    files: Sequence[Path], views: Sequence[View], *, grid: int = GRID, tick: Callable[[], None] | None = None
) -> SurfaceVisibility:
    """Look at the pass files of ``views``, one file in memory at a time. ``tick`` is called after each.

    Raises ContractError: counts differ, or a file is missing, damaged, of another size, or lacks channels.
    """

    def look() -> Iterable[SurfaceVisibility]:
        for file, view in zip(files, views, strict=True):
            channels, _ = read_exr(file)
            require_channels(file, channels, CHANNELS)
            if channels["mask"].shape != (view.height, view.width):
                height, width = channels["mask"].shape
                raise ContractError(
                    f"{file}: is {width}x{height}, its camera {view.width}x{view.height}; delete it and run the stage"
                    " again"
                )
            yield look_at(channels, view, grid)
            if tick is not None:
                tick()

    if len(files) != len(views):
        raise ContractError(f"{len(views)} cameras, {len(files)} pass files: must agree")
    return collect(look(), grid)


def collect(looks: Iterable[SurfaceVisibility], grid: int = GRID) -> SurfaceVisibility:
    """Views one after the other as one table."""
    nothing = (np.zeros(0, np.int32), np.zeros(0, np.float32), np.zeros((0, 3), np.float32))
    every = [SurfaceVisibility(grid, np.zeros(1, np.int64), *nothing, np.zeros(0, np.float32), np.zeros(0, np.uint64))]
    every += looks
    columns = ("cells", "pixels", "view_directions", "seen", "pictures")
    start = np.cumsum([0, *(len(one.cells) for one in every[1:])], dtype=np.int64)
    return SurfaceVisibility(grid, start, *(np.concatenate([getattr(one, name) for one in every]) for name in columns))


def look_at(channels: dict[str, np.ndarray], view: View, grid: int = GRID) -> SurfaceVisibility:
    """What one view sees. channels: those of its pass file, [H, W] each."""
    return _look(channels, -view.ray_directions(), grid)


def visibility_of(views: ViewSet, grid: int = GRID) -> SurfaceVisibility:
    """What views in memory see."""
    maps = views.tensors
    u, v = (0.5 * maps.uv[:, k].cpu().numpy() + 0.5 for k in range(2))
    mask, view_directions = maps.mask[:, 0].cpu().numpy(), maps.view_dir.permute(0, 2, 3, 1).cpu().numpy()
    return collect(
        (_look({"uv.U": u[i], "uv.V": v[i], "mask": mask[i]}, view_directions[i], grid) for i in range(len(views))),
        grid,
    )


def _look(channels: dict[str, np.ndarray], view_directions: np.ndarray, grid: int) -> SurfaceVisibility:
    """What one view sees. view_directions: unit vectors from the surface to the camera, world space, [H, W, 3]."""
    height, width = channels["mask"].shape
    step = max(1, min(height, width) // LOOK_SIDE)
    part = (slice(step // 2, None, step), slice(step // 2, None, step))
    mask = channels["mask"][part] > 0.5
    u, v = (channels[name][part][mask] for name in ("uv.U", "uv.V"))
    column, row = (np.clip((value * grid).astype(np.int32), 0, grid - 1) for value in (u, v))
    cells, place = np.unique(row * grid + column, return_inverse=True)
    view_directions = view_directions[part][mask]
    sums = np.stack([np.bincount(place, view_directions[:, k], len(cells)) for k in range(3)], axis=1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    counts = np.bincount(place, minlength=len(cells))
    digest = hashlib.blake2b(np.packbits(mask).tobytes(), digest_size=8)
    digest.update(np.stack([u, v]).tobytes())
    return SurfaceVisibility(
        grid,
        np.array([0, len(cells)], np.int64),
        cells.astype(np.int32),
        (counts / mask.size).astype(np.float32),
        (sums / np.maximum(length, 1e-12)).astype(np.float32),
        np.array([mask.mean()], np.float32),
        np.frombuffer(digest.digest(), "<u8"),
    )

"""Where a renderer trained on the views traced so far is still likely to be wrong: error per cell of the surface.

What is known before any training is the base image (nothing, where there is none) and, from the traced views, by how
much it is wrong in each cell. A neural texture learns what is wrong alike from everywhere, so each view's residual is
judged against the mean residual of the *other* traced views in that cell: what is left over is view-dependent, finer
than a cell, or seen once only. It is measured on traced training views alone.

Notation
    r    residual of a pixel: display RGB over white, ray-traced minus base image
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..contract import ContractError
from ..dataset import ViewSet
from ..model import compose
from .demand import Demand
from .sightings import GRID

TRUST = 4.0
"""κ: other views' mean residual counts as if κ pixels of residual 0 were among theirs; cells' errors likewise."""


@dataclass(frozen=True)
class CellErrors:
    """Mean squared error that is expected of each cell, display RGB over white.

    grid    cells per side of the atlas
    mean    over all pixels looked at
    cells   float64 [grid²], shrunk towards ``mean`` where few pixels were looked at
    """

    grid: int
    mean: float
    cells: np.ndarray

    def relative(self, cells: np.ndarray) -> np.ndarray:
        """Error of ``cells`` [D] over the mean error, float32; 1 everywhere where nothing is wrong."""
        if self.mean <= 0.0:
            return np.ones(len(cells), np.float32)
        return (self.cells[cells] / self.mean).astype(np.float32)

    def reweighted(self, demand: Demand) -> Demand:
        """The demand, its pixels weighted by how wrong they are; sums to 1 again."""
        weights = demand.weights * self.relative(demand.cells)
        return Demand(demand.cells, demand.toward, demand.pixels, (weights / weights.sum()).astype(np.float32))


def residuals(views: ViewSet) -> np.ndarray:
    """r of every pixel, float32 [N, H, W, 3]. Raises ContractError: no ray-traced targets."""
    tensors = views.tensors
    if tensors.target is None:
        raise ContractError("errors are measured on ray-traced views, but these were loaded without targets")
    target = tensors.target
    if tensors.base is not None and tensors.display is not None:
        target = target - compose(tensors.display(tensors.base), tensors.coverage).clamp(0.0, 1.0)
    return target.permute(0, 2, 3, 1).cpu().numpy()


def cells_of(views: ViewSet, grid: int = GRID) -> np.ndarray:
    """The cell of every pixel, int64 [N, H, W]; −1 where it hits nothing. Cells as in :mod:`.sightings`."""
    place = np.clip(((views.uv.cpu().numpy() + 1.0) * (0.5 * grid)).astype(np.int64), 0, grid - 1)
    return np.where(views.mask[:, 0].cpu().numpy() > 0.5, place[:, 1] * grid + place[:, 0], -1)


def cell_errors(views: ViewSet, grid: int = GRID) -> CellErrors:
    """Errors expected after training on ``views``, which have ray-traced targets."""
    wrong, cells, size = residuals(views), cells_of(views, grid), grid**2
    count = np.zeros((len(views), size))
    sums = np.zeros((len(views), size, 3))
    for view in range(len(views)):
        hit = cells[view] >= 0
        count[view] = np.bincount(cells[view][hit], minlength=size)
        for channel in range(3):
            sums[view, :, channel] = np.bincount(cells[view][hit], wrong[view][hit][:, channel], size)
    others = (sums.sum(axis=0) - sums) / (count.sum(axis=0) - count + TRUST)[..., None]
    energy = np.zeros(size)
    for view in range(len(views)):
        hit = cells[view] >= 0
        left = np.square(wrong[view][hit] - others[view][cells[view][hit]]).mean(axis=-1)
        energy += np.bincount(cells[view][hit], left, size)
    total = count.sum(axis=0)
    mean = float(energy.sum() / total.sum()) if total.sum() else 0.0
    return CellErrors(grid, mean, (energy + TRUST * mean) / (total + TRUST))

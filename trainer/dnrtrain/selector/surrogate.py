"""A cheap, exact stand-in for training a neural texture: what a chosen set of rasterised views would teach.

A deferred neural texture meets the 9 real spherical harmonics of the view direction (Thies et al. 2019). Take a cell of
the atlas for a texel and a linear renderer: its colour is h(direction)ᵀ w, and training on the chosen views is ridge
regression of their mean colours there on h. Both the weights and the error on *all* candidates have closed forms, and a
view changes only the cells that it sees.

Notation
    h     [9] harmonics of bands 0-2 at the direction from the surface to the camera
    p, y  pixels and mean display colour of a sighting
    A     [9, 9] λ I + Σ p h hᵀ over chosen sightings of a cell; w = A⁻¹ Σ p h y, y less the mean of all candidates
"""

from __future__ import annotations

import numpy as np

from ..contract import ContractError
from .doptimal import HARMONICS, harmonics
from .sightings import Sightings

RIDGE = 0.3
"""λ in median sightings, for bands 1 and 2; band 0, the mean colour of a cell, has a tenth of it."""


class Surrogate:
    """The state of one training: chosen views, their fit, its squared error on all candidates.

    errors: float64 [N], mean squared error per pixel of each candidate (over its pixels on the surface). error: its
    mean, views counted by ``shares`` [N] (summing to 1; default alike). Raises ContractError: no sightings.
    """

    def __init__(self, sightings: Sightings, shares: np.ndarray | None = None) -> None:
        if not len(sightings.cells):
            raise ContractError("no candidate sees anything: there is nothing to fit")
        self.sightings = sightings
        count = len(sightings)
        self.shares = np.full(count, 1.0 / count) if shares is None else np.asarray(shares, np.float64)
        self.view = np.repeat(np.arange(count), np.diff(sightings.start))
        known, self.place = np.unique(sightings.cells, return_inverse=True)
        self.cells = len(known)
        self.basis = harmonics(sightings.toward).astype(np.float64)
        self.pixels = (sightings.pixels / np.median(sightings.pixels)).astype(np.float64)
        mean = (sightings.pixels @ sightings.colours) / sightings.pixels.sum()
        self.colours = (sightings.colours - mean).astype(np.float64)
        # Weight of a sighting in the error: its pixels' share of its view, times what the view counts.
        seen = np.bincount(self.view, self.pixels, count)
        self.part = self.pixels / np.maximum(seen, 1e-12)[self.view]
        self.order = np.argsort(self.place, kind="stable")
        self.bounds = np.searchsorted(self.place[self.order], np.arange(self.cells + 1))
        self.reset()

    def reset(self) -> None:
        """Nothing chosen."""
        prior = np.full(HARMONICS, 1.0 / RIDGE)
        prior[0] *= 10.0
        self.inverse = np.broadcast_to(np.diag(prior), (self.cells, HARMONICS, HARMONICS)).copy()
        self.sums = np.zeros((self.cells, HARMONICS, 3))
        self.residual = np.square(self.colours).mean(axis=1)
        self.chosen: list[int] = []
        self._total()

    @property
    def error(self) -> float:
        """Mean squared error on all candidates."""
        return self._error

    @property
    def errors(self) -> np.ndarray:
        """Mean squared error of each candidate."""
        return np.bincount(self.view, self.residual * self.part, len(self.sightings))

    def add(self, view: int) -> float:
        """Train on one more view; returns by how much the error on all candidates falls (below 0 where it grows)."""
        self.chosen.append(view)
        return self._change(view, 1.0)

    def remove(self, view: int) -> float:
        """Forget a chosen view; returns by how much the error falls."""
        self.chosen.remove(view)
        return self._change(view, -1.0)

    def _change(self, view: int, sign: float) -> float:
        before = self._error
        inverse, sums, rows, residual = self._after(view, sign)
        where = self.place[self.sightings.of(view)]
        self.inverse[where], self.sums[where] = inverse, sums
        self.residual[rows] = residual
        self._total()
        return before - self._error

    def gain(self, view: int) -> float:
        """What :meth:`add` would return."""
        _, _, rows, residual = self._after(view)
        return float((self.residual[rows] - residual) @ self.weights[rows])

    @property
    def weights(self) -> np.ndarray:
        """Of the sightings in :attr:`error`, [E]."""
        return self.part * self.shares[self.view]

    def run(self, views: list[int]) -> float:
        """The error after training on ``views``; order does not matter."""
        self.reset()
        for view in views:
            self.add(view)
        return self._error

    def _total(self) -> None:
        self._error = float(self.residual @ self.weights)

    def _after(self, view: int, sign: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(A⁻¹ and sums of the cells that the view sees, sightings in those cells, their squared residuals)."""
        part = self.sightings.of(view)
        where, h, p = self.place[part], self.basis[part], sign * self.pixels[part]
        inverse = self.inverse[where]
        solved = np.einsum("eij,ej->ei", inverse, h)
        scale = p / (1.0 + p * np.einsum("ei,ei->e", h, solved))
        inverse = inverse - scale[:, None, None] * solved[:, :, None] * solved[:, None, :]  # Sherman-Morrison
        sums = self.sums[where] + (p[:, None] * h)[:, :, None] * self.colours[part][:, None, :]
        fit = np.matmul(inverse, sums)
        counts = self.bounds[where + 1] - self.bounds[where]
        first = np.repeat(self.bounds[where] - np.concatenate([[0], np.cumsum(counts)[:-1]]), counts)
        rows = self.order[np.arange(counts.sum()) + first]
        mine = np.repeat(np.arange(len(where)), counts)
        wrong = np.einsum("ei,eik->ek", self.basis[rows], fit[mine]) - self.colours[rows]
        return inverse, sums, rows, np.square(wrong).mean(axis=1)

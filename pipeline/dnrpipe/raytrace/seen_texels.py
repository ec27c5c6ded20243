"""Which parts of the scene's atlas views look at: at once, in mirrors, and through glass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dnrtrain.contract import View

from ..core.cameras import scaled_to
from .base_renderer import BaseRenderer
from .denoise import beside

CELLS = 256
"""Of the atlas' side: fine enough to tell its charts apart, and large enough that small pictures leave no gaps."""
SIDE = 512
"""Pixels of the pictures' longer side."""


def pixels_of_cells(mi: Any, scene: Any, views: Sequence[View], unit_scale: float) -> np.ndarray:
    """Pixels that see a cell of the atlas or one beside it, float32 [CELLS, CELLS], row 0 at V = 0.

    views: in scene units; unit_scale: the bundle's units per scene unit. One path a pixel says what mirrors and glass
    show: other paths in each view.
    """
    renderer = BaseRenderer(mi, scene, np.zeros((2, 2, 2, 2, 3), np.float32), gloss=False, unit_scale=unit_scale)
    cells = np.zeros((CELLS, CELLS), np.float32)
    for number, view in enumerate(views):
        channels = renderer.frame(scaled_to(view, SIDE), 1, number)
        for mask, *place in (("mask", "uv.U", "uv.V"), ("chain.mask", "chain.U", "chain.V")):
            hit = channels[mask] > 0.5
            column, row = ((channels[name][hit] * CELLS).astype(int).clip(0, CELLS - 1) for name in place)
            np.add.at(cells, (row, column), 1)
    return beside(cells[..., None])[..., 0]

"""Maps on the atlas: which surface the chosen views see, and at what angle to the other views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from dnrtrain.contract import ContractError, View
from dnrtrain.selector.explain import NOT_SEEN, nearest_cosines
from dnrtrain.selector.visibility import SurfaceVisibility, read_visibility

from .data import CoverageMaps, Picture
from .pictures import encode

LOOKED_AT = 100
"""How many candidates are read at most, beside the chosen ones, evenly over their list."""
SIDE = 256
FARTHEST = 45.0
"""Degrees at which the scale of angles ends."""
UNSEEN = (214, 69, 65)
"""RGB of surface that candidates see and no chosen view does; not in the colour maps."""


def coverage_maps(root: Path, candidates: Sequence[View], chosen: Sequence[str]) -> CoverageMaps | None:
    """Read G-buffers of the chosen views and of up to LOOKED_AT other candidates -> two maps of the atlas.

    None if passes are missing (deleted, or not yet prepared again) or the views see nothing.
    """
    others = {view.name: view for view in candidates}
    if not others.keys() >= set(chosen):
        return None  # the cameras are newer than the choice
    picked = [others.pop(name) for name in chosen]
    step = max(1, -(-len(others) // LOOKED_AT))
    views = [*picked, *list(others.values())[::step]]
    try:
        visibility = read_visibility([root / "passes" / "train" / f"{view.name}.exr" for view in views], views)
    except ContractError:
        return None
    if not len(visibility.cells):
        return None
    seen, angle, uncovered = _cells(visibility, len(chosen))
    there = seen >= 0
    counted = angle[there & (seen > 0)]
    return CoverageMaps(
        seen=_picture(seen / max(1, seen.max()), there, seen == 0, "how many chosen views see it"),
        angle=_picture(1.0 - np.minimum(angle, FARTHEST) / FARTHEST, there, seen == 0, "degrees off"),
        most=int(seen.max()),
        farthest=FARTHEST,
        uncovered=uncovered,
        mean_angle=float(counted.mean()) if len(counted) else None,
        views_read=len(views),
        candidates=len(candidates),
    )


def _cells(visibility: SurfaceVisibility, chosen: int) -> tuple[np.ndarray, np.ndarray, float]:
    """The first ``chosen`` views are the chosen ones.

    Returns (chosen views that see each cell, −1 where nobody does, [G, G]; mean angle in degrees, by pixels, from the
    views' direction to the nearest chosen view direction [G, G]; share of all pixels whose cell no chosen view sees).
    """
    grid = visibility.grid
    size = grid * grid
    number = np.full(size, -1, np.int64)
    number[visibility.cells] = 0
    of_chosen = visibility.cells[: visibility.start[chosen]]
    number += np.bincount(of_chosen, minlength=size)
    nearest = np.full(len(visibility.cells), NOT_SEEN, np.float32)
    for nearest in nearest_cosines(visibility, range(chosen)):  # noqa: B007 - the last one counts
        pass
    served = nearest > NOT_SEEN
    pixels = visibility.pixels.astype(np.float64)
    degrees = np.degrees(np.arccos(np.clip(nearest, -1.0, 1.0)))
    sums = np.bincount(visibility.cells[served], (degrees * pixels)[served], size)
    weights = np.bincount(visibility.cells[served], pixels[served], size)
    angle = sums / np.maximum(weights, 1e-12)
    return number.reshape(grid, grid), angle.reshape(grid, grid), float(1.0 - pixels[served].sum() / pixels.sum())


def _picture(values: np.ndarray, there: np.ndarray, unseen: np.ndarray, what: str) -> Picture:
    """Values [G, G] in [0, 1], V up -> an opaque-where-``there`` picture with V upwards."""
    from matplotlib import colormaps

    rgba = np.zeros((*values.shape, 4), np.uint8)
    rgba[..., :3] = np.rint(colormaps["viridis"](values)[..., :3] * 255)
    rgba[unseen, :3] = UNSEEN
    rgba[there, 3] = 255
    image = Image.fromarray(rgba[::-1]).resize((SIDE, SIDE), Image.Resampling.NEAREST)
    return encode(image, f"the atlas: {what}", SIDE)

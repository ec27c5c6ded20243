"""Reprojection of a frame into the next by known motion, and what then still changes. numpy only.

Notation
    position  world position of the surface at each pixel's centre, scene units [H, W, 3]
    depth     planar depth of it [H, W]
    mask      where there is a surface [H, W]

A pixel of the next frame takes part where its surface was seen in the frame before: inside the picture, on four
pixels with a surface, none of whose depths differs from the reprojected one by more than ``TOLERANCE``. The change of
a moving camera's picture has two parts: what light really does (highlights move) and flicker. The first is what a
reference with many samples changes by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dnrtrain.contract import View

TOLERANCE = 0.02
"""Relative difference of depths that still counts as the same surface."""


@dataclass(frozen=True)
class Surface:
    """What a camera sees: see the module's notation."""

    view: View
    position: np.ndarray
    depth: np.ndarray
    mask: np.ndarray


def project(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World points [..., 3] -> (x, y) in pixels from the top left corner, planar depth (negative behind)."""
    local = (points - view.position) @ view.matrix[:3, :3]
    depth = -local[..., 2]
    safe = np.where(depth > 0, depth, np.inf)
    x = view.cx + view.fl_x * local[..., 0] / safe
    y = view.cy - view.fl_y * local[..., 1] / safe
    return x, y, depth


def reproject(image: np.ndarray, before: Surface, after: Surface) -> tuple[np.ndarray, np.ndarray]:
    """``image`` [H, W, C] of ``before`` as seen from ``after``, bilinear: (picture [H, W, C], bool [H, W] where valid).

    Not valid: no surface, hidden or outside before, or at a rim, where neighbours are other surfaces.
    """
    height, width = before.mask.shape
    x, y, depth = project(before.view, after.position)
    column, row = np.floor(x - 0.5), np.floor(y - 0.5)
    valid = after.mask & (depth > 0) & (column >= 0) & (row >= 0) & (column < width - 1) & (row < height - 1)
    left = np.where(valid, column, 0).astype(int)
    top = np.where(valid, row, 0).astype(int)
    across, down = np.where(valid, x - 0.5 - column, 0), np.where(valid, y - 0.5 - row, 0)
    picture = np.zeros((*after.mask.shape, image.shape[2]), dtype=np.float64)
    for dy in (0, 1):
        for dx in (0, 1):
            place = (np.minimum(top + dy, height - 1), np.minimum(left + dx, width - 1))
            same = np.abs(before.depth[place] - depth) <= TOLERANCE * np.abs(depth)
            weight = (across if dx else 1 - across) * (down if dy else 1 - down)
            valid &= (before.mask[place] & same) | (weight == 0)
            picture += weight[..., None] * image[place]
    return np.where(valid[..., None], picture, 0), valid


def changes(images: list[np.ndarray], surfaces: list[Surface]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Per pair of frames one after the other: (after - reprojected before [H, W, C], where valid [H, W])."""
    pairs = zip(images, images[1:], surfaces, surfaces[1:], strict=False)
    found = []
    for before, after, surface, next_surface in pairs:
        picture, valid = reproject(before, surface, next_surface)
        found.append((np.where(valid[..., None], after - picture, 0), valid))
    return found


def flicker(
    images: list[np.ndarray],
    reference: list[np.ndarray],
    surfaces: list[Surface],
    halves: tuple[list[np.ndarray], list[np.ndarray]] | None = None,
) -> dict[str, float]:
    """How much a moving picture changes, display space [0, 1], means over the valid pixels of all pairs.

    halves: of the reference, whose noise is independent: in the product of the differences from either it cancels.

    {"change": mean absolute change, "reference": the reference's, "flicker": mean absolute difference of the two
    changes (what moves though light does not, or does not move though it does), "valid": share of surface pixels}, and
    with halves "flicker_rms": the root mean square of that difference, without the reference's noise.
    """
    ours, true = changes(images, surfaces), changes(reference, surfaces)
    valid = np.stack([mask for _, mask in ours])
    if not valid.any():
        raise ValueError("no pixel is seen in two frames one after the other: the frames are too far apart")
    change, truth = (np.stack([pair[0] for pair in rows])[valid] for rows in (ours, true))
    seen = np.stack([surface.mask for surface in surfaces[1:]])
    found = {}
    if halves is not None:
        off, again = (change - np.stack([pair[0] for pair in changes(half, surfaces)])[valid] for half in halves)
        found["flicker_rms"] = float(np.sqrt(max(0.0, (off * again).mean())))
    return found | {
        "change": float(np.abs(change).mean()),
        "reference": float(np.abs(truth).mean()),
        "flicker": float(np.abs(change - truth).mean()),
        "valid": float(valid.sum() / max(1, seen.sum())),
    }

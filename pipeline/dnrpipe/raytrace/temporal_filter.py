"""Finished frames of a moving camera, each averaged a little with the frame before and the frame after it.

What is wrong with a frame is for the most part not wrong with the next one: that flickers, and a mean over frames has
less of it. It needs no more than frames have that are finished, by whatever way they were rendered.

Notation
    C        colour of frame t, log(1 + level x radiance): else a bright pixel would outweigh all others
    B, A     what the frames before and after show of what is at a pixel of t, brought there by its motion
             (`reprojection`), within what the neighbourhood of the pixel shows
    w(X)     SHARE / (1 + (|X - C| / LIKELY)²): what is far off is not noise that a denoiser left, but something else
    D        w(B) (B - C) + w(A) (A - C); B or A is C where that frame does not see the place
    D'       D, smoothed over 3 x 3 pixels
    result   C + D' + KEPT (D - D')

Light that moves by the same in either interval is no error of the mean of both: B and A stand as far behind as before
it. A lookup between pixels blurs, so that D has what is lost of C's finest detail, too: a part of it is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from dnrtrain.contract import View

from .denoise import exposure
from .neighbours import AROUND
from .recorded import Recorded, inputs_of, planes_of
from .reprojection import Picture, Places
from .sensors import opaque_camera

SHARE = 1 / 3
"""Of either frame: the three count alike."""
LIKELY = 1.0
"""Of differences, the largest of a colour's three: brighter or darker by two and a half times."""
SPREAD = 4.0
"""Standard deviations of the neighbourhood within which B and A stay."""
KEPT = 0.5
"""Share of D's finest detail."""
LEVEL = 16.0
"""Of colours, times the frame's exposure: middle grey becomes 1.4."""
TAKEN = ("R", "G", "B", "A", "depth.Z", "normal.X", "normal.Y", "normal.Z")
"""Channels that are read, in the kernel's order."""
KNOWN = 3
"""Frames that are kept where one follows the other: one and those next to it."""
LEAST_ALPHA, SAME_ALPHA = 1e-3, 0.1
"""Of a pixel; and up to which difference another counts: at the rim of what stands before nothing, colours are as dark
as they are transparent."""
Key = TypeVar("Key")
Value = TypeVar("Value")


@dataclass(frozen=True)
class Finished:
    """A frame. layers: float32 [H, W] each, those of TAKEN among them; colour linear Rec.709, premultiplied, depth
    planar in the view's units and 0 where there is no surface, normals of world space."""

    view: View
    layers: Mapping[str, np.ndarray]


class Latest(Generic[Key, Value]):
    """The last KNOWN that were made: where frames follow one another, each is made once."""

    def __init__(self) -> None:
        self.kept: list[tuple[Key, Value]] = []

    def __call__(self, key: Key, make: Callable[[], Value]) -> Value:
        """What is kept under the key, or was made now."""
        for known, value in self.kept:
            if known == key:
                return value
        value = make()
        self.kept = [*self.kept, (key, value)][-KNOWN:]
        return value

    def forget(self) -> None:
        """All but the last one."""
        self.kept = self.kept[-1:]


class TemporalFilter:
    """Filters frames of one size after the other. Needs a jit variant of Mitsuba."""

    def __init__(self, mi: Any) -> None:
        self.mi = mi
        self.kernel = Recorded(self._kernel)

    def __call__(self, frame: Finished, before: Finished | None, after: Finished | None) -> dict[str, np.ndarray]:
        """The frame's layers with another R, G and B. before, after: None: there is none; nor is one of another size.

        Alpha, which has no grain, stays, and colours keep to it. Shares are data: one kernel serves frames with and
        without others next to them.
        """
        import drjit as dr

        mi, size = self.mi, (frame.view.height, frame.view.width)
        before, after = (
            None if each is None or (each.view.height, each.view.width) != size else each for each in (before, after)
        )
        if before is None and after is None:
            return dict(frame.layers)
        three = frame, before or frame, after or frame
        flat = inputs_of(mi, (each.layers[name] for each in three for name in TAKEN))
        planes = [flat[first : first + len(TAKEN)] for first in range(0, len(flat), len(TAKEN))]
        cameras = [opaque_camera(mi, each.view) for each in three]
        shares = [dr.opaque(mi.Float, 0.0 if each is None else SHARE) for each in (before, after)]
        level = LEVEL * exposure(np.stack([frame.layers[c] for c in "RGB"], axis=-1))
        found = self.kernel(planes, cameras, shares, dr.opaque(mi.Float, level), size[1], size[0])
        return {**frame.layers, **dict(zip("RGB", planes_of(found, size), strict=True))}

    def _kernel(
        self, planes: list[list[Any]], cameras: list[Any], shares: list[Any], level: Any, width: int, height: int
    ) -> list[Any]:
        """Colour [3][height * width]. Recorded once for a size.

        Args:
            planes: of TAKEN, of the frame, the one before and the one after.
            cameras: theirs; see `opaque_camera`.
            shares: of the two others.
        """
        import drjit as dr

        mi, picture = self.mi, Picture(self.mi, width, height)
        packets = [mi.Vector4f(*(dr.log(1 + level * c) for c in each[:3]), each[3]) for each in planes]
        own = picture.surfaces(cameras[0], mi.Normal3f(*planes[0][5:8]), planes[0][4] > 0, planes[0][4])
        colour, change = packets[0], mi.Vector4f(0)
        plain = mi.Color3f(colour.x, colour.y, colour.z)
        place, inner = dr.select(own.edge, own.front, own.point), own.mask & ~own.edge
        for camera, each, packet, share in zip(cameras[1:], planes[1:], packets[1:], shares, strict=True):
            origin, sight, stretch = picture.sights(camera)
            point = mi.Point3f(origin + sight * (each[4] * stretch))
            points, normals = dr.ravel(mi.Vector4f(*point, each[4])), dr.ravel(mi.Vector4f(*each[5:8], 0))
            at = Places(mi, picture, camera, place)
            seen = at.inside & (own.edge | inner)
            for index in at.corners:
                there, facing = (dr.gather(mi.Vector4f, values, index) for values in (points, normals))
                seen &= own.edge | ((there.w > 0) & own.holds(there.xyz, facing.xyz))
            looked = at.spline(dr.ravel(packet), seen, colour)
            seen &= dr.abs(looked.w - colour.w) < SAME_ALPHA
            within = picture.clipped(mi.Color3f(looked.x, looked.y, looked.z), plain, SPREAD)
            looked = mi.Vector4f(*within, looked.w)
            apart = looked - colour
            far = dr.maximum(dr.maximum(dr.abs(apart.x), dr.abs(apart.y)), dr.abs(apart.z)) / LIKELY
            change += dr.select(seen, share / (1 + dr.square(far)), 0) * apart
        beside, smooth = dr.ravel(change), mi.Vector4f(0)
        for right, below in AROUND:
            weight = (2 - abs(right)) * (2 - abs(below)) / 16
            smooth += weight * dr.gather(mi.Vector4f, beside, picture.index(right, below))
        found = colour + smooth + KEPT * (change - smooth)
        alpha = colour.w / dr.maximum(found.w, LEAST_ALPHA)
        return [(dr.exp(dr.maximum(c, 0)) - 1) / level * alpha for c in (found.x, found.y, found.z)]

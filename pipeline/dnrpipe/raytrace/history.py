"""What earlier frames of a moving camera showed, brought into the next one: more rays per pixel than it cast.

Notation
    P        surface point at a pixel's centre, world space; n its normal
    V        virtual point: where the end of P's specular path seems to be, on the pixel's line of sight, as far behind
             P as the path goes on (primary surface replacement; Zimmer et al. 2015)
    D, S     diffuse part of a base image, and the rest of it
    K        rays per pixel of a frame, R of all frames that count in a pixel
    corners  the four pixels of the earlier frame around a point's place in it (`reprojection`)

    D_t = lerp(D_t-1 where P was, D of frame t, K / R)        S_t likewise, where V was

D looks the same from everywhere: it is followed by P. What a flat mirror or pane shows moves with V; where the path
through the place where V was ended elsewhere, S begins anew. A curved one bends the lines of sight: what it shows stays
closer to P than to V (measured). That and other S follow P, for a few frames and within what the frame's own
neighbourhood shows, so that light which moved does not stay behind (variance clipping; Salvi 2016). Where nothing is
found, a pixel begins anew.

At edges a pixel shows several surfaces, and its rays say little of how much of each: most of what flickers is there.
Edges move with the surface in front, and all that they show is followed by it, whatever the corners lie on, within
what the neighbourhood shows (as temporal antialiasing does; Karis 2014).

Places are looked up by Catmull-Rom splines, which keep what is sharp; where something has come from behind another, by
those corners that lie on the same surface.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from dnrtrain.contract import FRESH_CHANNELS, View

from .base_renderer import CHAIN, FACING, SHOWN
from .recorded import Recorded, inputs_of, planes_of
from .reprojection import TURNED, Picture, Places, Surfaces
from .sensors import opaque_camera

MOST_DIFFUSE, MOST_MIRRORED, MOST_OTHER = 3.0, 16.0, 6.0
"""Rays of earlier frames that count: for D, for S that follows V, for S that follows P and for all at edges. Each
lookup blurs a little, light moves on what is not a mirror, and D has no grain but at edges."""
MOST_RESTING = 512.0
"""Where the camera has not moved."""
FLAT = 0.9998
"""Least cosine between normals of neighbouring pixels of a flat mirror: about a degree."""
DISPLACED = 4.0
"""Pixels, as large as they are at the end of a path, up to which two ends show the same."""
SPREAD = 2.5
"""Standard deviations of the neighbourhood within which S, and D at edges, stay."""

COLOURS = tuple(f"{kind}.{c}" for kind in ("diffuse", "base", "albedo") for c in "RGB")
MEANS = (*COLOURS, *SHOWN, *FACING, "base.A")
TAKEN = (*MEANS, "noise", "rays", "normal.X", "normal.Y", "normal.Z", "mask", "depth.Z", *CHAIN)
"""Channels that a history reads, in the kernel's order."""
GIVEN = (*MEANS, "noise", "rays")
"""Channels that it changes; it adds FRESH_CHANNELS, the frame's own."""
LEAST_ALPHA = 1e-3
"""Of the frame's own base image, where it is brought to the alpha of what is remembered."""


class History:
    """Accumulates base images of frames that follow one another, of one size. Needs a jit variant.

    ``number`` of the next frame, which `BaseRenderer.frame` wants: how many came before it.

    most_other, edges: MOST_OTHER, and whether edges follow the surface in front: others for pictures that have grain
    everywhere, which base images have not.
    """

    def __init__(self, mi: Any, *, most_other: float = MOST_OTHER, edges: bool = True) -> None:
        self.mi, self.most_other, self.edges = mi, most_other, edges
        self.kernel = Recorded(self._kernel)
        self.begin()

    def begin(self, number: int = 0) -> None:
        """Forget. number: of the next frame, where it stands in the middle of a sequence."""
        self.number = number
        self.before: tuple[View, list[Any]] | None = None

    def beside(self, number: int) -> History:
        """Another memory that has begun, by the same kernel."""
        other = copy(self)
        other.begin(number)
        return other

    def take(self, view: View, channels: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The channels of a frame with its base image improved by the frames before; float32 [H, W] each.

        channels: of TAKEN, scene units, linear Rec.709, premultiplied. New are those of GIVEN: ``rays`` counts those of
        all frames that are in a pixel's S, ``noise`` is the standard error of base by the spread of the frames' means.
        A frame of another size than the one before begins anew.
        """
        mi, size, first = self.mi, (view.height, view.width), self.before is None
        if self.before is None or (self.before[0].height, self.before[0].width) != size:
            pixels = view.width * view.height
            self.before = view, inputs_of(mi, (np.zeros(4 * pixels) for _ in PACKETS))
        planes = inputs_of(mi, (channels[name] for name in TAKEN))
        earlier, memory = self.before
        resting = not first and view.c2w == earlier.c2w and view.intrinsics == earlier.intrinsics
        cameras = opaque_camera(mi, view), opaque_camera(mi, earlier)
        given, memory = self.kernel(planes, memory, *cameras, view.width, view.height, resting)
        self.before, self.number = (view, memory), self.number + 1
        found = dict(zip(GIVEN, planes_of(given, size), strict=True))
        share = found["base.A"] / np.maximum(channels["base.A"], LEAST_ALPHA)
        own = [*(channels[f"base.{c}"] * share for c in "RGB"), channels["rays"]]
        return {**channels, **found, **dict(zip(FRESH_CHANNELS, own, strict=True))}

    def _kernel(
        self, planes: list[Any], memory: list[Any], camera: Any, earlier: Any, width: int, height: int, resting: bool
    ) -> tuple[list[Any], list[Any]]:
        """(planes of GIVEN, what the next frame remembers). Recorded once for a size, moving and resting.

        Args:
            planes: of TAKEN.
            memory: of the frame before; zeros where there is none.
            camera, earlier: see `opaque_camera`.
            resting: whether they are the same.
        """
        import drjit as dr

        mi = self.mi
        picture = Picture(mi, width, height)
        diffuse, base, *facts = (mi.Color3f(*planes[i : i + 3]) for i in range(0, 15, 3))
        alpha, noise, rays = planes[15:18]
        specular, bright = base - diffuse, mi.luminance(base)
        seen = _seen(mi, picture, camera, planes, self.edges)
        own, parts = seen.own, (diffuse, specular)
        past = _rested(mi, memory) if resting else _moved(mi, picture, earlier, memory, seen, parts, self.most_other)

        share, share_d = rays / (rays + past.rays_s), rays / (rays + past.rays_d)
        s, d = dr.lerp(past.s, specular, share), dr.lerp(past.d, diffuse, share_d)
        facts = [dr.lerp(before, fact, share_d) for before, fact in zip(past.facts, facts, strict=True)]
        alpha = dr.lerp(past.alpha, alpha, share_d)
        light = dr.lerp(past.light, bright, share)
        squares = dr.lerp(past.squares, bright * bright + noise * noise, share)
        error = dr.sqrt(dr.maximum(squares - light * light, 0) * share)  # of all frames by the variance of one's mean
        given = [*d, *(s + d), *chain.from_iterable(facts), alpha, error, rays + past.rays_s]
        packets = [(*own.point, dr.select(own.mask, 1.0, 0.0)), (*own.normal, squares)]
        packets += [(*seen.end, rays + past.rays_s), (*s, light), (*d, rays + past.rays_d)]
        packets += [(*fact, alpha) for fact in facts]
        return given, [dr.ravel(mi.Vector4f(*packet)) for packet in packets]


@dataclass(frozen=True)
class _Seen:
    """What a frame sees, an array element per pixel: its surfaces; whether a pixel's neighbours face as it does; V; the
    end of the path and its length behind P."""

    own: Surfaces
    even: Any
    virtual: Any
    end: Any
    length: Any


@dataclass(frozen=True)
class _Past:
    """What earlier frames say of each pixel, and how many rays of theirs count (0: nothing is known).

    facts: albedo, SHOWN and FACING. light, squares: luminance of the base image, and the mean of its square.
    """

    s: Any
    d: Any
    facts: list[Any]
    alpha: Any
    light: Any
    squares: Any
    rays_s: Any
    rays_d: Any


def _rested(mi: Any, memory: list[Any]) -> _Past:
    """Each pixel is where it was."""
    import drjit as dr

    pixel = dr.arange(mi.UInt32, dr.width(memory[S]) // 4)
    turned, end, s, d, *facts = (dr.gather(mi.Vector4f, memory[i], pixel) for i in (NORMAL, END, S, D, *FACTS))
    counts = [dr.minimum(rays, MOST_RESTING) for rays in (end.w, d.w)]
    return _Past(_rgb(mi, s), _rgb(mi, d), [_rgb(mi, one) for one in facts], facts[0].w, s.w, turned.w, *counts)


def _moved(
    mi: Any, picture: Picture, earlier: Any, memory: list[Any], seen: _Seen, parts: tuple[Any, Any], most_other: float
) -> _Past:
    """Looked up where P and V were. parts: D and S of the frame."""
    import drjit as dr

    diffuse, specular = parts
    own, edge = seen.own, seen.own.edge
    inner = own.mask & ~edge
    narrow = (seen.length > 0) & seen.even & ~edge
    near = DISPLACED * (own.distance + seen.length) / earlier[1][0]

    # ------------------------- Where P was ----------------------------
    at = Places(mi, picture, earlier, dr.select(edge, own.front, own.point))
    same, sharp = [], at.inside & inner
    for index in at.corners:
        place, facing = (dr.gather(mi.Vector4f, memory[i], index) for i in (PLACE, NORMAL))
        on = (place.w > 0) & own.holds(place.xyz, facing.xyz)
        same.append(at.inside & (edge | (inner & on)))
        sharp &= same[-1]
    weights, known = at.weights(same)
    facing, end, s, d, *facts = (at.bilinear(memory[i], weights) for i in (NORMAL, END, S, D, *FACTS))
    most_d = dr.select(edge, most_other, MOST_DIFFUSE)
    rays_d = dr.select(known, dr.minimum(d.w, most_d), 0)
    rays_s = dr.select(known & ~narrow, dr.minimum(end.w, most_other), 0)
    followed = edge & at.inside
    s, d = at.spline(memory[S], followed, s), _rgb(mi, at.spline(memory[D], sharp | followed, d))
    colour, light, squares = picture.clipped(_rgb(mi, s), specular, SPREAD), s.w, facing.w
    d = dr.select(edge, picture.clipped(d, diffuse, SPREAD), d)

    # ------------------------- Where V was ----------------------------
    at = Places(mi, picture, earlier, seen.virtual)
    same, sharp = [], at.inside & narrow
    for index in at.corners:
        place, facing, end = (dr.gather(mi.Vector4f, memory[i], index) for i in (PLACE, NORMAL, END))
        on = at.inside & narrow & (place.w > 0) & (dr.dot(facing.xyz, own.normal) > TURNED)
        same.append(on & (dr.norm(end.xyz - seen.end) < near))
        sharp &= same[-1]
    weights, mirrored = at.weights(same)
    s, end, facing = (at.bilinear(memory[i], weights) for i in (S, END, NORMAL))
    colour = dr.select(mirrored, _rgb(mi, at.spline(memory[S], sharp, s)), colour)
    light = dr.select(mirrored, s.w, light)
    squares = dr.select(mirrored, facing.w, squares)
    rays_s = dr.select(mirrored, dr.minimum(end.w, dr.select(sharp, MOST_MIRRORED, most_other)), rays_s)
    return _Past(colour, d, [_rgb(mi, one) for one in facts], facts[0].w, light, squares, rays_s, rays_d)


def _seen(mi: Any, picture: Picture, camera: Any, planes: list[Any], edges: bool) -> _Seen:
    """What the frame sees. planes: of TAKEN. edges: see `Picture.surfaces`."""
    import drjit as dr

    normal, mask, depth = mi.Normal3f(*planes[18:21]), planes[21] > 0.5, planes[22]
    own = picture.surfaces(camera, normal, mask, depth, edges=edges)
    length, end = planes[23], mi.Point3f(*planes[24:27])
    virtual = mi.Point3f(camera[0][3] + own.sight * (own.distance + length))
    even = mi.Bool(True)
    for right, below in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        even &= dr.dot(dr.gather(mi.Normal3f, normal, picture.index(right, below)), normal) > FLAT
    return _Seen(own, even, virtual, end, length)


def _rgb(mi: Any, packet: Any) -> Any:
    return mi.Color3f(packet.x, packet.y, packet.z)


PACKETS = PLACE, NORMAL, END, S, D, *FACTS = range(8)
"""What a frame leaves behind: P, and 1 where there is one; n and the mean square of the luminance of base; where the
path ends, and R of S; S and the luminance; D and its R; albedo, SHOWN and FACING, each with alpha. Four values a pixel,
side by side, which are read at once."""

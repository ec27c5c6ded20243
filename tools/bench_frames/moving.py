"""Moving cameras: how good each renderer's frames are, what they cost, and how much they change beyond what light does.

Ours with and without memory of earlier frames; path tracing and denoiser, and the same with its samples gathered over
the frames by the same reprojection before the denoiser sees them: the fair rival.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dnrpipe.core.cameras import framing, look_at_view, orbit_views
from dnrpipe.core.images import mean_known, rgba
from dnrpipe.raytrace.base_renderer import CHAIN, BaseRenderer
from dnrpipe.raytrace.engine import masked
from dnrpipe.raytrace.history import MOST_DIFFUSE, History
from dnrpipe.studies.frames.baselines import METHODS, denoised
from dnrpipe.studies.frames.ours import Ours
from dnrpipe.studies.frames.scene import BenchScene, Clock
from dnrtrain.contract import View
from dnrtrain.metrics import image_metrics

from .motion import Surface, flicker
from .reference import make_references

STEPS = 360
"""Frames of a full turn: one degree each, a quarter of a minute at 24 frames per second."""
CLOSER, SIDEWAYS = 0.01, 0.4
"""Of a walk, per frame: share of the distance, degrees about the scene's middle."""
PAIRS = 3
"""Pairs of frames one after the other that are traced as references, the last of them near the end."""
GATHERINGS: dict[str, tuple[float, dict[str, Any]]] = {
    "gathered x2, edges": (2, {}),
    "gathered x1, edges": (1, {"most_other": MOST_DIFFUSE}),
    "gathered x1": (1, {"most_other": MOST_DIFFUSE, "edges": False}),
    "gathered x0.5": (0.5, {"most_other": MOST_DIFFUSE, "edges": False}),
}
"""By name: how many times as many samples of earlier frames the rival keeps as we keep rays, options of its history: of
what was tried, the best. More is worse: the denoiser takes what was looked up often for a pattern."""


def measure(
    scene: BenchScene,
    ours: Ours,
    clock: Clock,
    baselines: list[tuple[int, str]],
    *,
    frames: int,
    spp: int,
    kind: str,
    folder: Path,
    tell: Callable[[str], None],
    lpips: Any,
) -> dict[str, Any]:
    """Figures of an orbit and of a walk.

    Args:
        scene, ours, clock: of the benchmark.
        baselines: (samples, method) of each rival.
        frames: of each move, at least 6.
        spp, kind: of the references.
        folder: references are kept there.
        tell: called with a line per frame.
        lpips: see `dnrtrain.metrics.image_metrics`.

    Returns {move: {"frames", "reference", "reference_spp", "reference_noise", "rows": {renderer: {"ms", "psnr", ...,
    and those of `motion.flicker`}}}}.
    """
    found = {}
    for move, views in moves(scene, frames).items():
        last = [round((frames - 2) * (i + 1) / PAIRS) for i in range(PAIRS)]  # each with a frame after it
        chosen = sorted({*last, *(number - 1 for number in last)})
        near = {number + step for number in chosen for step in (-1, 0, 1)}
        reference = make_references(scene, [views[i] for i in chosen], move, spp, kind, folder, tell)
        truth = dict(zip(chosen, (scene.shown(picture) for picture in reference.pictures), strict=True))
        halves = {
            i: [_plane(scene.shown(half)) for half in pair] for i, pair in zip(chosen, reference.halves, strict=True)
        }
        surfaces = {i: surface_of(views[i], scene.frames.gbuffer(views[i])) for i in chosen}
        rivals = Rivals(scene, ours, baselines)
        ours.begin()
        judged = _Judged(chosen)
        for number, view in enumerate(views):
            if number in truth:
                judged.take(number, _timed(ours.frame(view, clock)))
            if number in near:
                judged.take(number, _timed(ours.frame(view, clock, remember=True)))
            else:
                ours.remember(view, clock)
            if number - 1 in truth:
                judged.take(number - 1, _timed(ours.filtered(clock)))
            judged.take(number, rivals.frame(view, number, clock, number in truth))
            tell(f"{scene.name}: {move}, frame {number + 1} of {frames}")
        rows = {name: _figures(shown, truth, halves, surfaces, last, lpips) for name, shown in judged.pictures.items()}
        found[move] = {
            "frames": frames,
            "reference": reference.kind,
            "reference_spp": spp,
            "reference_noise": float(np.mean(reference.noise)),
            "rows": {name: {"ms": float(np.median(judged.took[name])), **row} for name, row in rows.items()},
        }
    return found


def moves(scene: BenchScene, frames: int) -> dict[str, list[View]]:
    """An orbit, a degree a frame, and a walk towards the scene.

    Where the test views stand inside the scene, so do these cameras: both go about what the first test view looks at.
    """
    width, height = scene.size
    cameras = scene.settings.cameras.model_copy(update={"width": width, "height": height})
    focal, distance = framing(scene.summary, cameras)
    around = scene.summary.surroundings
    standpoints = () if around is None else around.standpoints
    inside = next((one for one in standpoints if np.allclose(one.place, scene.views[0].position)), None)
    if inside is None:
        rise, turn = math.radians(18), math.radians(200)
        way = np.array([math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn), math.sin(rise)])
        way, middle = way * distance * 0.85, np.asarray(scene.summary.bounds.center)
    else:
        way, middle = np.array(inside.place) - inside.target, np.array(inside.target)

    def seen(number: int, degrees: float, share: float = 1) -> View:
        """From so much of the way, turned by so much."""
        eye = middle + _turned(way, degrees) * share
        return look_at_view(f"{number:04d}", eye, middle, focal, cameras)

    orbit = orbit_views(scene.summary, cameras, STEPS)[:frames]
    if inside is not None:
        orbit = [seen(number, number - frames // 2) for number in range(frames)]
    walk = [seen(number, SIDEWAYS * number, (1 - CLOSER) ** number) for number in range(frames)]
    return {"orbit": orbit, "walk": walk}


def _turned(way: np.ndarray, degrees: float) -> np.ndarray:
    """About the upright axis."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([cos * way[0] - sin * way[1], sin * way[0] + cos * way[1], way[2]])


def surface_of(view: View, gbuffer: dict[str, np.ndarray]) -> Surface:
    """What the G-buffer's camera sees."""
    position = np.stack([gbuffer[f"position.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
    return Surface(view, position, gbuffer["depth.Z"].astype(np.float64), gbuffer["mask"] > 0.5)


class _Judged:
    """By renderer: pictures of the frames that are judged, and their milliseconds."""

    def __init__(self, numbers: list[int]) -> None:
        self.numbers = numbers
        self.pictures: dict[str, dict[int, torch.Tensor]] = {}
        self.took: dict[str, list[float]] = {}

    def take(self, number: int, found: dict[str, tuple[Any, float]]) -> None:
        """found: by name, a frame's (display picture, ms); dropped where the frame is not judged."""
        for name, (picture, ms) in found.items() if number in self.numbers else ():
            self.took.setdefault(name, []).append(ms)
            self.pictures.setdefault(name, {})[number] = picture.half()


def _timed(found: dict[str, dict[str, Any]]) -> dict[str, tuple[Any, float]]:
    """By name: (display picture, ms)."""
    return {name: (frame["picture"], sum(frame["parts"].values())) for name, frame in found.items()}


def _figures(
    shown: dict[int, torch.Tensor],
    truth: dict[int, torch.Tensor],
    halves: dict[int, list[np.ndarray]],
    surfaces: dict[int, Surface],
    last: list[int],
    lpips: Any,
) -> dict[str, float]:
    masks = {i: torch.from_numpy(surface.mask).float()[None, None] for i, surface in surfaces.items()}
    rows = [image_metrics(picture.float(), truth[i], masks[i], lpips) for i, picture in shown.items()]
    means = {key: mean_known(row[key] for row in rows) for key in rows[0]}
    quality = {key: mean for key, mean in means.items() if mean is not None}
    pairs = []
    for i in last:
        pair = (i - 1, i)
        ours, true = ([_plane(images[j]) for j in pair] for images in (shown, truth))
        parts = ([halves[j][0] for j in pair], [halves[j][1] for j in pair])
        pairs.append(flicker(ours, true, [surfaces[j] for j in pair], parts))
    return {**quality, **{key: float(np.mean([pair[key] for pair in pairs])) for key in pairs[0]}}


class Rivals:
    """Path tracing and denoiser, by themselves and with samples gathered over the frames.

    What is gathered follows surfaces, and mirrors as ours does: what tells them apart comes from a base image of one
    ray, whose time the rival does not pay.
    """

    def __init__(self, scene: BenchScene, ours: Ours, baselines: list[tuple[int, str]]) -> None:
        self.scene, self.baselines = scene, baselines
        engine, dark = scene.engine, np.zeros((2, 2, 2, 2, 3), np.float32)
        self.guide = BaseRenderer(engine.mi, engine.scenes[str(scene.bundle)], dark, unit_scale=engine.unit_scale)
        samples = {spp for spp, _ in baselines}
        self.histories = {
            (spp, name): History(engine.mi, **options) for spp in samples for name, (_, options) in GATHERINGS.items()
        }

    def frame(self, view: View, number: int, clock: Clock, judged: bool) -> dict[str, tuple[Any, float]]:
        """By name: (display picture, ms); of a frame that is not judged nothing but what is gathered."""
        scene, seed = self.scene, 1_000_003 * (number + 1)
        channels = self.guide.frame(view, 1)
        paths, gathered, guides = {}, {}, {0: (None, 0.0)}
        for spp in {spp for spp, _ in self.baselines}:
            paths[spp] = clock.time(lambda spp=spp: masked(scene.frames.path(view, spp, seed + spp))[0])
            for name, (patience, _) in GATHERINGS.items():
                taken = _as_base(channels, paths[spp][0], spp / patience)
                gathered[spp, name] = clock.time(partial(self.histories[spp, name].take, view, taken))
        found = {}
        for spp, method in self.baselines if judged else ():
            chosen = METHODS[method]
            rays = spp if chosen.rays < 0 else chosen.rays
            if rays not in guides:
                guides[rays] = clock.time(partial(scene.frames.auxiliary, view, rays, seed + 7919 * rays))
            guide, rays_ms = guides[rays]
            image, ms = paths[spp]
            pictures = {f"{spp} spp {method}": (image, ms)}
            for name in GATHERINGS:
                channels_, more = gathered[spp, name]
                pictures[f"{spp} spp {method}, {name}"] = (rgba(channels_, "base."), ms + more)
            for name, (noisy, spent) in pictures.items():
                smooth, denoiser_ms = clock.time(partial(denoised, noisy, guide, chosen, rays))
                if guide is not None:
                    smooth = np.concatenate([smooth[..., :3], guide.coverage[..., None]], axis=-1)
                found[name] = (scene.shown(smooth), spent + rays_ms + denoiser_ms)
        return found


def _as_base(channels: dict[str, np.ndarray], image: np.ndarray, rays: float) -> dict[str, np.ndarray]:
    """A path-traced picture in a base image's place: what mirrors and glass show is its specular part."""
    surface = channels[CHAIN[0]] == 0
    planes = {f"base.{c}": np.ascontiguousarray(image[..., i]) for i, c in enumerate("RGBA")}
    planes |= {f"diffuse.{c}": planes[f"base.{c}"] * surface for c in "RGB"}
    even = np.ones(surface.shape, np.float32)
    return {**channels, **planes, "noise": 0 * even, "rays": even * np.float32(rays)}


def _plane(picture: torch.Tensor) -> np.ndarray:
    """[1, 3, H, W] -> float64 [H, W, 3]."""
    return picture[0].double().clamp(0, 1).permute(1, 2, 0).numpy()

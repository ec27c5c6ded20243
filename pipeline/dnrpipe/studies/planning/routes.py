"""Whether to train at all: for N frames at a wanted PSNR, the cheapest of path tracing with a denoiser, the base image
alone, the shipped corrector without training, and the neural renderer.

    total(N) = upfront + N * frame
    N*       = upfront of the neural renderer / (frame of path tracing - frame of the neural renderer), at equal PSNR

Path tracing's frame is read off the pilot's baselines (`frames.pareto_front`): dB is linear in log(ms) between those
that nothing beats. Beyond the last one the slope of the last step goes on, and the route says so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ...core.ledger import break_even_frames
from ..frames.pareto_front import crossover, frontier
from .quality import with_noise
from .records import FramePart, FramePoint, Prediction, Route

PATH_TRACING, BASE_ALONE = "path tracing + denoiser", "base image alone"
UNTRAINED, TRAINED = "neural renderer, untrained", "neural renderer"
FURTHEST = 64.0
"""How many times the last baseline's time the slope is followed beyond it."""


def baseline_front(part: FramePart) -> list[tuple[str, float, float]]:
    """(name, seconds, PSNR) of the baselines that nothing beats, cheapest first."""
    points = {point.name: (point.ms / 1000, point.psnr) for point in part.rival}
    return [(name, *points[name]) for name in frontier(points)]


def seconds_for(line: Sequence[tuple[str, float, float]], psnr: float) -> tuple[float, bool] | None:
    """(seconds of a frame at ``psnr``, whether that lies beyond the baselines); None where it cannot be told."""
    points = [(seconds, quality) for _, seconds, quality in line]
    found = crossover(points, psnr)
    if found is not None:
        return found, False
    if len(points) < 2:
        return None
    (left, low), (right, high) = points[-2:]
    slope = (high - low) / math.log(right / left)
    seconds = right * math.exp((psnr - high) / slope)
    return (seconds, True) if seconds <= FURTHEST * right else None


def as_reported(part: FramePart, reference: float) -> FramePart:
    """The part with every PSNR as a report measures it: against references whose own noise is ``reference``, RMSE."""

    def shown(point: FramePoint) -> FramePoint:
        return point.model_copy(update={"psnr": with_noise(point.psnr, reference)})

    shipped = None if part.shipped is None else shown(part.shipped)
    changed = {"shipped": shipped, "neural": list(map(shown, part.neural)), "rival": list(map(shown, part.rival))}
    return part.model_copy(update={"base": shown(part.base), **changed})


def routes(
    part: FramePart,
    neural: Prediction | None,
    light_seconds: float,
    untrained_seconds: float,
    scale: float,
    psnr: float,
    frames: int,
) -> list[Route]:
    """All routes to ``frames`` frames at ``psnr`` dB, the cheapest that reaches it first.

    Args:
        neural: the cheapest choice that reaches ``psnr``, None where none does.
        light_seconds, untrained_seconds: before the first frame of the base image alone and of the shipped corrector.
        scale: pixels of a frame over the pilot's.
    """

    def add(name: str, what: str, upfront: float, frame: float, gives: float | None, reaches: bool) -> None:
        total = upfront + frames * frame
        found.append(
            Route(name=name, what=what, upfront=upfront, frame=frame, total=total, psnr=gives, reaches=reaches)
        )

    found: list[Route] = []
    line = baseline_front(part)
    if (answer := seconds_for(line, psnr)) is None:
        name, seconds, quality = line[-1]
        what = f"its best, {name}, ends at {quality:.1f} dB"
        add(PATH_TRACING, what, 0.0, seconds * scale, quality, quality >= psnr)
    else:
        seconds, beyond = answer
        what = "beyond the pilot's samples, extrapolated" if beyond else _between(line, seconds)
        add(PATH_TRACING, what, 0.0, seconds * scale, psnr, True)
    base, alone = part.base.psnr, part.base.ms / 1000 * scale
    add(BASE_ALONE, "baked light, no network", light_seconds, alone, base, base >= psnr)
    if part.shipped is not None:
        quality, frame = part.shipped.psnr, part.shipped.ms / 1000 * scale
        add(UNTRAINED, "baked light, shipped corrector", untrained_seconds, frame, quality, quality >= psnr)
    frame = part.neural[-1].ms / 1000 * scale
    if neural is None:
        add(TRAINED, "no choice is expected to reach it", 0.0, frame, None, False)
    else:
        choice, upfront = neural.choice, neural.seconds.total.expected
        what = f"{choice.views} views, {choice.spp} spp, {choice.steps} steps"
        add(TRAINED, what, upfront, frame, neural.psnr.expected, True)
    return sorted(found, key=lambda route: (not route.reaches, route.total))


def break_even(found: Sequence[Route]) -> int | None:
    """Frames from which on the neural renderer, trained or not, is cheaper than path tracing.

    None: it never is, or one of the two does not reach the PSNR.
    """
    by_name = {route.name: route for route in found}
    traced = by_name[PATH_TRACING]
    ours = [by_name[name] for name in (UNTRAINED, TRAINED) if name in by_name and by_name[name].reaches]
    even = [break_even_frames(route.upfront, traced.frame, route.frame) for route in ours if traced.reaches]
    return min((frames for frames in even if frames is not None), default=None)


def _between(line: Sequence[tuple[str, float, float]], seconds: float) -> str:
    below = [name for name, at, _ in line if at <= seconds * (1 + 1e-9)]
    above = [name for name, at, _ in line if at > seconds * (1 + 1e-9)]
    return f"about {below[-1]}" if below and not above else f"up to {(above or below)[0]}"

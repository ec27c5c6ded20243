"""Which way to make a shot: what the pilot measured, reckoned to all of its frames.

Light is baked only where baked light can be worth it: where few samples and a quick denoiser are worse, or baking takes
less than it saves, unless something else than that is wanted; and where path tracing all frames at the most samples
takes longer than baking is expected to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...core.errors import UserError
from ...core.scene_files import read_summary
from ...core.settings import Settings
from ...core.units import duration
from ..base_images import base_renderer, light_plan
from ..stage import Run
from ..worth import worth
from .frame_tasks import Way
from .options import QUICK, USUAL, Option, Wanted
from .pilot import LADDER, Measured, Pilot, reckoned
from .records import ShotFrame
from .renderers import Renderer, shipped_renderer

SAMPLES = 1, 2, 4, 8, 16, 32, 64
"""Per pixel, of path tracing that is weighed. Those that the pilot does not measure are reckoned (`reckoned`), as are
RAYS of base images."""
RAYS = 4, 5, 6, 7, 8, 10, 12, 16
FEWER = (4, 6)
"""Rays per pixel of base images that are measured beside the settings'."""
SMOOTH = (4, 8, 16)
"""The same of base images that are smoothed instead of denoised: that takes as long as three to eight rays do, and does
less where most light comes straight from a sky or lies baked on matt surfaces. The last is for where few path-traced
samples are good already (`choose`)."""
SAVED = 0.5
"""Of a frame of QUICK samples, what a base image as good takes less where it is smoothed, give or take."""
DEEP, MOST_DEEP = 8, 0.02
"""Surfaces of a path beyond which light is no more that of matt surfaces, which reflect too little, but of glass behind
glass; and the share of such light from which on baking does not pay. Base images follow glass as far as path tracing
does, and what shines through it onto matt surfaces is baked blurred. (`jewels` 7.6 %; the other example scenes have 0
to 0.8 %.)
"""
BAKED_WAYS = ("base", "neural")
FEWEST_CANDIDATES = 2
"""Views to train on, below which training cannot be tried (`worth`)."""
LIGHT_PATH = 2.5
"""Seconds of a path of baked light over those of a camera path: it sets out from everywhere, in all directions."""


@dataclass(frozen=True)
class Shape:
    """A shot as its seconds depend on it.

    still, moving: numbers of frames. pixels: of a frame. convert: seconds of converting the scene at another frame.
    """

    still: int
    moving: int
    pixels: int
    convert: float


def weigh(
    run: Run, frames: Sequence[ShotFrame], folder: Path, wanted: Wanted, tracer: Renderer, lpips: Any
) -> tuple[list[Option], float | None]:
    """(ways to make the shot, share of the shipped corrector that is trusted or None where it is not weighed)."""
    view = frames[0].view
    moving = sum(bool(frame.moving) for frame in frames)
    shape = Shape(len(frames) - moving, moving, view.width * view.height, _conversion_seconds(run))
    pilot = Pilot(run, frames, folder, lpips)
    quickest = Way(name="path", spp=QUICK, quality="balanced")
    quick = pilot.measure(tracer, [quickest])
    option, told = path_option(quick[0], shape), quick[0].lpips is not None and quick[0].shows
    if told and option.reaches(*USUAL) and wanted.aimless and not _light_is_ready(run):
        baking, saved = _baking_seconds(run, quick[0]), SAVED * _planned(shape, wanted) * option.frame
        why = f"baking would take about {duration(baking)} to save {duration(saved)}" if baking > saved else ""
        atlas = read_summary(run.workspace.scene).atlas
        if atlas.loses_most:  # `bricks`: 31.1 dB, where path tracing has 35
            why = f"{atlas.triangles_without_texel:.0%} of the triangles are too small for a texel of it"
        if why:
            run.console.say(f"baked light is not weighed: {quickest.told}, are as good as it usually is, and {why}")
            return _running([option], tracing=True), None
    others = [quickest.model_copy(update={"spp": spp}) for spp in LADDER if spp != QUICK]
    measured = pilot.measure(tracer, [*others, *(Way(name="path", spp=spp) for spp in LADDER)])
    quick += measured[: len(others)]
    fine = reckoned(measured[len(others) :], SAMPLES, [pilot.price_of_reference()])
    rungs = [*reckoned(quick, [n for n in SAMPLES if n <= max(LADDER)]), *fine]
    options = [path_option(found, shape) for found in rungs]
    if why := _no_baked_light(run, frames, shape, rungs, wanted):
        run.console.say(f"baked light is not weighed: {why}")
        return _running(options, tracing=True), None
    rays = run.settings.base.samples
    counts = [*(n for n in FEWER if n < rays), rays]
    ways = [Way(name="base" if wanted.way == "base" else "neural", spp=n) for n in counts]
    smooth = [] if wanted.way == "neural" else [Way(name="base", spp=n, smooth=True) for n in SMOOTH]
    if run.kept is not None:
        run.kept.close()  # baking wants the memory
    renderer, trust = shipped_renderer(run, tracer.common.background, trust=1.0), 0.0

    measured = pilot.measure(renderer, [*ways, *smooth])
    base = [found for found in measured if found.way.name == "base"]
    ours = [each for smooth in (True, False) for each in _more_rays([b for b in base if b.way.smooth == smooth])]
    if wanted.way != "base":
        trust, corrected = pilot.trusted(ways)
        run.console.say(_trust_told(trust))
        ours += _more_rays(corrected) if trust or wanted.way == "neural" else []
    options += [baked_option(found, options, shape) for found in ours]
    prepared = run.workspace.manifest.prepared
    candidates = prepared.views["train"] if prepared else 0
    if candidates >= FEWEST_CANDIDATES and wants_training(options, wanted):
        if run.kept is not None:
            run.kept.close()  # training on small views wants the memory
        found = worth(run, candidates)
        last = options[-1]  # of as many rays as a training's base images
        if found.views and last.psnr is not None:
            before = last.before + found.views * found.seconds
            options.append(
                last.model_copy(
                    update={
                        "way": Way(name="neural", spp=last.way.spp),
                        "views": found.views,
                        "before": before,
                        "seconds": last.seconds + found.views * found.seconds,
                        "psnr": last.psnr + found.expected,
                        "lpips": None,
                    }
                )
            )
        return options, trust
    return _running(options, tracing=False), trust


def _more_rays(measured: Sequence[Measured]) -> list[Measured]:
    """Base images of as many rays as were measured, and of RAYS between; the most are last."""
    known = sorted(found.way.spp for found in measured)
    if len(known) < 2:
        return [*measured]
    return reckoned(measured, sorted({*known, *(n for n in RAYS if known[0] < n < known[-1])}))


def _running(options: Sequence[Option], *, tracing: bool) -> list[Option]:
    """The options, of which the pilot's last process, which renders on, does not start anew."""
    return [
        option.model_copy(update={"before": 0.0, "seconds": option.seconds - option.before})
        if (option.way.name == "path") == tracing and not option.views
        else option
        for option in options
    ]


def path_option(found: Measured, shape: Shape) -> Option:
    """All frames path-traced."""
    frame = found.pixel * shape.pixels
    total = found.start + shape.still * frame + shape.moving * (frame + found.start + shape.convert)
    return Option(way=found.way, before=found.start, frame=frame, seconds=total, psnr=found.psnr, lpips=found.lpips)


def baked_option(found: Measured, paths: Sequence[Option], shape: Shape) -> Option:
    """Frames that stand still by baked light, the others path-traced as well as those. paths: `path_option` of each."""
    frame = found.pixel * shape.pixels
    total = found.start + shape.still * frame
    if shape.moving:
        rung = as_good(paths, found.psnr, found.lpips)
        total += shape.moving * (rung.frame + rung.before + shape.convert)
    return Option(way=found.way, before=found.start, frame=frame, seconds=total, psnr=found.psnr, lpips=found.lpips)


def as_good(options: Sequence[Option], psnr: float | None, lpips: float | None) -> Option:
    """The quickest path tracing that has the quality; that of the most samples where none has."""
    paths = [option for option in options if option.way.name == "path"]
    enough = [option for option in paths if option.reaches(psnr, lpips)]
    return min(enough or [max(paths, key=lambda option: option.way.spp)], key=lambda option: option.frame)


def moving_way(options: Sequence[Option], chosen: Option) -> Way:
    """How frames with moving things are path-traced: as the others, or as well as they are expected to be."""
    return chosen.way if chosen.way.name == "path" else as_good(options, chosen.psnr, chosen.lpips).way


def lines(options: Sequence[Option], chosen: Option, why: str) -> list[str]:
    """The options as a table for the terminal, the chosen one marked, and why it was."""
    rows = []
    for option in sorted(options, key=lambda option: option.seconds):
        quality = "" if option.psnr is None else f"{option.psnr:6.2f} dB"
        quality += "" if option.lpips is None else f"  LPIPS {option.lpips:.4f}"
        mark = "->" if option == chosen else "  "
        rows.append(f"{mark} {duration(option.seconds):>12}  {quality:<24} {option.told}")
    return [*rows, f"{chosen.told}: {why}"]


def require_baked_light(settings: Settings, wanted: Wanted) -> None:
    """Raises UserError: a way by baked light is wanted, and the settings bake none."""
    if wanted.way in BAKED_WAYS and settings.model.base != "baked":
        base = settings.model.base
        raise UserError(f"--way {wanted.way}: needs baked light, and model.base = {base}; type --set model.base=baked")


def _conversion_seconds(run: Run) -> float:
    """Of the workspace's scene, by the ledger; a few where it does not say."""
    found = [record.seconds for record in run.workspace.ledger.read() if record.name == "convert"]
    return found[-1] if found else 5.0


def _light_is_ready(run: Run) -> bool:
    """Whether an earlier run has baked it."""
    return (
        run.settings.model.base == "baked"
        and base_renderer(run.workspace, run.settings, run.effect_plan).light_is_baked
    )


def _no_baked_light(
    run: Run, frames: Sequence[ShotFrame], shape: Shape, ladder: Sequence[Measured], wanted: Wanted
) -> str:
    """Why baked light is out of the question, or ""."""
    if wanted.way in BAKED_WAYS:
        return "" if shape.still else "no frame stands still"
    if wanted.way == "path":
        return "path tracing is wanted"
    if any(frame.lens is not None for frame in frames):
        return "the camera has depth of field, which only path tracing has"
    if not shape.still:
        return "no frame stands still"
    if run.settings.model.base != "baked":
        return f"model.base = {run.settings.model.base}"
    if _light_is_ready(run):
        return ""
    deep = run.effect_plan.pilot.beyond(DEEP) if run.effect_plan.pilot else 0.0
    if wanted.aimless and deep > MOST_DEEP:
        return f"{deep:.1%} of the light meets more than {DEEP} surfaces, glass behind glass, as in base images"
    most = ladder[-1]
    planned = replace(shape, still=_planned(shape, wanted))
    tracing, light = path_option(most, planned).seconds, _baking_seconds(run, most)
    if tracing < light:
        return (
            f"path tracing all frames at {most.way.spp} samples takes {duration(tracing)}, baking the light about"
            f" {duration(light)}"
        )
    return ""


def _baking_seconds(run: Run, traced: Measured) -> float:
    """What baking light is expected to take. traced: what samples of camera paths take."""
    return light_plan(run.settings, run.effect_plan).paths * LIGHT_PATH * traced.pixel / traced.way.spp


def _planned(shape: Shape, wanted: Wanted) -> int:
    """Frames that stand still, of all that are to be planned for."""
    here = shape.still + shape.moving
    return round(shape.still * wanted.planned(here) / here)


def _trust_told(share: float) -> str:
    if share == 0:
        return "the shipped corrector does no good here: base images are weighed without it"
    return f"shipped corrector: {share:.0%} of it does best on the pilot's windows"


def wants_training(options: Sequence[Option], wanted: Wanted) -> bool:
    """Whether a quality is wanted that is not expected of baked light without training, nor of path tracing that takes
    no longer than baked light does, and so less than with training.

    options: the last one is what training would start from.
    """
    asked = wanted.psnr is not None or wanted.lpips is not None
    if not asked or wanted.way not in (None, "neural"):
        return False
    untrained = options[-1].seconds
    rivals = [option for option in options if option.way.name != "path"]
    if wanted.way is None:
        rivals += [option for option in options if option.way.name == "path" and option.seconds <= untrained]
    return not any(option.meets(wanted) for option in rivals)

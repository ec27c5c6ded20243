"""One workspace through the benchmark: same views, same references, one process, one clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dnrpipe.core.images import mean_known
from dnrpipe.stages.trainer import perceptual_weights
from dnrpipe.studies.frames.baselines import METHODS, Baseline, Ran, make_baselines, render_baselines
from dnrpipe.studies.frames.ours import Ours
from dnrpipe.studies.frames.pareto_front import frontier
from dnrpipe.studies.frames.scene import BenchScene, Clock, open_scene
from dnrtrain.metrics import image_metrics
from dnrtrain.perceptual import build_lpips

from .equal_time import upfront
from .moving import measure
from .reference import Reference, make_references
from .standing import class_limits, classes, standing

WARM = 2
LONGEST = 1.5
"""Of the second class's time: rivals that take longer are not tried with moving cameras."""


@dataclass(frozen=True)
class Options:
    """What is measured, and how."""

    cache: Path
    views: int = 6
    reference_spp: int = 1024
    reference: str = "auto"
    clock: str = "wall"
    threads: int = 2
    samples: tuple[int, ...] = (1, 2, 4, 8, 16, 64)
    moving: int = 24
    moving_spp: int = 512
    rays: tuple[int, ...] = ()


def bench(root: Path, options: Options, tell: Callable[[str], None]) -> dict[str, Any]:
    """All figures of one workspace, JSON-ready. Raises UserError as its parts do."""
    scene = open_scene(root, options.views, options.threads)
    torch.set_num_threads(options.threads)
    clock = Clock(options.clock, options.threads)
    folder = options.cache / scene.name
    ours = Ours(scene, options.rays)
    if ours.model is not None and ours.model.settings.trust == 0:
        ours.model = None  # no network runs: frames are base images
    reference = make_references(scene, scene.views, "test", options.reference_spp, options.reference, folder, tell)
    for turn in range(WARM):
        render_baselines(scene, scene.views[0], turn, clock, make_baselines(options.samples))
        ours.frame(scene.views[-1], clock)
    baselines = make_baselines(options.samples)
    own: dict[str, Ran] = {}
    for number, view in enumerate(scene.views):
        render_baselines(scene, view, 10_007 * (number + 1), clock, baselines)
        for name, frame in ours.frame(view, clock).items():
            ran = own.setdefault(name, Ran())
            ran.pictures.append(frame["picture"])
            for part, ms in frame["parts"].items():
                ran.parts.setdefault(part, []).append(ms)
        tell(f"{scene.name}: view {number + 1} of {len(scene.views)}")
    for baseline in baselines.values():
        if baseline.masked and baseline.method == "raw":
            tell(f"{scene.name}: repaired: {baseline.masked} pixels of {baseline.name} were not finite and are black")
    truth = [scene.shown(picture) for picture in reference.pictures]
    lpips = _lpips()
    result = _figures(scene, options, reference, truth, baselines, own, lpips)
    result["upfront"] = upfront(scene.workspace.ledger.read(), options.threads)
    if options.moving:
        best = [baselines[name] for name in result["frontier"]]
        limit = LONGEST * class_limits(scene.size)[1]
        shown = [(ran.spp, ran.method) for ran in best if ran.ms() <= limit]
        result["moving"] = measure(
            scene,
            ours,
            clock,
            shown,
            frames=options.moving,
            spp=options.moving_spp,
            kind=options.reference,
            folder=folder,
            tell=tell,
            lpips=lpips["quick"],
        )
    return result


def _figures(
    scene: BenchScene,
    options: Options,
    reference: Reference,
    truth: list[Any],
    baselines: dict[str, Baseline],
    own: dict[str, Ran],
    lpips: dict[str, Any],
) -> dict[str, Any]:
    masks = [torch.from_numpy(picture[..., 3] > 0.5).float()[None, None] for picture in reference.pictures]
    everything = {**baselines, **own}
    rows = {
        name: {
            "ms": ran.ms(),
            "parts": {part: float(np.median(values)) for part, values in ran.parts.items()},
            **_quality(ran.pictures, truth, masks, lpips["quick"]),
        }
        for name, ran in everything.items()
    }
    points = {name: (rows[name]["ms"], rows[name]["psnr"]) for name in baselines}
    best = frontier(points)
    for name in [*best, *own]:
        rows[name] |= _quality(everything[name].pictures, truth, masks, lpips["slow"])
    limits = class_limits(scene.size)
    standings = {}
    for name in own:
        point = (rows[name]["ms"], rows[name]["psnr"])
        standings[name] = {**standing(points, point), "classes": classes(points, point, limits)}
    return {
        "scene": scene.name,
        "size": list(scene.size),
        "views": [view.name for view in scene.views],
        "integrator": scene.frames.name,
        "max_depth": scene.max_depth,
        "variant": scene.engine.variant,
        "options": {k: v for k, v in asdict(options).items() if k != "cache"},
        "methods": {name: asdict(method) for name, method in METHODS.items()},
        "reference": {
            "kind": reference.kind,
            "spp": reference.spp,
            "noise_rmse": float(np.mean(reference.noise)),
            "ceiling_psnr": reference.ceiling,
        },
        "rows": rows,
        "frontier": best,
        "standing": standings,
    }


def _lpips() -> dict[str, Any]:
    """quick: by AlexNet, slow: by VGG; None where the weights are missing. See `dnrtrain.metrics.image_metrics`."""
    weights = perceptual_weights(None)
    if weights is None:
        return {"quick": None, "slow": None}
    found = build_lpips(weights)
    return {"quick": {"alex": found["alex"]}, "slow": {"vgg": found["vgg"]}}


def _quality(pictures: list[Any], truth: list[Any], masks: list[Any], lpips: Any) -> dict[str, float]:
    """Means over the views of `dnrtrain.metrics.image_metrics`; keys without a value are left out."""
    found = [
        image_metrics(picture.float(), target, mask, lpips)
        for picture, target, mask in zip(pictures, truth, masks, strict=True)
    ]
    means = {key: mean_known(row[key] for row in found) for key in found[0]}
    return {key: mean for key, mean in means.items() if mean is not None}

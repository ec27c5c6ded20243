"""Stage `evaluate`: held-out test views against path-traced references, booked as evaluation cost."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dnrtrain.contract import ContractError, View
from dnrtrain.exr import read_metadata
from dnrtrain.records import write

from ..core.cameras import spread
from ..core.errors import UserError
from ..core.images import flip_error, mean_known, picture_of, write_png
from ..core.scene_files import read_selection, split_views
from ..core.settings import Settings
from ..core.units import duration
from ..core.workspace import Workspace, digest
from .base_images import RENDERED, base_path, base_views
from .baseline import measure_baseline
from .raytrace import trace_views
from .records import METRICS, Metrics, ViewMetrics, equal_rung
from .stage import Outcome, Run
from .trainer import load, perceptual_weights, torch_device
from .trust import VIEWS, best_share

if TYPE_CHECKING:
    from dnrtrain.model import DNR

NEURAL_REPEATS = 5
BASELINE_VIEWS = 2
"""Test views on which path tracing with a denoiser is timed."""


def evaluate(run: Run) -> Outcome:
    """Trace the test views, render them with the DNR, measure, write pictures and ``metrics.json``."""
    import torch

    from dnrtrain.checkpoint import load_model
    from dnrtrain.metrics import image_metrics, psnr
    from dnrtrain.model import base_picture, render_views
    from dnrtrain.perceptual import build_lpips

    workspace, settings, console = run.workspace, run.settings, run.console
    views = split_views(workspace)["test"]
    if not views:
        raise UserError("evaluate: the workspace has no test views; prepare again with cameras.test > 0")
    trace_views(run, views, "test")
    base_views(run, views, "test")
    device = torch_device(settings)
    model = load_model(workspace.checkpoints("step2"), device)
    perceptual = perceptual_weights(console)
    lpips = build_lpips(perceptual) if perceptual else None
    rendered = settings.model.base in RENDERED
    shipped = _shipped(run, device)
    rows: list[ViewMetrics] = []
    truths: dict[str, Any] = {}
    neural_seconds: list[float] = []
    with console.bar("test views", len(views)) as bar:
        for view in views:
            data = load(workspace, [view], "test", raytraced=True, base=settings.model.base).to(device)
            seconds, prediction = _timed_render(lambda data=data: render_views(model, data), device)
            assert data.tensors.target is not None  # loaded with raytraced=True
            others = {}  # what the trained renderer is shown beside
            if settings.model.base == "baked":
                others["base"] = base_picture(data.batch([0])).clamp(0, 1).cpu()
            if shipped is not None:
                others["shipped"] = render_views(shipped, data)
            target = truths[view.name] = data.tensors.target.cpu()
            measured = image_metrics(prediction, data.tensors.target.cpu(), data.tensors.mask.cpu(), lpips)
            truth, predicted = picture_of(data.tensors.target[0]), picture_of(prediction[0])
            flip, heat = flip_error(truth, predicted)
            traced = read_metadata(workspace.raytraced("test", view.name)) or {}
            base = read_metadata(base_path(workspace, "test", view.name)) or {} if rendered else {}
            noise_rmse = traced.get("noise_rmse")
            row = ViewMetrics(
                name=view.name,
                **measured,
                flip=flip,
                ceiling_psnr=-20 * math.log10(noise_rmse) if noise_rmse else None,  # a denoiser's bias is not in it
                reference_noise=traced.get("noise"),
                reference_noise_error=traced.get("noise_error"),
                seconds_traced=traced.get("seconds"),
                seconds_neural=seconds,
                seconds_base=base.get("seconds"),
                spp=traced.get("spp"),
                **{f"psnr_{name}": _finite(float(psnr(picture, target))) for name, picture in others.items()},
            )
            rows.append(row)
            neural_seconds.append(seconds)
            files = {}
            shown = {"truth": truth, "prediction": predicted, "flip": heat}
            for kind, picture in (shown | {name: picture_of(other[0]) for name, other in others.items()}).items():
                write_png(workspace.evaluation / f"{view.name}.{kind}.png", picture)
                files[kind] = f"evaluation/{view.name}.{kind}.png"
            console.events.send("picture", split="test", view=view.name, files=files, psnr=row.psnr)
            size = {"width": view.width, "height": view.height}
            run.book("evaluation", "view", f"neural/{view.name}", seconds, device=device, **size)
            bar.advance(note=_figure(row.psnr, ".2f", " dB"))
    mean = _mean(rows)
    metrics = Metrics(
        views=rows,
        mean=mean,
        perceptual=perceptual is not None,
        trained_with_perceptual=workspace.manifest.stages["finetune"].detail.get("perceptual"),
        device=torch.cuda.get_device_name() if device.startswith("cuda") else "cpu",
        raster_engine=workspace.manifest.prepared.raster_engine if workspace.manifest.prepared else "",
        reference_noise_target=settings.raytrace.evaluation_noise,
        neural_ms=1000 * float(np.median(neural_seconds)),
        **_baseline(run, views, truths, rows, lpips["alex"] if lpips else None),
    )
    names = {view.name for view in views}
    for path in workspace.evaluation.glob("[!.]*.png"):
        if path.name.rsplit(".", 2)[0] not in names:  # of other cameras
            path.unlink()
    write(workspace.evaluation / METRICS, metrics)
    ceiling = f" (ceiling {mean['ceiling_psnr']:.1f} dB)" if mean["ceiling_psnr"] is not None else ""
    console.say(
        f"held-out over {len(rows)} views: PSNR {_figure(mean['psnr'], '.2f', ' dB')}{ceiling}, "
        f"SSIM {_figure(mean['ssim'], '.4f')}, FLIP {_figure(mean['flip'], '.4f')}"
        + (f", LPIPS {mean['lpips_alex']:.4f} (alex)" if mean["lpips_alex"] is not None else ", no LPIPS weights")
        + (f"; base image {mean['psnr_base']:.2f} dB" if mean["psnr_base"] is not None else "")
        + (f", shipped corrector {mean['psnr_shipped']:.2f} dB" if mean["psnr_shipped"] is not None else "")
    )
    if told := _tell_baseline(metrics):
        console.say(told)
    stable = [{k: v for k, v in row.data().items() if not k.startswith("seconds")} for row in rows]
    return Outcome(digest(stable), {"mean": mean, "views": len(rows), "perceptual": perceptual is not None})


def _baseline(
    run: Run, views: Sequence[View], truths: dict[str, Any], rows: list[ViewMetrics], lpips: Any
) -> dict[str, Any]:
    """Fields of `Metrics` on path tracing with a denoiser; none where the settings leave it out."""
    if not run.settings.raytrace.evaluation_baseline:
        return {}
    chosen = spread(views, BASELINE_VIEWS)
    rungs = measure_baseline(run, chosen, truths, lpips)
    names = {view.name for view in chosen}
    own = [row.psnr for row in rows if row.name in names and row.psnr is not None]
    return {"baseline": rungs, "baseline_psnr": float(np.mean(own)) if own else None}


def _tell_baseline(metrics: Metrics) -> str:
    """One line on the cheapest path tracing that is as good; "" where it was not measured."""
    if not metrics.baseline or metrics.baseline_psnr is None:
        return ""
    found = equal_rung(metrics.baseline, metrics.baseline_psnr)
    last = metrics.baseline[-1]
    if found is None:
        return f"path tracing with a denoiser is not as good at {last.spp} samples, {duration(last.seconds)} a frame"
    return f"path tracing with a denoiser is as good at {found.spp} samples, {duration(found.seconds)} a frame"


def _shipped(run: Run, device: str) -> DNR | None:
    """The shipped corrector as far as traced training views trust it; None where it corrects no baked light, or where
    no view was traced: then it is the renderer itself."""
    from dnrtrain.shipped import corrector

    names = read_selection(run.workspace).views[:VIEWS]
    if run.settings.model.base != "baked" or not names:
        return None
    model = corrector()
    traced = [view for view in split_views(run.workspace)["train"] if view.name in names]
    both = (load(run.workspace, traced, "train", raytraced=True, raw=raw, base="baked") for raw in (True, False))
    best_share(model, *both)
    return model.to(device)


def progress(workspace: Workspace, settings: Settings) -> tuple[int, int]:
    """(test views measured, test views)."""
    try:
        views = split_views(workspace).get("test", [])
    except ContractError:
        views = []  # damaged: the stage repairs it when it runs
    if not views:
        return 0, settings.cameras.test
    done = sum((workspace.evaluation / f"{view.name}.flip.png").exists() for view in views)
    return (done if (workspace.evaluation / METRICS).exists() else 0), len(views)


def _timed_render(render: Any, device: str) -> tuple[float, Any]:
    """(median seconds, picture). The first call warms up and is not counted."""
    import torch

    picture = render()
    seconds = []
    for _ in range(NEURAL_REPEATS):
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        started = time.perf_counter()
        render()
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - started)
    return float(np.median(seconds)), picture


def _mean(rows: list[ViewMetrics]) -> dict[str, float | None]:
    """The mean of each figure, over the views that have it."""
    names = [name for name in ViewMetrics.model_fields if name != "name"]
    return {name: mean_known(getattr(row, name) for row in rows) for name in names}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _figure(value: float | None, form: str, unit: str = "") -> str:
    return "not defined" if value is None else f"{value:{form}}{unit}"

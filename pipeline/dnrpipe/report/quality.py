"""``evaluation/metrics.json`` -> statistics and pictures of the held-out views."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..core.ledger import CostRecord, traced_views
from ..stages.records import Metrics, ViewMetrics
from .data import MetricRow, Quality, TestView
from .pictures import FEATURED_SIDE, THUMBNAIL_SIDE, load_png

# The first fields of a `MetricRow`.
METRICS: tuple[tuple[str, str, str, int, bool], ...] = (
    ("psnr", "PSNR over white", "dB", 2, True),
    ("psnr_shipped", "… of the shipped corrector, untrained", "dB", 2, True),
    ("psnr_base", "… of the base image", "dB", 2, True),
    ("psnr_mask", "PSNR inside the mask", "dB", 2, True),
    ("ssim", "SSIM over white", "", 4, True),
    ("ssim_mask", "SSIM inside the mask", "", 4, True),
    ("lpips_alex", "LPIPS (AlexNet)", "", 4, False),
    ("lpips_vgg", "LPIPS (VGG)", "", 4, False),
    ("flip", "FLIP", "", 4, False),
)


def build_quality(root: Path, metrics: Metrics, records: Sequence[CostRecord]) -> Quality:
    """Statistics over all views; worst, median and best view at full size, the others as thumbnails.

    records: the ledger. Ray tracing and passes count their share of the wall clock, so that they have the whole
    machine, as the network has.
    """
    ordered = sorted(metrics.views, key=_rank)
    middle = (len(ordered) - 1) // 2
    featured = {0, middle, len(ordered) - 1}
    views = [
        _view(root, view, FEATURED_SIDE if index in featured else THUMBNAIL_SIDE) for index, view in enumerate(ordered)
    ]
    names = {f"test/{view.name}" for view in views}
    recorded = [r.wall_seconds for r in traced_views(records, "evaluation", names)]
    passes = {r.name: r.wall_seconds for r in records if r.stage == "prepare" and r.name in names}

    def known(key: str) -> list[float]:
        return [value for view in views if (value := getattr(view, key)) is not None]

    neural = metrics.neural_ms / 1000 if metrics.neural_ms is not None else _mean(known("seconds_neural"))
    bases = known("seconds_base")  # a base image that is rendered brings its G-buffer along
    gbuffer = _mean(bases or list(passes.values()))
    shares = known("noise_share")
    trained = metrics.trained_with_perceptual
    return Quality(
        views=views,
        rows=[row for metric in METRICS if (row := _row(views, metric))],
        median_view=views[middle].name,
        perceptual=metrics.perceptual,
        trained_with_perceptual=metrics.perceptual if trained is None else trained,
        device=metrics.device,
        neural_seconds=neural,
        gbuffer_seconds=gbuffer,
        based=bool(bases),
        frame_seconds=None if neural is None else neural + (gbuffer or 0.0),
        traced_seconds=_mean(recorded or known("seconds_traced")),
        rivals=metrics.baseline,
        rival_psnr=metrics.baseline_psnr,
        spp=sorted({v.spp for v in views if v.spp is not None}),
        ceiling_mean=_mean(known("ceiling_psnr")),
        noise_share_mean=_mean(shares),
        noise_limited=sum(share >= 0.5 for share in shares),
    )


def _mean(values: Sequence[float]) -> float | None:
    return statistics.fmean(values) if values else None


def _rank(view: ViewMetrics) -> tuple[float, str]:
    """PSNR is null where it is not finite: a picture that is exactly right ranks last, a broken one first."""
    if view.psnr is not None:
        return view.psnr, view.name
    return (math.inf if view.ssim is not None and view.ssim > 0.9999 else -math.inf), view.name


def _view(root: Path, view: ViewMetrics, side: int) -> TestView:
    share = None
    if view.psnr is not None and view.ceiling_psnr is not None:
        # The noise of the reference adds to the squared error: MSE = MSE_model + MSE_noise.
        share = min(1.0, 10.0 ** ((view.psnr - view.ceiling_psnr) / 10.0))
    stem = f"evaluation/{view.name}"
    return TestView(
        **view.model_dump(),
        noise_share=share,
        truth=load_png(root, f"{stem}.truth.png", side=side),
        prediction=load_png(root, f"{stem}.prediction.png", side=side),
        flip_map=load_png(root, f"{stem}.flip.png", side=side, heat=True),
        base=load_png(root, f"{stem}.base.png", side=side),
        shipped=load_png(root, f"{stem}.shipped.png", side=side),
    )


def _row(views: Sequence[TestView], metric: tuple[str, str, str, int, bool]) -> MetricRow | None:
    facts: dict[str, Any] = dict(zip(MetricRow.model_fields, metric, strict=False))
    found = [(value, v.name) for v in views if (value := getattr(v, facts["key"])) is not None]
    if not found:
        return None
    values = [value for value, _ in found]
    ranked = sorted(found, reverse=not facts["higher_is_better"])
    return MetricRow(
        **facts,
        count=len(values),
        mean=statistics.fmean(values),
        median=statistics.median(values),
        worst=ranked[0][0],
        worst_view=ranked[0][1],
        best=ranked[-1][0],
        best_view=ranked[-1][1],
    )


def perceptual_note(quality: Quality, settings: dict[str, Any], *, trained: bool) -> str | None:
    """A note if training, where there was one, or evaluation had no pretrained weights, else None."""
    parts = []
    weight = settings.get("finetune", {}).get("step2", {}).get("loss", {}).get("perceptual", 0.1)
    if trained and not quality.trained_with_perceptual and weight:
        parts.append("the perceptual loss L_p was dropped in step 2, so quality does not compare with runs that had it")
    if not any(row.key.startswith("lpips") for row in quality.rows):
        parts.append("LPIPS could not be measured")
    if not parts:
        return None
    return f"Pretrained perceptual weights were missing: {'; '.join(parts)}. Fetch them with `dnrpipe weights`."

"""ReportData -> one HTML file that needs nothing else: no network, no fonts, no scripts from elsewhere."""

from __future__ import annotations

import base64
import hashlib
from importlib import resources

from jinja2 import DictLoader, Environment, StrictUndefined
from markupsafe import Markup

from ..core.units import count, duration, several
from . import charts
from .data import Quality, ReportData, Selection, Training
from .quality import METRICS

TEMPLATE = "template.html.j2"
TOTAL_STYLE = 6  # the sum of all terms is drawn in ink, whatever its place in the list
LOSS_NAMES = {
    "rl": "L_RL",
    "dnr": "L_DNRc",
    "photometric": "photometric",
    "ssim": "1 − SSIM",
    "perceptual": "L_p (VGG)",
    "frequency": "L_FR (FFT)",
    "total_variation": "L_TV",
    "regularisation": "L_reg(T)",
    "total": "weighted sum",
}


def render_html(data: ReportData) -> str:
    """The page as HTML: the same bytes for the same data.

    It escapes every string from the scene, and its content security policy allows our script only.
    """
    files = resources.files("dnrpipe.report")
    environment = Environment(
        loader=DictLoader({TEMPLATE: (files / TEMPLATE).read_text(encoding="utf-8")}),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(duration=duration, count=count, several=several)
    script = "".join((files / name).read_text(encoding="utf-8") for name in ("sphere.js", "report.js"))
    script_hash = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    quality, selection = data.quality, data.selection
    return environment.get_template(TEMPLATE).render(
        d=data,
        css=Markup((files / "report.css").read_text(encoding="utf-8")),
        script=Markup(script),
        script_hash=script_hash,
        eye=f"{charts.AZIMUTH:.6f} {charts.ELEVATION:.6f}",
        rows=dict.fromkeys(metric[0] for metric in METRICS) | {r.key: r for r in (quality.rows if quality else ())},
        featured=_featured(quality) if quality else [],
        median=next(v for v in quality.views if v.name == quality.median_view) if quality else None,
        projections=[(n, charts.sphere_svg(data.sphere, n)) for n in charts.PROJECTIONS] if data.sphere else [],
        quality_chart=_quality_chart(quality) if quality else "",
        loss_charts=[(t, [_loss_chart(t), _psnr_chart(t), _agent_chart(t)]) for t in data.training],
        stage_chart=_stage_chart(data),
        tracing_chart=_tracing_chart(data),
        views_chart=_views_chart(selection) if selection else "",
    )


def _featured(quality: Quality) -> list[tuple[str, int]]:
    """(role, index into quality.views) of worst, median and best; one view may play several roles."""
    last = len(quality.views) - 1
    roles: dict[int, list[str]] = {}
    for role, index in (("worst", 0), ("median", last // 2), ("best", last)):
        roles.setdefault(index, []).append(role)
    return [(" and ".join(names), index) for index, names in roles.items()]


def _quality_chart(quality: Quality) -> Markup:
    dots = [
        charts.Dot(
            label=view.name,
            value=view.psnr,
            mark=view.ceiling_psnr,
            title=f"{view.name}: {view.psnr:.2f} dB"
            + (f", ceiling {view.ceiling_psnr:.2f} dB" if view.ceiling_psnr is not None else ""),
        )
        for view in quality.views
        if view.psnr is not None
    ]
    return charts.dot_chart(dots, "PSNR of each test view", "test views, worst first", "PSNR, dB")


def _loss_chart(training: Training) -> Markup:
    series = [
        charts.Series(LOSS_NAMES.get(name, name.replace("_", " ")), points, TOTAL_STYLE if name == "total" else None)
        for name, points in training.losses.items()
    ]
    return charts.line_chart(
        series, f"Loss terms of step {training.step}", "epoch", "loss terms before weighting, log scale", log=True
    )


def _agent_chart(training: Training) -> Markup:
    series = [charts.Series({"q": "Q"}.get(name, name), points) for name, points in training.agent.items()]
    title = "Reward and action value of the view selector"
    return charts.line_chart(series, title, "epoch", "selector: mean reward and action value Q")


def _psnr_chart(training: Training) -> Markup:
    series = [charts.Series("validation", training.psnr)] if training.psnr else []
    target = "rasterised" if training.step == 1 else "ray-traced"
    title = f"Validation PSNR of step {training.step}"
    return charts.line_chart(series, title, "epoch", f"PSNR against {target} images, dB")


def _stage_chart(data: ReportData) -> Markup:
    if not data.costs:
        return Markup("")
    bars = []
    for stage, purposes in data.costs.by_stage_and_purpose.items():
        segments = [
            charts.Segment(f"bar-{purpose}", value.wall_seconds, f"{stage}, {purpose}: {duration(value.wall_seconds)}")
            for purpose, value in purposes.items()
        ]
        whole = sum(segment.value for segment in segments)
        bars.append(charts.Bar(stage, segments, duration(whole)))
    return charts.bar_chart(bars, "Wall seconds per stage")


def _tracing_chart(data: ReportData) -> Markup:
    tracing = data.costs.tracing_all if data.costs else None
    if not tracing:
        return Markup("")
    chosen = [
        charts.Segment("bar-training", tracing.actual_seconds, f"ray tracing: {duration(tracing.actual_seconds)}"),
        charts.Segment("bar-choosing", tracing.selection_seconds, f"choosing: {duration(tracing.selection_seconds)}"),
    ]
    everything = charts.Segment("bar-training", tracing.all_seconds, f"ray tracing: {duration(tracing.all_seconds)}")
    spent = tracing.actual_seconds + tracing.selection_seconds
    return charts.bar_chart(
        [
            charts.Bar(f"{tracing.views} chosen", chosen, duration(spent)),
            charts.Bar(f"all {tracing.candidates}", [everything], duration(tracing.all_seconds)),
        ],
        "Ray tracing the chosen views against ray tracing all candidates",
    )


def _views_chart(selection: Selection) -> Markup:
    dots = [
        charts.Dot(
            label=str(view.order),
            value=view.seconds,
            title=f"{view.name}: {duration(view.seconds)}"
            + (f" at {view.spp} spp" if view.spp else "")
            + (f", relative error {100 * view.noise:.1f} %" if view.noise is not None else ""),
        )
        for view in selection.views
        if view.seconds is not None
    ]
    return charts.dot_chart(
        dots, "Seconds per ray-traced view", "chosen views, in order", "seconds on one worker", from_zero=True
    )

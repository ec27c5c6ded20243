"""What the report shows, as plain data: `collect` fills it, `render` draws it, report.json holds it for machines.

Lengths are in scene units, times in seconds (wall unless said), image metrics in display space.
``None`` means "not made yet" or "not measured", never zero.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from ..core.ledger import CostSummary
from ..stages.records import BaselineRung, ViewMetrics


class _Frozen(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Picture(_Frozen):
    """An image as a data URI. ``file``: where the full-size original lies, relative to the workspace."""

    uri: str = Field(repr=False, exclude=True)
    width: int
    height: int
    file: str


class TestView(ViewMetrics):
    """Metrics and pictures of one held-out view.

    noise_share: share of the measured squared error that is the reference's own noise, in [0, 1]
    (10^((psnr − ceiling) / 10)); None where the ceiling was not measured.
    base, shipped: the base image, and the shipped corrector without training; None where there is none.
    """

    __test__ = False  # not a pytest class

    noise_share: float | None
    truth: Picture | None
    prediction: Picture | None
    flip_map: Picture | None
    base: Picture | None = None
    shipped: Picture | None = None


class MetricRow(_Frozen):
    """Statistics of one metric over the held-out views that have it."""

    key: str
    label: str
    unit: str
    digits: int
    higher_is_better: bool
    count: int
    mean: float
    median: float
    worst: float
    worst_view: str
    best: float
    best_view: str


class Quality(_Frozen):
    """Held-out quality. ``views`` are sorted from the worst PSNR to the best.

    neural_seconds: the network alone; gbuffer_seconds: Blender's passes of such a view (None where the
    ledger has none), or the base image where one is rendered (``based``);
    frame_seconds: both; traced_seconds: path tracing. All per frame, on the wall clock.
    rivals: path tracing with a denoiser on a few of the views; rival_psnr: the renderer's PSNR on those.
    perceptual: the evaluation had LPIPS weights; trained_with_perceptual: L_p was among the losses.
    """

    views: list[TestView]
    rows: list[MetricRow]
    median_view: str
    perceptual: bool
    trained_with_perceptual: bool
    device: str
    neural_seconds: float | None
    gbuffer_seconds: float | None
    based: bool
    frame_seconds: float | None
    traced_seconds: float | None
    rivals: list[BaselineRung]
    rival_psnr: float | None
    spp: list[int]
    ceiling_mean: float | None
    noise_share_mean: float | None
    noise_limited: int


class SphereView(_Frozen):
    """A camera centre. ``position`` is relative to the scene's centre, divided by ``Sphere.scale``."""

    name: str
    role: Literal["candidate", "chosen", "test"]
    order: int | None
    position: tuple[float, float, float]
    psnr: float | None = None


class Sphere(_Frozen):
    """All cameras. scale: distance of the farthest one; radius: the scene's, in units of ``scale``."""

    views: list[SphereView]
    scale: float
    radius: float


class ChosenView(_Frozen):
    """One selected view, in the order of selection (from 1)."""

    order: int
    name: str
    seconds: float | None = None
    spp: int | None = None
    noise: float | None = None
    raster: Picture | None
    traced: Picture | None
    why: str | None


class CoverageMaps(_Frozen):
    """The atlas, V upwards, in cells; transparent where no view looks, red where candidates do and no chosen view.

    seen: how many chosen views see a cell, yellow at ``most``. angle: mean angle between the directions from which
    the views and the nearest chosen view see it, the scale ends at ``farthest`` degrees. uncovered: share of the views'
    pixels whose surface no chosen view sees. views_read: of how many ``candidates`` that is.
    """

    seen: Picture
    angle: Picture
    most: int
    farthest: float
    uncovered: float
    mean_angle: float | None
    views_read: int
    candidates: int


class Selection(_Frozen):
    """`selection.json`, and how many of its views are traced.

    trained: whether step 1 was trained for it. measure: the unit of a policy's gains.
    """

    policy: str
    seed: int | None
    budget: int
    views: list[ChosenView]
    traced: int
    candidates: int
    trained: bool
    measure: str | None
    coverage: CoverageMaps | None


class Training(_Frozen):
    """History of one training step. Points are (epoch from 1, value).

    losses: means of each loss term, before weighting. agent: reward and action value of the selector.
    """

    step: int
    title: str
    epochs: int
    seconds: float
    skipped: int
    losses: dict[str, list[tuple[int, float]]]
    agent: dict[str, list[tuple[int, float]]]
    psnr: list[tuple[int, float]]


class FindingGroup(_Frozen):
    """Findings of the same kind, most serious kinds first."""

    kind: str
    meaning: str
    serious: bool
    findings: list[dict[str, str]]


class Missing(_Frozen):
    """A part of the report whose stage has not run, and the command that makes it."""

    what: str
    command: str


class PlannedRow(_Frozen):
    """One line of predicted against actual."""

    what: str
    predicted: str
    actual: str


class Budget(_Frozen):
    """Cost and benefit, in sentences.

    following: what the next minute would buy. pictures: (caption, data URI) of the frontier for each number of frames.
    """

    cost: str
    bought: str
    following: str
    rows: list[PlannedRow]
    why: list[str]
    routes: list[str]
    pictures: list[tuple[str, str]] = Field(repr=False, exclude=True)


class ReportData(_Frozen):
    """Everything on the page. `model_dump` leaves out the bytes of the pictures."""

    title: str
    workspace: str
    source_name: str
    source_sha256: str
    preset: str
    resolution: str | None
    made_at: str
    verdict: str
    notes: list[str]
    missing: list[Missing]
    quality: Quality | None
    selection: Selection | None
    sphere: Sphere | None
    training: list[Training]
    costs: CostSummary | None
    budget: Budget | None = None
    break_even: int | None
    upfront_seconds: float | None
    findings: list[FindingGroup]
    summary: list[tuple[str, str]]
    settings: list[tuple[str, str, bool]]
    versions: list[tuple[str, str]]

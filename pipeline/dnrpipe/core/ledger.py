"""The ledger: what every piece of work cost, one JSON line each (``costs.jsonl``).

The ledger books work that makes training data or weights as ``training``. It books ray-traced references of held-out
views as ``evaluation``: who only wants the renderer never pays for them. It books frames of the finished renderer as
``inference``.

Seconds are wall seconds of one unit of work. Units that ran side by side have ``workers`` > 1: their share of the wall
clock is ``seconds / workers``. That is exact where the workers were busy throughout, else an estimate.
"""

from __future__ import annotations

import errno
import json
import math
import os
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, Field, ValidationError, field_validator

from dnrtrain.settings import Strict

from .errors import UserError

StageName = Literal["prepare", "plan", "select", "raytrace", "finetune", "evaluate", "render"]
Purpose = Literal["training", "evaluation", "inference"]
Unit = Literal["scene", "view", "epoch", "overhead"]
"""overhead: what a step of a stage took beside its work: starting processes, loading, waiting, writing files."""
UpfrontPart = Literal["conversion", "passes", "pilot", "selection", "tracing", "light", "base images", "training"]


class CostRecord(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """One unit of work that cost time.

    Args:
        time: unix seconds when it ended.
        name: what it was, e.g. ``train/0007`` or ``epoch 3``.
        seconds: wall clock.
        cpu_seconds: of the process.
        workers: how many such units ran side by side.
        width, height: pixels.
        peak_mb: peak memory, MiB.
        noise: estimated relative error of the ray-traced view.
        cache_hit: the result was found, not computed; ``seconds`` is then what the look-up took.
        detail: anything JSON-able, without NaN.
    """

    time: float = Field(ge=0)
    run: str
    stage: StageName
    purpose: Purpose
    unit: Unit
    name: str
    seconds: float = Field(ge=0)
    cpu_seconds: float = Field(default=0.0, ge=0)
    device: str = "cpu"
    workers: int = Field(default=1, ge=1)
    width: int | None = Field(default=None, ge=1)
    height: int | None = Field(default=None, ge=1)
    spp: int | None = Field(default=None, ge=1)
    steps: int | None = Field(default=None, ge=0)
    peak_mb: float | None = Field(default=None, ge=0)
    noise: float | None = Field(default=None, ge=0)
    cache_hit: bool = False
    detail: dict[str, Any] = Field(default_factory=dict)

    @field_validator("detail")
    @classmethod
    def _json(cls, value: dict[str, Any]) -> dict[str, Any]:
        try:
            json.dumps(value, allow_nan=False)
        except TypeError as error:  # pydantic turns ValueError into ValidationError, not TypeError
            raise ValueError(str(error)) from None
        return value

    @property
    def wall_seconds(self) -> float:
        """Share of the wall clock: seconds divided by how many units ran side by side."""
        return self.seconds / self.workers


class Ledger:
    """An append-only file of cost records. Several processes may append at once.

    It is the one file that is not written by temp + rename: a rename would lose a concurrent append. Each record is a
    single ``write`` with O_APPEND and an fsync: a crash truncates one record, no more.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.booked = 0.0
        """Wall seconds of all that was appended through this object."""

    def append(self, record: CostRecord) -> None:
        """Append one record, durably. After a truncated record it starts a new line first.

        Raises:
            OSError: the file cannot be written (read-only, disk full).
        """
        line = json.dumps(record.model_dump(), allow_nan=False).encode("ascii") + b"\n"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a+b", buffering=0) as file:
            if file.seek(0, os.SEEK_END) > 0:
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":
                    line = b"\n" + line
            written = file.write(line)
            if written != len(line):
                raise OSError(errno.ENOSPC, f"only {written} of {len(line)} bytes written", str(self.path))
            os.fsync(file.fileno())
        self.booked += record.wall_seconds

    def read(self) -> list[CostRecord]:
        """All whole records in file order; [] when there is no ledger yet. Truncated records are left out.

        Raises:
            UserError: a whole line is not a cost record (foreign file, newer version).
        """
        return self._parse()[0]

    def truncated_records(self) -> int:
        """How many records a crash cut short: work whose cost is not in the sums."""
        return self._parse()[1]

    def _parse(self) -> tuple[list[CostRecord], int]:
        try:
            data = self.path.read_bytes()
        except FileNotFoundError:
            return [], 0
        records: list[CostRecord] = []
        truncated = 0
        for number, line in enumerate(data.split(b"\n"), start=1):
            if not line.strip():
                continue
            try:
                value = json.loads(line)
            except ValueError:  # JSONDecodeError, and UnicodeDecodeError of a block of zeros or noise
                truncated += 1
                continue
            try:
                records.append(CostRecord.model_validate(value))
            except ValidationError as error:
                first = error.errors()[0]
                where = ".".join(str(part) for part in first["loc"]) or "record"
                raise UserError(
                    f"{self.path}:{number}: not a cost record ({where}: {first['msg'].lower()}); "
                    "move the file away to start a new ledger"
                ) from None
        return records, truncated


class CostSum(Strict):
    """Totals of some records. seconds: summed over units; wall_seconds: estimate on the wall clock."""

    seconds: float = 0.0
    wall_seconds: float = 0.0
    cpu_seconds: float = 0.0
    records: int = 0
    cache_hits: int = 0
    peak_mb: float | None = None


def total(records: Iterable[CostRecord]) -> CostSum:
    """Sum of the records; seconds are summed exactly (fsum), so the order does not matter."""
    chosen = list(records)
    peaks = [r.peak_mb for r in chosen if r.peak_mb is not None]
    return CostSum(
        seconds=math.fsum(r.seconds for r in chosen),
        wall_seconds=math.fsum(r.wall_seconds for r in chosen),
        cpu_seconds=math.fsum(r.cpu_seconds for r in chosen),
        records=len(chosen),
        cache_hits=sum(r.cache_hit for r in chosen),
        peak_mb=max(peaks) if peaks else None,
    )


def total_by(field: Literal["stage", "purpose"], records: Sequence[CostRecord]) -> dict[str, CostSum]:
    """Totals per stage or purpose, in the order of `StageName` and `Purpose`; those without records are absent."""
    order = get_args(StageName if field == "stage" else Purpose)
    sums = {name: total(r for r in records if getattr(r, field) == name) for name in order}
    return {name: value for name, value in sums.items() if value.records}


def traced_views(records: Sequence[CostRecord], purpose: str, only: Collection[str] | None = None) -> list[CostRecord]:
    """The last computed record of each ray-traced view, in order of appearance. Cache hits are left out.

    A view that was traced twice (other spp, other settings) counts once, with what it costs now. Ray tracing is what
    has samples per pixel, whichever stage asked for it.

    only: names such as ``train/0007`` to keep, e.g. those of the present selection.
    """
    latest: dict[str, CostRecord] = {}
    for record in records:
        traced = record.unit == "view" and record.spp is not None and record.stage in ("raytrace", "evaluate")
        if traced and record.purpose == purpose and not record.cache_hit:
            latest[record.name] = record
    return [_whole(record) for name, record in latest.items() if only is None or name in only]


def _whole(record: CostRecord) -> CostRecord:
    """With the seconds of earlier runs whose samples went into it (booked then): what the view costs."""
    earlier = record.detail.get("earlier_seconds", 0.0)
    cpu = record.detail.get("earlier_cpu_seconds", 0.0)
    if not earlier:
        return record
    return record.model_copy(update={"seconds": record.seconds + earlier, "cpu_seconds": record.cpu_seconds + cpu})


def latest_epochs(records: Sequence[CostRecord]) -> list[CostRecord]:
    """The last record of each epoch of step 1: what it costs once, repeated runs left out."""
    return list({r.name: r for r in records if r.stage == "select" and r.unit == "epoch"}.values())


def selection_cost(records: Sequence[CostRecord]) -> CostSum:
    """What the present selection cost: step 1's epochs, or the last choice that needed no training."""
    chosen = [r for r in records if r.stage == "select" and r.unit != "overhead" and not r.cache_hit]
    if chosen and chosen[-1].unit != "epoch":
        return total(chosen[-1:])
    return total(latest_epochs(records))


def upfront_work(
    records: Iterable[CostRecord], only: Collection[str] | None = None
) -> dict[UpfrontPart, list[CostRecord]]:
    """What comes before the first neural frame, by kind: each unit of training work once, at its latest cost.

    Repeated runs, cache hits and evaluation are left out, and so are traced views and base images that are no longer
    chosen (``only``, see `traced_views`). A caller that does not count a kind of work leaves its part out; `total` sums
    a part by either clock.
    """
    latest: dict[tuple[UpfrontPart, str, str], CostRecord] = {}
    for record in records:
        if record.purpose != "training" or record.cache_hit:
            continue
        part = _upfront_part(record)
        traced = record.unit == "view" and part in ("tracing", "base images")
        if only is not None and traced and record.name.removeprefix("base/") not in only:
            continue
        step = record.stage if record.unit == "epoch" else ""  # step 1 and step 2 count their epochs alike
        latest[part, step, record.name] = _whole(record)
    work: dict[UpfrontPart, list[CostRecord]] = {part: [] for part in get_args(UpfrontPart)}
    for (part, _, _), record in latest.items():
        work[part].append(record)
    return work


def _upfront_part(record: CostRecord) -> UpfrontPart:
    if record.unit == "epoch" or (record.unit, record.stage) == ("overhead", "finetune"):
        return "training"
    if record.unit == "scene" and record.name == "light":  # whichever stage baked it
        return "light"
    if record.stage == "prepare":
        return "passes" if record.unit == "view" else "conversion"
    if record.stage == "plan":
        return "pilot"
    if record.stage == "select":
        return "selection"
    return "base images" if record.name.startswith("base/") else "tracing"


def upfront_seconds(records: Iterable[CostRecord], only: Collection[str] | None = None) -> float:
    """Wall seconds of all `upfront_work`: how long it took until the renderer was there."""
    return total(record for part in upfront_work(records, only).values() for record in part).wall_seconds


class TracingComparison(Strict):
    """Ray-tracing the chosen views against ray-tracing every candidate, in wall seconds.

    ``saved_seconds`` is gross. ``net_saved_seconds`` takes off what choosing the views cost (stage ``select``); it is
    negative where choosing cost more than it saved.
    """

    views: int
    candidates: int
    seconds_per_view: float
    actual_seconds: float
    all_seconds: float
    saved_seconds: float
    selection_seconds: float
    net_saved_seconds: float


def tracing_all_would_cost(
    records: Sequence[CostRecord], n_candidates: int, only: Collection[str] | None = None
) -> TracingComparison | None:
    """Mean seconds per ray-traced training view × candidates, against what was spent on the chosen ones.

    It assumes that the other candidates would cost what the traced ones cost on average. None while no training view
    was traced. only: see `traced_views`. Raises ValueError when ``n_candidates`` is negative.
    """
    if n_candidates < 0:
        raise ValueError(f"n_candidates must not be negative, is {n_candidates}")
    views = traced_views(records, "training", only)
    if not views:
        return None
    actual = math.fsum(r.wall_seconds for r in views)
    mean = actual / len(views)
    everything = mean * max(n_candidates, len(views))
    selection = selection_cost(records).wall_seconds
    return TracingComparison(
        views=len(views),
        candidates=max(n_candidates, len(views)),
        seconds_per_view=mean,
        actual_seconds=actual,
        all_seconds=everything,
        saved_seconds=everything - actual,
        selection_seconds=selection,
        net_saved_seconds=everything - actual - selection,
    )


def break_even_frames(upfront_seconds: float, traced_frame: float, neural_frame: float) -> int | None:
    """From how many frames on the neural renderer, made in ``upfront_seconds``, has paid for itself.

    ``traced_frame`` and ``neural_frame``: seconds per frame. None where a neural frame is not cheaper.
    """
    gain = traced_frame - neural_frame
    return math.ceil(upfront_seconds / gain) if gain > 0 else None


class RaytracedSum(Strict):
    """The ray-traced views of one purpose.

    Args:
        spp: all numbers of samples per pixel that they have.
        seconds_per_view: mean, on one worker.
        slowest_view_seconds: on one worker.
        noise: mean estimated relative error; None where it is unknown.
    """

    views: int
    spp: list[int]
    seconds_per_view: float
    slowest_view_seconds: float
    wall_seconds: float
    noise: float | None


class CostSummary(Strict):
    """What ``dnrpipe costs`` and the report print. Every run is in the sums, repeated work too.

    Args:
        total, by_stage, by_purpose, by_stage_and_purpose: sums; stages and purposes without records are absent.
        raytraced: by purpose.
        tracing_all: None without ray-traced training views, or where the candidates are not known.
        runs: how many commands have booked something.
        torn_lines: truncated records, whose seconds are not counted.
    """

    total: CostSum
    by_stage: dict[str, CostSum]
    by_purpose: dict[str, CostSum]
    by_stage_and_purpose: dict[str, dict[str, CostSum]]
    raytraced: dict[str, RaytracedSum]
    tracing_all: TracingComparison | None
    runs: int
    devices: list[str]
    torn_lines: int


def summarise(
    records: Sequence[CostRecord],
    *,
    n_candidates: int | None = None,
    only: Collection[str] | None = None,
    truncated_records: int = 0,
) -> CostSummary:
    """Sum up a ledger.

    Args:
        n_candidates: number of candidate views; without it ``tracing_all`` is None.
        only: names of the training views that count as chosen (``train/0007``); None = all in the ledger.
    """
    stages = total_by("stage", records)
    traced = {p: traced_views(records, p, only if p == "training" else None) for p in get_args(Purpose)}
    return CostSummary(
        total=total(records),
        by_stage=stages,
        by_purpose=total_by("purpose", records),
        by_stage_and_purpose={name: total_by("purpose", [r for r in records if r.stage == name]) for name in stages},
        raytraced={purpose: _raytraced(views) for purpose, views in traced.items() if views},
        tracing_all=None if n_candidates is None else tracing_all_would_cost(records, n_candidates, only),
        runs=len({r.run for r in records}),
        devices=sorted({r.device for r in records}),
        torn_lines=truncated_records,
    )


def _raytraced(views: Sequence[CostRecord]) -> RaytracedSum:
    noises = [r.noise for r in views if r.noise is not None]
    return RaytracedSum(
        views=len(views),
        spp=sorted({r.spp for r in views if r.spp is not None}),
        seconds_per_view=math.fsum(r.seconds for r in views) / len(views),
        slowest_view_seconds=max(r.seconds for r in views),
        wall_seconds=math.fsum(r.wall_seconds for r in views),
        noise=math.fsum(noises) / len(noises) if noises else None,
    )

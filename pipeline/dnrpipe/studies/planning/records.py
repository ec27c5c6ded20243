"""What the pilot measured and what the plan says, as they stand in ``plan/pilot.json`` and ``plan/plan.json``.

Seconds are on the wall clock unless ``cpu_`` says processor time. PSNR is in display space over white, dB.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dnrtrain.atomic import write_json

from ...core.errors import UserError

FOLDER = "plan"
SCHEMA = 1
OPTIONAL = frozenset({"routes", "routes_psnr", "break_even", "train", "carried_out", "actual"})
"""Keys of ``plan.json`` that are absent where they were not asked for or have not happened."""
RENDERER_STAGES = ("select", "raytrace", "finetune")
"""Stages until the renderer is there."""
Clock = Literal["seconds", "cpu_seconds"]


class Record(BaseModel):
    """Frozen, without unknown keys, without NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Traced(Record):
    """One path-traced view. noise_rmse: of the picture as it is used (denoised where the settings say so); raw_rmse: as
    it was traced."""

    spp: int
    pixels: int
    seconds: float
    cpu_seconds: float
    noise_rmse: float | None
    raw_rmse: float | None = None


class TracePart(Record):
    """startup: seconds until the workers traced their first small view, kernels compiled before; workers: side by
    side."""

    points: list[Traced]
    workers: int
    startup: float


class LightPoint(Record):
    """One bake of light: texels of the side, paths per texel."""

    size: int
    spp: int
    seconds: float
    cpu_seconds: float


class LightPart(Record):
    """One bake. startup: of the worker. kept: it is the real light, on disk and in the ledger as such."""

    bake: LightPoint
    kept: bool
    startup: float


class BasePart(Record):
    """Base images at the pilot's size, seconds each (median); startup: of the worker, kernels compiled before."""

    pixels: int
    seconds: float
    cpu_seconds: float
    startup: float


class TrainingPart(Record):
    """Networks trained anew with rising numbers of steps. seconds, cpu_seconds: of one optimiser step of the longest
    training; between, cpu_between: from one epoch to the next, when the state is saved; startup: what is left."""

    views: int
    spp: int
    steps: list[int]
    pixels: int
    seconds: float
    cpu_seconds: float
    between: float
    cpu_between: float
    startup: float
    threads: int


class FramePoint(Record):
    """One way to render a frame: milliseconds (processor time over the threads) and mean PSNR, the
    references' noise not counted."""

    name: str
    ms: float
    psnr: float


class FramePart(Record):
    """Frames of the pilot's held-out views.

    neural: a point per training. rival: path tracing with a denoiser, the baselines. deviation: of the base image's
    PSNR over these views, dB. shipped: the shipped corrector, as far as it is trusted; None where it corrects no such
    base image.
    """

    base: FramePoint
    shipped: FramePoint | None = None
    neural: list[FramePoint]
    rival: list[FramePoint]
    views: int
    deviation: float


class Pilot(Record):
    """``plan/pilot.json``. Parts that have not run are None. light: None where no light is baked, too."""

    fingerprint: str
    size: tuple[int, int]
    load: float | None = None
    trace: TracePart | None = None
    light: LightPart | None = None
    base: BasePart | None = None
    training: TrainingPart | None = None
    frames: FramePart | None = None
    seconds: float = 0.0
    """wall seconds that the parts took together"""


class Choice(Record):
    """views to ray-trace, samples per pixel, passes over the views."""

    views: int
    spp: int
    epochs: int
    steps: int


class Interval(Record):
    """A prediction; nine times in ten the value lies between low and high."""

    expected: float
    low: float
    high: float


class Seconds(Record):
    """Predicted seconds by stage until the renderer is made; ``evaluate`` is not part of ``total``."""

    select: float
    raytrace: float
    finetune: float
    evaluate: float
    total: Interval


class Prediction(Record):
    """A choice with what it is expected to cost and give."""

    choice: Choice
    seconds: Seconds
    cpu_seconds: float
    psnr: Interval


class Route(Record):
    """One way to N frames. total = upfront + frames x frame, seconds; psnr: what it gives."""

    name: str
    what: str
    upfront: float
    frame: float
    total: float
    psnr: float | None
    reaches: bool


class Wanted(Record):
    """What was asked for; all None: a table of budgets. seconds: of work from here on. frames: to be rendered."""

    seconds: float | None = None
    psnr: float | None = None
    frames: int | None = None


class PilotFacts(Record):
    """The pilot that a plan counts on. load: of the machine while it ran."""

    fingerprint: str
    seconds: float
    load: float | None


class PriorFacts(Record):
    """The prior that a plan counts on; see `quality.Prior`."""

    source: str
    scenes: list[str]
    sd: float


class Actual(Record):
    """What carrying the plan out took and gave. seconds: by stage, ``total`` is without evaluation. ran: by stage,
    False where it was done before."""

    seconds: dict[str, float]
    cpu_seconds: float
    ran: dict[str, bool]
    psnr: float | None


class Plan(Record):
    """``plan/plan.json``.

    Args:
        made: unix seconds.
        base_psnr: of the base image alone, as a report would measure it.
        gain: dB that the network adds with many views and steps.
        chosen: None where a table was asked for, or where nothing reaches the target.
        routes: to the wanted frames at ``routes_psnr``, the cheapest first.
        break_even: frames from which on the neural renderer is cheaper than path tracing; None where it never is, or
            where one of them does not reach the PSNR.
        train: whether the neural renderer is the cheapest route.
        carried_out: the choice once its steps fit the time that ray tracing left.
    """

    model_config = ConfigDict(populate_by_name=True)

    schema_version: Literal[1] = Field(default=SCHEMA, alias="schema")
    made: float
    wanted: Wanted
    pilot: PilotFacts
    policy: str
    base_psnr: float
    gain: float
    chosen: Prediction | None
    table: list[Prediction]
    prior: PriorFacts
    settings_default: Prediction
    routes: list[Route] | None = None
    routes_psnr: float | None = None
    break_even: int | None = None
    train: bool | None = None
    carried_out: Prediction | None = None
    actual: Actual | None = None

    def data(self) -> dict[str, Any]:
        return self.model_dump(mode="json", by_alias=True, exclude=set(OPTIONAL - self.model_fields_set))


def read_plan(root: Path) -> Plan | None:
    """The plan of a workspace's folder, None where there is none. Raises UserError: damaged, or of another version."""
    path = root / FOLDER / "plan.json"
    try:
        return Plan.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValidationError:
        raise UserError(f"{path}: damaged; run `dnrpipe plan` again") from None


def write_plan(root: Path, plan: Plan) -> None:
    write_json(root / FOLDER / "plan.json", plan.data())

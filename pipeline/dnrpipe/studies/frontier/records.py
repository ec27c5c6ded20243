"""What the frontier measured, as it stands in ``frontier/results.json``, and what its workers are asked.

Seconds are processor seconds: see `point_costs`. PSNR is in dB.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import AliasChoices, BaseModel, ConfigDict, Field, ValidationError

from ...blender.tasks import CyclesTask
from ...core.errors import UserError
from ...core.settings import Settings
from ..cells.results import read_made
from ..cells.tasks import PoolTask

SCHEMA = 1
Metric = Literal["psnr", "ssim", "lpips_vgg", "flip"]


def file_key(name: str, attribute: str, default: Any = ...) -> Any:
    """A field whose key in files is ``name``; it may be given by either."""
    return Field(default=default, validation_alias=AliasChoices(name, attribute), serialization_alias=name)


class Record(BaseModel):
    """Fields that were not given are not written."""

    model_config = ConfigDict(frozen=True)

    def data(self) -> dict[str, Any]:
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)


class Measured(Record):
    """Means over the test views; None where there are no perceptual weights, or no mask."""

    name: str
    psnr: float
    psnr_mask: float | None = None
    ssim: float | None
    ssim_mask: float | None = None
    lpips_vgg: float | None
    lpips_alex: float | None = None
    flip: float | None


class Point(Measured):
    """A trained model, or the base image alone.

    Args:
        kind: ours; random and all: other views; paper: the paper's model; base: no network.
        parts: seconds before the first frame, by kind of work; ``upfront`` is their sum.
        network_ms, base_ms: parts of a frame as they were measured in the point's own cell.
        frame_ms: a frame, once points of one model share the network's least milliseconds.
        baseline_ms: a frame of path tracing at the point's PSNR; None where no baseline reaches it.
        break_even: frames from which on training is cheaper than path tracing; None where it never is.
        ceiling: PSNR that a perfect renderer would measure against the noisy references.
    """

    kind: Literal["ours", "random", "all", "paper", "base"]
    seed: int = 0
    views: int
    spp: int | None
    steps: int | None
    parts: dict[str, float] = Field(default_factory=dict)
    upfront: float
    network_ms: float = 0.0
    base_ms: float = 0.0
    ceiling: float | None = None
    frame_ms: float = 0.0
    baseline_ms: float | None = file_key("rival_ms", "baseline_ms", None)
    break_even: int | None = None

    @property
    def ms(self) -> float:
        return self.frame_ms


class BaselinePoint(Measured):
    """Frames of path tracing or of Cycles.

    ms: of a frame, median over the views. masked: pixels that were not finite, and are black.
    """

    upfront: ClassVar[float] = 0.0
    spp: int
    denoised: bool
    ms: float
    masked: int = 0

    @property
    def by_cycles(self) -> bool:
        return self.name.startswith(CYCLES_PREFIX)


CYCLES_PREFIX = "Cycles "


class FrontierResults(Record):
    """``frontier/results.json``. The first fields are of `results.made_by`.

    Args:
        sweep: fields of `measure_frontier.Sweep`.
        frames: numbers of frames that are compared for.
        threads, baseline_threads: of cells, and of path tracing.
        pareto: by number of frames, what nothing else beats, cheapest first.
    """

    schema_version: int = file_key("schema", "schema_version")
    command: str
    commit: str | None
    dirty: bool = False
    date: str
    machine: dict[str, Any]
    versions: dict[str, str | None] = Field(default_factory=dict)
    scene: str
    preset: str = ""
    resolution: str
    sweep: dict[str, Any] = Field(default_factory=dict)
    frames: list[int]
    cores: int
    test_views: int
    evaluation_spp: int
    threads: int = 1
    baseline_threads: int = file_key("rival_threads", "baseline_threads", 1)
    points: list[Point]
    baselines: list[BaselinePoint] = file_key("rungs", "baselines")
    pareto: dict[str, list[str]] = Field(default_factory=dict)

    @property
    def everything(self) -> dict[str, Point | BaselinePoint]:
        """Points and baselines by name."""
        return {one.name: one for one in (*self.points, *self.baselines)}


def read_frontier(path: Path) -> FrontierResults:
    """``frontier/results.json``. Raises UserError: missing, damaged or of another schema."""
    try:
        return FrontierResults.model_validate(read_made(path, "frontier", SCHEMA, "points"))
    except ValidationError:
        raise UserError(f"{path}: damaged; run `dnrpipe frontier` again") from None


# -- tasks of the workers ------------------------------------------------------------------------------------


class PathTracingTask(PoolTask):
    """Path-trace the test views at each number of samples, with and without a denoiser -> `BaselineFile`."""

    fingerprint: str
    workspace: Path
    settings: Settings
    samples: list[int]


class CyclesFramesTask(PoolTask, CyclesTask):
    """A `CyclesTask` for a pool of workers."""


class CyclesMeasureTask(PoolTask):
    """Measure the pictures in ``folder`` -> `BaselineFile`. views: names; frames: file of a `CyclesFramesTask`."""

    workspace: Path
    views: list[str]
    frames: Path
    folder: Path


class BaselineFile(Record):
    """A worker's file. base_ms: of a base image with its G-buffer, by the same clock; None where none is rendered."""

    key: str = ""
    threads: int
    baselines: list[BaselinePoint] = file_key("rungs", "baselines")
    base_ms: float | None = None

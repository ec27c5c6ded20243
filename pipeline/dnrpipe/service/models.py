"""Requests and answers of the HTTP interface: jobs, events, workspaces. They define the OpenAPI description."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from pydantic import Field, ValidationError

from dnrtrain.settings import Strict

from ..report.data import SphereView

if TYPE_CHECKING:
    from fastapi.exceptions import RequestValidationError

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
SCENE_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}\.(blend|obj|gltf|glb|fbx|ply|stl)$"
WEBHOOK_PATTERN = r"^https?://[!-~]+$"
FRAMES_PATTERN = r"^-?[0-9][0-9, /-]{0,199}$"
SIZE_PATTERN = r"^[0-9]{2,5}x[0-9]{2,5}$"
SETTING_PATTERN = r"^[a-z0-9_]{1,40}(\.[a-z0-9_]{1,40}){0,4}$"

PLAIN = {
    NAME_PATTERN: "a name has letters, digits, - and _, begins with a letter or digit, and has 64 at most",
    SCENE_PATTERN: "a scene file's name has letters, digits, - and _, and ends as scene files do (.blend, .glb, ...)",
    SETTING_PATTERN: "no such setting",
    FRAMES_PATTERN: "frames are such as 1-240, 1-240/2 or 7,12",
    SIZE_PATTERN: "a size is WIDTHxHEIGHT in pixels, such as 1280x720",
    WEBHOOK_PATTERN: "an address begins with https:// or http://",
}
"""What a value that does not match a pattern is told."""

Stage = Literal["run", "prepare", "select", "raytrace-selected", "finetune", "evaluate", "render", "report", "shot"]
Export = Literal["export-nerf", "export-onnx", "export-gltf", "export-web"]
Command = Literal[Stage, Export]
EXPORTS: tuple[Export, ...] = get_args(Export)
State = Literal["queued", "running", "done", "failed", "cancelled"]
STATES: tuple[State, ...] = get_args(State)
FINAL: tuple[State, ...] = ("done", "failed", "cancelled")
Name = Annotated[str, Field(pattern=NAME_PATTERN)]


def first_fault(error: ValidationError | RequestValidationError) -> str:
    """Field and fault in one line, without what was sent (it may be anything)."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"] if part not in ("body", "path", "query"))
    pattern = first.get("ctx", {}).get("pattern")
    return f"{where}: {PLAIN.get(pattern, first['msg']) if pattern else first['msg']}"


class Limits(Strict):
    """Limits at which the worker stops a job; None is the server's own limit.

    seconds: wall time of one attempt. memory_mb: resident memory of the job's processes together, MiB.
    disk_mb: size of the workspace, MiB.
    """

    seconds: float | None = Field(default=None, gt=0, le=30 * 86400)
    memory_mb: int | None = Field(default=None, ge=64, le=2**24)
    disk_mb: int | None = Field(default=None, ge=1, le=2**28)


class JobRequest(Strict):
    """A stage, all of them (``run``), or a shot on a workspace of the server.

    Args:
        workspace: its name; the folder is ``<root>/<name>.dnr``.
        scene: an uploaded scene file, for ``run``, ``prepare`` and ``shot`` of a workspace that is not there yet;
            scene_sha256: which file of that name, by its content (default: the one there now).
        settings: as ``--set``, by dotted key.
        priority: larger goes first.
        retries: how often the queue starts a job again whose process crashed.
        orbit: frames of the turntable that `render` makes. frames, size: of `shot`, as its options.
        webhook: address that is told when the job has ended, one of those that the operator allows.
    """

    command: Command
    workspace: Name
    scene: Annotated[str, Field(pattern=SCENE_PATTERN)] | None = None
    scene_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    preset: Literal["draft", "standard", "paper", "vanilla", "paper-128", "vanilla-128"] | None = None
    settings: dict[Annotated[str, Field(pattern=SETTING_PATTERN)], bool | int | float | str] = Field(
        default_factory=dict, max_length=64
    )
    force: bool = False
    priority: int = Field(default=0, ge=-100, le=100)
    retries: int = Field(default=1, ge=0, le=10)
    orbit: int | None = Field(default=None, ge=1, le=10_000)
    frames: Annotated[str, Field(pattern=FRAMES_PATTERN)] | None = None
    size: Annotated[str, Field(pattern=SIZE_PATTERN)] | None = None
    webhook: Annotated[str, Field(pattern=WEBHOOK_PATTERN, max_length=2000)] | None = None
    limits: Limits = Limits()


class Job(Strict):
    """A job in the queue. Times are unix seconds; None: not yet.

    starts: how many processes were started for it; crashes: how many of those ended by a signal, a limit aside, since
    it was submitted or retried.
    exit_code: of the last process, negative for a signal. error: why it failed, one line. progress: the last report.
    owner: whose token submitted it. device: what works on it, a device of the server or ``machine/device`` of a worker
    elsewhere. lost: those starts of which nothing came back, since such a worker was lost.
    """

    id: int = Field(ge=1, le=2**53)
    state: State
    request: JobRequest
    created: float
    started: float | None = None
    finished: float | None = None
    device: str | None = None
    starts: int = 0
    crashes: int = 0
    cancel_requested: bool = False
    exit_code: int | None = None
    error: str | None = None
    progress: dict[str, Any] | None = None
    owner: str | None = None
    lost: int = 0


class End(Strict):
    """How a start of a job ended. state queued: it is to be started again. crashed: its process died, which counts.

    error: why it failed, or why it is queued again, in one line.
    """

    state: Literal["queued", "done", "failed", "cancelled"]
    exit_code: int | None = Field(default=None, ge=-255, le=255)
    error: str | None = None
    crashed: bool = False


class JobPage(Strict):
    """Jobs by descending id. next: pass as ``before`` for the page after this one; None: there is none."""

    jobs: list[Job]
    next: int | None


class JobEvent(Strict):
    """One event of a job: those of the event stream (dnrpipe.core.event_stream), and ``state`` with its new state."""

    id: int
    job: int
    time: float
    kind: str
    data: dict[str, Any]


class LogPage(Strict):
    """Part of a job's log. offset: of its first byte; next: offset to go on from; size: of the log, bytes."""

    text: str
    offset: int
    next: int
    size: int


class Scene(Strict):
    """An uploaded scene file. size in bytes. replaced: it took the place of another file of that name."""

    name: str
    size: int
    sha256: str | None = None
    replaced: bool = False


class StageState(Strict):
    """One row of ``dnrpipe status``."""

    stage: str
    command: str
    state: str
    present: int
    wanted: int
    seconds: float | None


class WorkspaceSummary(Strict):
    """A workspace under the root. owner: of its first job. mb: of disk, MiB. problem: why it cannot be read, if so."""

    name: str
    modified: float
    viewable: bool
    report: bool
    owner: str | None = None
    mb: float = 0.0
    problem: str | None = None


class Deleted(Strict):
    """A deleted workspace. until: it can be restored, unix seconds."""

    id: str
    name: str
    until: float
    owner: str | None


class Result(Strict):
    """A file to download. kind: movie, frames (a zip), export (a file, or a folder as a zip), report."""

    file: str
    kind: Literal["movie", "frames", "export", "report"]
    mb: float
    modified: float


class Curve(Strict):
    """History of a training step: points are (epoch, value)."""

    title: str
    losses: dict[str, list[tuple[int, float]]]
    psnr: list[tuple[int, float]]


class TestPicture(Strict):
    """A held-out view with pictures of the evaluation."""

    __test__ = False  # not a pytest class

    view: str
    psnr: float | None


class CostState(Strict):
    """Wall seconds spent so far by stage, and what tracing all candidates would have cost (None: unknown)."""

    spent: dict[str, float]
    total: float
    traced_views: int | None
    candidates: int | None
    tracing_seconds: float | None
    tracing_all_seconds: float | None


class PlannedStage(Strict):
    """A stage's wall seconds: predicted by `dnrpipe plan`, and spent since then (None: it was done before)."""

    stage: str
    predicted: float
    spent: float | None
    done: bool


class PlanState(Strict):
    """The last plan against what its stages have cost since.

    views, spp, epochs: what the plan assumes; fits: whether the settings in force are the same. total, low, high:
    seconds until the renderer is there (without evaluation), expected and its 90% interval; spent: seconds so far on
    the same stages.
    """

    made: float
    views: int
    spp: int
    epochs: int
    fits: bool
    stages: list[PlannedStage]
    total: float
    low: float
    high: float
    spent: float


class WorkspaceDetail(Strict):
    """What the dashboard shows of a workspace.

    sphere: the cameras as SVG, seen from ``eye`` (azimuth, elevation in radians); None before there are any.
    plan: None if `dnrpipe plan` has not run.
    """

    name: str
    stages: list[StageState]
    views: list[SphereView]
    sphere: str | None
    eye: tuple[float, float]
    training: list[Curve]
    tests: list[TestPicture]
    costs: CostState
    plan: PlanState | None
    viewable: bool
    report: bool


class Health(Strict):
    """workers: live worker processes by device. queued, running: jobs."""

    status: Literal["ok", "degraded"]
    version: str
    workers: dict[str, bool]
    queued: int
    running: int


class Problem(Strict):
    """Body of every refusal: what, where and what to do, in one line."""

    detail: str

"""What a server and its workers elsewhere tell each other (`routes_leases`, `lease_client`).

A lease is the right to work on one job. It ends with the job, or `SECONDS` after its last sign of life; then the job is
queued again, and who comes back with that lease is told that it is over.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Base64Bytes, BaseModel, Field, field_validator

from dnrtrain.settings import Strict

from ..core.errors import UserError
from .models import SCENE_PATTERN, Job, Limits

SECONDS = 30.0
BEAT_SECONDS = 2.0
"""Between two heartbeats of a worker that has nothing more to tell."""
MAX_LOG, MAX_EVENTS = 64 * 1024, 96 * 1024
"""Bytes of log and of events in one heartbeat: a request may have 256 KiB (`guard.MAX_BODY`)."""
ID_PATTERN = r"^[A-Za-z0-9_-]{16,64}$"
WORKER_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
DEVICE_PATTERN = r"^(cpu|cuda:[0-9]{1,9})$"
SHA256_PATTERN = r"^[0-9a-f]{64}$"
SHA256_HEADER = "X-Content-SHA256"


class LeaseGone(UserError):
    """The server knows no such lease: its time or its job is over."""


class LeaseTerms(Strict):
    """seconds: how long a lease lasts without a sign of life."""

    seconds: float


class LeaseWish(Strict):
    """Who wants a job. worker: its machine's name, told in the list of jobs. version: of its dnrpipe."""

    worker: Annotated[str, Field(pattern=WORKER_PATTERN)]
    device: Annotated[str, Field(pattern=DEVICE_PATTERN)]
    version: Annotated[str, Field(max_length=64)]


class SceneFile(Strict):
    """An uploaded file, by name and content."""

    name: Annotated[str, Field(pattern=SCENE_PATTERN)]
    sha256: Annotated[str, Field(pattern=SHA256_PATTERN)]


class Lease(Strict):
    """A job to work on.

    scene: the file to fetch; None: the job needs none. root: the server's folder, of which the workspace's manifest may
    speak. settings: the text of its dnrpipe.toml. limits: the server's and the job's; memory is the job's alone.
    """

    id: Annotated[str, Field(pattern=ID_PATTERN)]
    seconds: float
    job: Job
    scene: SceneFile | None
    root: str
    settings: str
    limits: Limits


class WorkerEvent(BaseModel, extra="allow"):
    """A line of the event stream (`core.event_stream`). A job's state is the server's to tell, not a worker's."""

    time: float = Field(ge=0, le=1e11, allow_inf_nan=False)
    kind: Annotated[str, Field(pattern=r"^[a-z]{1,40}$")]

    @field_validator("kind")
    @classmethod
    def _no_state(cls, kind: str) -> str:
        if kind == "state":
            raise ValueError("a worker tells no states")
        return kind


class Beat(Strict):
    """A sign of life. number: counts from 1; one that is sent again, since no answer came, keeps its number."""

    number: int = Field(ge=1, le=2**53)
    events: list[WorkerEvent] = Field(default_factory=list, max_length=10_000)
    log: Annotated[Base64Bytes, Field(max_length=2 * MAX_LOG)] = b""

    def told(self) -> list[dict[str, Any]]:
        return [event.model_dump() for event in self.events]


class BeatAnswer(Strict):
    """cancelled: the job is to be stopped."""

    cancelled: bool

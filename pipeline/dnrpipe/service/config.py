"""What an operator decides about a server."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, Field

from ..core.machine import memory_bytes
from .models import Limits

LOOPBACK = ("127.0.0.1", "::1", "localhost")
"""Hosts that only this machine can reach."""


class ServerConfig(BaseModel, extra="forbid", frozen=True):
    """Limits and devices of a server; its worker processes get it as JSON.

    devices: one worker each, "cpu" or "cuda:<n>". rate, burst: requests per second and at once, per client address.
    streams: event streams and viewers open at once. viewers: workspaces viewed live at once. idle_seconds: after so
    long without a viewer a frame process ends. keep_days, keep_jobs: the server deletes logs and events of jobs that
    ended longer ago, or before so many others. limits: upper bounds for every job. executor: settings of where jobs'
    task lists run. trusted_proxy: address of a proxy whose X-Forwarded-For and -Proto are believed, "" believes none.
    public_url: the address that browsers know the server by, where that is another. webhooks: addresses that may be
    told when a job ends. undo_days: how long a deleted workspace can be restored.
    """

    root: Path
    host: str = "127.0.0.1"
    port: int = Field(default=8420, ge=0, le=65535)
    devices: tuple[str, ...] = ("cpu",)
    upload_mb: int = Field(default=2048, ge=1)
    most_scenes: int = Field(default=1000, ge=1)
    most_workspaces: int = Field(default=1000, ge=1)
    most_queued: int = Field(default=10_000, ge=1)
    rate: float = Field(default=50.0, gt=0)
    burst: int = Field(default=200, ge=1)
    streams: int = Field(default=500, ge=1)
    viewers: int = Field(default=2, ge=1)
    idle_seconds: float = Field(default=300.0, gt=0)
    keep_days: float = Field(default=30.0, gt=0, le=36_500)
    keep_jobs: int = Field(default=1000, ge=1)
    free_disk_mb: int = Field(default=1024, ge=0, description="the server refuses uploads and jobs below this")
    executor: tuple[str, ...] = ()
    trusted_proxy: str = ""
    public_url: str = ""
    webhooks: tuple[str, ...] = ()
    undo_days: float = Field(default=7.0, gt=0, le=36_500)
    limits: Limits = Limits(seconds=24 * 3600.0, disk_mb=50 * 1024)


def default_devices() -> tuple[str, ...]:
    """One per NVIDIA GPU that the driver lists, else the CPU."""
    gpus = Path("/proc/driver/nvidia/gpus")
    count = len(list(gpus.iterdir())) if gpus.is_dir() else 0
    return tuple(f"cuda:{i}" for i in range(count)) or ("cpu",)


def default_memory_mb() -> int | None:
    """Four fifths of the machine's memory, MiB; None where the system does not say."""
    memory = memory_bytes()
    return None if memory is None else int(0.8 * memory / 2**20)


def tightest(job: Limits, server: Limits) -> Limits:
    """The smaller of each pair of limits; None means no limit."""
    pairs = {name: (getattr(job, name), getattr(server, name)) for name in Limits.model_fields}
    return Limits(**{name: min((v for v in pair if v is not None), default=None) for name, pair in pairs.items()})

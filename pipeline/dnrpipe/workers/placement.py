"""Where tasks run, and what answers them there."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from ..core.settings import ExecutorSettings


@dataclass(frozen=True)
class Placement:
    """Where a task list runs.

    Args:
        executor: this machine's processes, or a Ray cluster.
        roots: files and folders that workers may read and write; what else tasks name stays as it is.
        memory_mb: what a worker takes, as far as it is known; a cluster puts no more on a node than it has.
    """

    executor: ExecutorSettings = field(default_factory=ExecutorSettings)
    roots: tuple[Path, ...] = ()
    memory_mb: float | None = None

    @property
    def is_local(self) -> bool:
        return self.executor.engine == "local"


HERE = Placement()


class WorkerLost(RuntimeError):
    """The machine that the worker ran on is gone: not the task's doing, so it does not count as a try."""


class Worker(Protocol):
    """What answers tasks, one at a time, asked by one thread."""

    def ready(self) -> bool:
        """Whether it can be asked now; False after a moment's waiting (a cluster may have no place for it yet)."""
        ...

    def answer(self, task: dict[str, Any], timeout: float, why: str = "") -> dict[str, Any]:
        """As `processes.Answerer`, with "node" where that is not this machine. Raises WorkerDied, WorkerLost."""
        ...

    def kill(self) -> None:
        """At once, and from any thread; `close` is still to be called."""
        ...

    def close(self, *, force: bool = True) -> None:
        """End it. Without ``force`` it may finish first."""
        ...

"""What a stage is, and what it is given: `Run`, made once per command."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ..core.console import Console
from ..core.ledger import CostRecord, Purpose, StageName, Unit
from ..core.scene_files import scene_fingerprint
from ..core.settings import Settings
from ..core.workspace import Workspace
from ..effects.plan import EffectPlan
from ..effects.store import plan_of
from ..workers.placement import Placement
from ..workers.processes import KeptWorker
from ..workers.task_list import run_tasks
from ..workers.view_tasks import Book, Failures, is_made, task_name

LEAST_OVERHEAD = 0.005
"""Seconds below which overhead is not worth a record."""


@dataclass(frozen=True)
class Run:
    """One command's work on a workspace. Every stage gets one, as `for_stage` makes it.

    Args:
        stage: what the ledger books work under, and whose log workers write.
        id: names this run in the ledger.
        fingerprint: hash of all that the stage under way computes from; "" where none is.
        kept: a worker that several task lists share, for those that say so.
    """

    workspace: Workspace
    settings: Settings
    console: Console
    stage: StageName = "prepare"
    id: str = ""
    fingerprint: str = ""
    kept: KeptWorker | None = None

    def for_stage(self, stage: StageName, fingerprint: str = "") -> Run:
        """The same command's work on a stage; what it knew of the scene is read anew."""
        return replace(self, stage=stage, id=f"{stage}-{int(time.time()):x}", fingerprint=fingerprint)

    @cached_property
    def effect_plan(self) -> EffectPlan:
        """Which effects are simulated, as far as files tell: the path depth is None while its pilot has not run."""
        return plan_of(self.workspace, self.settings)

    @cached_property
    def scene_fingerprint(self) -> str:
        """Hash of what the scene is converted from."""
        return scene_fingerprint(self.workspace)

    @property
    def place(self) -> Placement:
        """Where task lists run. Workers read and write in the workspace; what they took of memory the ledger knows."""
        executor, root = self.settings.executor, self.workspace.root
        if executor.engine == "local":
            return Placement(executor, (root,))
        records = self.workspace.ledger.read()
        peaks = [record.peak_mb for record in records if record.stage == self.stage and record.unit == "view"]
        return Placement(executor, (root,), max((peak for peak in peaks if peak), default=None))

    @property
    def log(self) -> Path:
        """Where workers of the stage write what libraries print."""
        return self.workspace.log(self.stage)

    @property
    def purpose(self) -> Purpose:
        """What the stage's own work is booked as."""
        return "evaluation" if self.stage == "evaluate" else "inference" if self.stage == "render" else "training"

    def book(self, purpose: Purpose, unit: Unit, name: str, seconds: float, **facts: Any) -> None:
        """Append a record to the ledger. facts: further fields of `CostRecord`."""
        self.workspace.ledger.append(
            CostRecord(
                time=time.time(),
                run=self.id,
                stage=self.stage,
                purpose=purpose,
                unit=unit,
                name=name,
                seconds=seconds,
                **facts,
            )
        )

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Book as ``overhead`` what a block takes beyond what is booked within it."""
        started, before = time.monotonic(), self.workspace.ledger.booked
        yield
        rest = time.monotonic() - started - (self.workspace.ledger.booked - before)
        if rest > LEAST_OVERHEAD:
            self.book(self.purpose, "overhead", name, rest)

    def book_views(self, device: str, *, folder: str | None = None, purpose: Purpose | None = None) -> Book:
        """What `view_tasks` books each view by.

        Args:
            folder: of the record's name; None: the one that the view's file lies in.
            purpose: None: by the stage, and by the split that the view's file lies in.
        """
        fields = {"seconds", "cpu_seconds", "peak_mb", "spp", "noise"}

        def book(task: dict[str, Any], result: dict[str, Any], workers: int) -> None:
            held_out = self.purpose == "training" and Path(task["output"]).parent.name.endswith("test")
            self.book(
                purpose or ("evaluation" if held_out else self.purpose),
                "view",
                task_name(task) if folder is None else f"{folder}/{task['view']['name']}",
                device=device,
                workers=workers,
                width=task["view"]["width"],
                height=task["view"]["height"],
                detail={key: value for key, value in result.items() if key not in fields},
                **{key: value for key, value in result.items() if key in fields},
            )

        return book

    def view_tasks(
        self,
        label: str,
        module: str,
        common: dict[str, Any],
        tasks: Sequence[dict[str, Any]],
        *,
        workers: int,
        book: Book,
        environment: dict[str, str] | None = None,
        place: Placement | None = None,
        kept: KeptWorker | None = None,
    ) -> None:
        """Run the tasks whose files are missing or out of date.

        Args:
            module, common, environment, kept: of `task_list.run_tasks`.
            place: where they run, instead of where the settings say.

        Raises TasksFailed after all other tasks are done when some failed twice. Raises OSError: the disk is full.
        """
        due = [task for task in tasks if not is_made(task)]
        if not due:
            return
        count = max(1, min(workers, len(due)))
        failures = Failures(label, self.console, self.log)
        outcomes = run_tasks(
            module,
            common,
            due,
            workers=count,
            log=self.log,
            retried=failures.retried,
            environment=environment,
            place=place or self.place,
            kept=kept,
        )
        with self.timed(f"{label}: processes"), self.console.bar(label, len(tasks), len(tasks) - len(due)) as bar:
            for outcome in failures.noted(outcomes):
                if outcome.result is not None:
                    node = {"node": outcome.node} if outcome.node else {}
                    book(outcome.task, outcome.result | node, outcome.side_by_side)
                bar.advance(note=task_name(outcome.task) if outcome.result is not None else "")
        failures.report(len(tasks))


@dataclass(frozen=True)
class Outcome:
    """What a stage's run returns: a hash of what it made, and facts for the manifest and ``--json``."""

    output: str
    detail: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Stage:
    """One stage: a function of files in a workspace.

    Args:
        reads, writes: files and folders of the workspace.
        settings: those that decide what it makes, JSON-able.
        progress: (units present, units wanted), by looking at files alone.
        version: raised when the same inputs give other files.
    """

    name: StageName
    command: str
    does: str
    needs: tuple[StageName, ...]
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    settings: Callable[[Settings], Any]
    make: Callable[[Run], Outcome]
    progress: Callable[[Workspace, Settings], tuple[int, int]]
    version: int = 1

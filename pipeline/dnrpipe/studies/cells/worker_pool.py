"""Worker processes for cells: a loop that leaves out what is done."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...core.console import Console
from ...workers.answers import answers, warn_of_retries
from ...workers.view_tasks import TasksFailed
from .tasks import PoolTask


@dataclass(frozen=True)
class WorkerPool:
    """device: torch's. threads: of each worker, 0 = torch's own choice. log: what workers print."""

    device: str
    threads: int
    workers: int
    log: Path
    console: Console

    def work(self, label: str, module: str, tasks: Sequence[PoolTask]) -> None:
        """Run the tasks whose ``output`` file is missing on workers of ``module``.

        Raises TasksFailed after all others are done.
        """
        due = [task.model_dump(mode="json") for task in tasks if not task.output.exists()]
        if not due:
            return
        threads = {name: str(self.threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")} if self.threads else {}
        common = {"threads": self.threads, "device": self.device}
        failed: list[str] = []
        with self.console.bar(label, len(tasks), len(tasks) - len(due)) as bar:
            for outcome in answers(
                module,
                common,
                due,
                workers=self.workers,
                log=self.log,
                retried=lambda retry: warn_of_retries(retry.task["label"], self.console)(retry),
                environment=threads,
            ):
                label_of = outcome.task["label"]
                if outcome.result is None:
                    self.console.warn(f"{label_of} failed: {outcome.error}")
                    failed.append(label_of)
                bar.advance(note=label_of if outcome.result is not None else "")
        if failed:
            raise TasksFailed(
                f"{label}: {len(failed)} of {len(due)} failed ({', '.join(failed[:5])}); the others are done."
                f" See {self.log}; run the same command to try again"
            )

"""Worker processes for cells: how many, on how many threads, and a loop that leaves out what is done."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...core.console import Console
from ...core.settings import Settings
from ...stages.trainer import torch_device
from ...workers.answers import answers, warn_of_retries
from ...workers.view_tasks import TasksFailed, worker_count
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


def make_pool(settings: Settings, jobs: int, log: Path, console: Console, *, single: bool = False) -> WorkerPool:
    """The workers of a study.

    Cells side by side on a thread each finish more per hour than one after the other on all cores.

    Args:
        settings: name the device.
        jobs: workers; 0: one per core, one on a GPU.
        log, console: of `WorkerPool`.
        single: one thread a worker also where there are fewer workers than cores, so that ``jobs`` does not enter what
            comes out.
    """
    device, cores = torch_device(settings), worker_count(0)
    on_gpu = device.startswith("cuda")
    workers = jobs or (1 if on_gpu else cores)
    threads = 0 if on_gpu else 1 if single else max(1, cores // workers)
    return WorkerPool(device, threads, workers, log, console)

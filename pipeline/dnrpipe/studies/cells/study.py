"""A study's run: what its scenes and cells have in common, and its results.

Every file is named by the fingerprint of all that decides it, so that a run may stop and go on at any point.

<out>/
  step1/<scene>/<fingerprint>.json  coarse models, and the views that their policy chose (weights beside them)
  cells/<scene>/<fingerprint>.json  one cell each
  pace/<scene>/<fingerprint>.json   seconds of an epoch
  results.json
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from dnrtrain.atomic import write_json
from dnrtrain.settings import ModelSettings, Strict

from ... import __version__
from ...core.console import Console
from ...core.errors import UserError
from ...core.settings import Settings
from ...core.workspace import digest, file_sha256, locked
from ...stages.trainer import perceptual_weights, torch_device
from ...workers.placement import Placement
from ...workers.task_list import run_tasks
from ...workers.view_tasks import TasksFailed, warn_of_retries, worker_count
from .cell import CELL_VERSION
from .results import code_state, made_by
from .scenes import Scene, raster_engine, traced_split
from .tasks import CellTask, PoolTask, Step1Task, StudyTask, files_of

CELL_WORKER = "dnrpipe.studies.cells.cell"
Place = TypeVar("Place")


@dataclass(frozen=True)
class WorkerPool:
    """device: torch's. threads: of each worker, 0 = torch's own choice. log: what workers print. place: theirs."""

    device: str
    threads: int
    workers: int
    log: Path
    console: Console
    place: Placement

    def work(self, label: str, module: str, tasks: Iterable[PoolTask]) -> None:
        """Run the tasks whose ``output`` file is missing on workers of ``module``; of several for one file the first.

        Raises TasksFailed after all others are done.
        """
        once: dict[Path, PoolTask] = {}
        for task in tasks:
            once.setdefault(task.output, task)
        due = [task.model_dump(mode="json") for task in once.values() if not task.output.exists()]
        if not due:
            return
        threads = {name: str(self.threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")} if self.threads else {}
        common = {"threads": self.threads, "device": self.device}
        failed: list[str] = []
        workspaces = {task.workspace for task in once.values() if isinstance(task, StudyTask)}
        place = replace(self.place, roots=(*self.place.roots, *workspaces))
        with self.console.bar(label, len(once), len(once) - len(due)) as bar:
            for outcome in run_tasks(
                module,
                common,
                due,
                workers=self.workers,
                log=self.log,
                retried=lambda retry: warn_of_retries(retry.task["label"], self.console)(retry),
                environment=threads,
                place=place,
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


@dataclass(kw_only=True)
class Study(ABC, Generic[Place]):
    """What to run, and the state of the run.

    Args:
        seeds, first_seed: how many, counted from the latter.
        base: settings of all cells.
        seconds: of training, None: the preset's epochs.
        jobs: workers; 0: one per core, one on a GPU.
        references: fingerprints of the test views' pictures, by scene.
        cells: by their places in the tables; those that come to the same share one fingerprint.

    Raises UserError: an amount of work that is none, or ``out`` is a file.
    """

    COMMAND: ClassVar[str]
    SCHEMA: ClassVar[int]
    SINGLE: ClassVar[bool] = False
    """Whether workers have one thread also where they are fewer than cores, so that ``jobs`` decides nothing else."""

    sources: list[Path]
    seeds: int
    first_seed: int = 0
    base: Settings
    seconds: float | None
    out: Path
    jobs: int
    console: Console
    perceptual: bool = field(default=False, init=False)
    references: dict[str, list[str]] = field(default_factory=dict, init=False)
    cells: dict[Place, CellTask] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        if self.seconds is not None and not self.seconds > 0:
            raise UserError(f"--seconds {self.seconds:g}: must be more than 0")
        if self.seeds < 1 or self.jobs < 0:
            raise UserError(f"--seeds {self.seeds} --jobs {self.jobs}: at least 1 seed; jobs from 0 (one per core)")
        if self.out.exists() and not self.out.is_dir():
            raise UserError(f"--out {self.out}: is a file; name a folder")
        if self.base.executor.engine != "local":
            self.out = self.out.resolve()  # paths in tasks say where files lie
        device, cores = torch_device(self.base), worker_count(0)
        on_gpu = device.startswith("cuda")
        # Cells side by side on a thread each finish more per hour than one after the other on all cores.
        workers = self.jobs or (1 if on_gpu else cores)
        threads = 0 if on_gpu else 1 if self.SINGLE else max(1, cores // workers)
        place = Placement(self.base.executor, (self.out,))
        self.worker_pool = WorkerPool(device, threads, workers, self.out / "logs" / "cells.log", self.console, place)
        self.environment = self.device, self.threads = device, threads

    def carry_out(self) -> dict[str, Any]:
        """Run what is due and write the results. Raises TasksFailed: some cells failed; the others are written."""
        with locked(self.out, self.COMMAND):
            try:
                self.run()
            finally:
                results = self.write()
        return results

    def run(self) -> None:
        """Prepare all scenes, then go seed by seed, so that a whole table of the first seed exists early."""
        self.perceptual = perceptual_weights(self.console) is not None
        self.open_scenes()
        for seed in range(self.first_seed, self.first_seed + self.seeds):
            self.run_seed(seed)

    @abstractmethod
    def open_scenes(self) -> None:
        """Prepare all scenes and trace their references."""

    def run_seed(self, seed: int) -> None:
        self.plan_cells(seed)
        tasks = [task for task in self.cells.values() if task.seed == seed]
        self.worker_pool.work(f"cells, seed {seed}", CELL_WORKER, tasks)

    @abstractmethod
    def plan_cells(self, seed: int) -> None:
        """Note the tasks of the seed's cells, once all that they read is made."""

    # -- tasks -----------------------------------------------------------------------------------------

    def step1_task(
        self, scene: Scene, settings: Settings, policy: str, seed: int, seconds: float | None = None
    ) -> Step1Task:
        """Step 1: a trained policy's selection, or a coarse model that cells share. seconds: of training at most."""
        model, step1, budget = settings.model.coarse(), settings.select.step1, settings.select.most
        decisive = [scene.inputs, model.model_dump(), step1.model_dump(), policy, budget, seed, seconds]
        fingerprint = digest([CELL_VERSION, __version__, *decisive, *self.environment])
        return Step1Task(
            **files_of(self.out / "step1" / scene.name, fingerprint),
            workspace=scene.workspace.root,
            settings=settings,
            policy=policy,
            seed=seed,
            seconds=seconds,
            pace=self._pace_file(scene, "step1", model, step1, policy, budget),
            label=f"{scene.name} step 1",
        )

    def precision_of(self, settings: Settings) -> str:
        """What step 2's convolutions are in, on this device: float32 or bfloat16."""
        from dnrtrain.precision import decide_bfloat16  # imports torch

        return "bfloat16" if decide_bfloat16(settings.finetune.step2.precision, self.device) else "float32"

    def cell_task(
        self,
        scene: Scene,
        settings: Settings,
        seed: int,
        traced: Mapping[str, str],
        coarse: Step1Task | None,
        bases: Mapping[str, str],
        *,
        label: str,
        network: bool = True,
        full_step1: bool = False,
        spp: int | None = None,
        picture: bool = False,
    ) -> CellTask:
        """Train on the views and measure.

        Args:
            traced: fingerprints of the training views' pictures.
            coarse: the model that step 2 starts from.
            bases: fingerprints of base images by split and view; {} where none are read.
            network, full_step1: of `CellTask`.
            spp: of the training views' pictures, None: the settings'.
        """
        from dnrtrain.shipped import WEIGHTS

        views, seconds = (list(traced), self.seconds) if network else ([], None)
        model, step2 = settings.model.model_dump(mode="json"), settings.finetune.step2.model_dump(mode="json")
        used = [*(f"train/{name}" for name in views), *(f"test/{name}" for name in scene.test)]
        decisive = [scene.inputs, self.references[scene.name], model, [bases[name] for name in used] if bases else None]
        if network:
            time = [seconds, full_step1] if seconds else None
            train = [seed, list(traced.values()), step2, coarse and coarse.fingerprint, time]
            train += [file_sha256(WEIGHTS)] if settings.finetune.step2.start == "pretrained" else []
            decisive += [train, *self.environment]
        fingerprint = digest([CELL_VERSION, __version__, *decisive, self.perceptual])
        folder = self.out / "cells" / scene.name
        return CellTask(
            **files_of(folder, fingerprint),
            scene=scene.name,
            seed=seed,
            workspace=scene.workspace.root,
            settings=settings,
            network=network,
            views=views,
            targets=traced_split(self.base, spp),
            coarse=coarse and coarse.folder,
            coarse_cost=coarse and coarse.result(),
            seconds=seconds,
            full_step1=full_step1,
            pace=self._pace_file(scene, "step2", settings.model, settings.finetune.step2, str(len(traced))),
            picture=folder / f"{fingerprint}.png" if picture else None,
            code=code_state(),
            label=f"{scene.name} {label}",
        )

    def _pace_file(self, scene: Scene, step: str, model: ModelSettings, schedule: Strict, *more: str | int) -> Path:
        """Where the seconds of an epoch are kept; whatever makes epochs longer or shorter is in the name."""
        parts = [CELL_VERSION, scene.inputs, step, model.model_dump(), schedule.model_dump(mode="json"), *more]
        return self.out / "pace" / scene.name / f"{digest([*parts, *self.environment])}.json"

    # -- results ---------------------------------------------------------------------------------------

    def write(self) -> dict[str, Any]:
        """Write the results of the cells that are there -> the results; without any cell nothing is written."""
        base = self.base
        results = {
            "schema": self.SCHEMA,
            **made_by(),
            "preset": base.preset,
            "resolution": f"{base.cameras.width}x{base.cameras.height}",
            "seconds": self.seconds,
            "seeds": self.seeds,
            "scenes": [path.stem for path in self.sources],
            "raster_engines": sorted(
                {raster_engine(root) for root in {task.workspace for task in self.cells.values()}}
            ),
            "spp": {"training": base.raytrace.spp, "test": base.raytrace.evaluation_spp},
            **self.compared(),
            "cells": [self.line(place, task) for place, task in self.cells.items() if task.output.exists()],
        }
        if self.device.startswith("cuda"):
            import torch

            results["machine"]["gpu"] = torch.cuda.get_device_name(self.device)
        if results["cells"]:
            write_json(self.out / "results.json", results)
            self.show(results)
        return results

    @abstractmethod
    def compared(self) -> dict[str, Any]:
        """What results say of what the study compares."""

    @abstractmethod
    def line(self, place: Place, task: CellTask) -> dict[str, Any]:
        """A cell as results hold it: all that tables and plots need."""

    @abstractmethod
    def show(self, results: dict[str, Any]) -> None:
        """Write tables and pictures of the results."""

"""The loop over all cells: what is due, in an order that gives a whole table early, resumable at any point.

<out>/
  scenes/<scene>.dnr                workspaces
  step1/<scene>/<fingerprint>.json  coarse models and selections that several rows share (weights beside them)
  cells/<scene>/<fingerprint>.json  one cell each; the fingerprint is a hash of all that decides it
  pictures/<scene>.png              one test view: reference and rows side by side
  results.json  tables.md  plot.png
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dnrtrain.settings import ModelSettings, Strict

from ... import __version__
from ...core.console import Console
from ...core.errors import UserError
from ...core.settings import Settings
from ...core.workspace import digest
from ...effects.store import plan_of
from ...stages.stage import Run
from ...stages.trainer import perceptual_weights
from ..cells.cell import CELL_VERSION, STEP1_SHARE
from ..cells.provenance import code_state
from ..cells.request import StudyRequest
from ..cells.scenes import (
    Scene,
    choose_by_pose,
    make_bases,
    prepared,
    scene_workspace,
    trace_references,
    trace_train,
    traced_split,
)
from ..cells.tasks import CellTask, Step1Task, files_of, once
from ..cells.worker_pool import make_pool
from .rows import Row, needs_base, needs_coarse, settings_of, step1_policy

CELL_WORKER = "dnrpipe.studies.cells.cell"


@dataclass(frozen=True, kw_only=True)
class Request(StudyRequest):
    """``base``: the preset's settings; ``overrides``: the user's, which hold for all rows."""

    rows: list[Row]
    overrides: dict[str, Any]


@dataclass
class Ablation:
    """The state of one run: scenes, the workers' environment, and the cells known so far."""

    request: Request
    console: Console
    perceptual: bool = False
    scenes: list[Scene] = field(default_factory=list)
    references: dict[str, dict[str, str]] = field(default_factory=dict)
    cells: dict[tuple[str, str, int], Path] = field(default_factory=dict)
    """(scene, row, seed) -> the cell's file; rows that come to the same share one"""

    def __post_init__(self) -> None:
        """Refuse rows whose settings cannot be, before any work is done. Raises UserError."""
        request = self.request
        for row in request.rows:
            self.settings_of(row)
        self.worker_pool = make_pool(request.base, request.jobs, request.out / "logs" / "cells.log", self.console)
        self.device, self.threads = self.worker_pool.device, self.worker_pool.threads

    def run(self) -> None:
        """Prepare all scenes, then go seed by seed, so that a whole table of the first seed exists early."""
        request = self.request
        self.perceptual = perceptual_weights(self.console) is not None
        with self.console.bar("scenes", len(request.scenes)) as bar:
            for source in request.scenes:
                scene = self._open(source)
                self.references[scene.name] = trace_references(scene, request.base)
                self.scenes.append(scene)
                bar.advance(note=scene.name)
        for seed in range(request.seeds):
            self._cells(seed, self._step1(seed))

    def _open(self, source: Path) -> Scene:
        workspace = scene_workspace(source, self.request.out / "scenes" / f"{source.stem}.dnr")
        return prepared(source.stem, Run(workspace, self.request.base, self.console), "ablate")

    # -- step 1 ----------------------------------------------------------------------------------------

    def _step1(self, seed: int) -> dict[tuple[str, str], Step1Task]:
        """Coarse models and RL selections of the seed, by scene and row."""
        tasks: dict[tuple[str, str], Step1Task] = {}
        for scene in self.scenes:
            for row in self.request.rows:
                settings = self.settings_of(row, scene)
                if needs_coarse(row, settings):
                    tasks[scene.name, row.name] = self._step1_task(scene, row, settings, seed)
        self.worker_pool.work(f"step 1, seed {seed}", CELL_WORKER, once(tasks.values()))
        return tasks

    def _step1_task(self, scene: Scene, row: Row, settings: Settings, seed: int) -> Step1Task:
        policy, budget, step1 = step1_policy(row), settings.select.budget, settings.select.step1
        model = settings.model.coarse()
        limit = None if row.full_step1 or not self.request.seconds else STEP1_SHARE * self.request.seconds
        fingerprint = digest(
            [
                *(CELL_VERSION, __version__, scene.inputs, model.model_dump(), step1.model_dump()),
                *(policy, budget, seed, limit, self.device, self.threads),
            ]
        )
        return Step1Task(
            **files_of(self.request.out / "step1" / scene.name, fingerprint),
            workspace=scene.workspace.root,
            settings=settings,
            policy=policy,
            seed=seed,
            seconds=limit,
            pace=self._pace_file(scene, "step1", model, step1, policy, budget),
            label=f"{scene.name} step 1",
        )

    # -- cells -----------------------------------------------------------------------------------------

    def _cells(self, seed: int, step1: dict[tuple[str, str], Step1Task]) -> None:
        base, tasks = self.request.base, []
        for scene in self.scenes:
            chosen = {row.name: self._views(scene, row, seed, step1) for row in self.request.rows}
            everything = sorted({name for names in chosen.values() for name in names})
            by_spp: dict[int | None, set[str]] = {}
            for row in self.request.rows:
                by_spp.setdefault(row.spp, set()).update(chosen[row.name])
            traced = {spp: trace_train(scene, base, names, spp) for spp, names in by_spp.items()}
            bases: dict[str, dict[str, str]] = {}
            for row in self.request.rows:
                settings = self.settings_of(row, scene)
                kind = settings.model.base
                if needs_base(row, settings) and kind not in bases:
                    bases[kind] = make_bases(scene, settings, everything)
                task = self._cell_task(
                    scene,
                    row,
                    seed,
                    settings,
                    {name: traced[row.spp][name] for name in chosen[row.name]},
                    step1.get((scene.name, row.name)) if settings.finetune.step2.start == "coarse" else None,
                    bases[kind] if needs_base(row, settings) else {},
                )
                self.cells[scene.name, row.name, seed] = task.output
                tasks.append(task)
        self.worker_pool.work(f"cells, seed {seed}", CELL_WORKER, once(tasks))

    def _cell_task(
        self,
        scene: Scene,
        row: Row,
        seed: int,
        settings: Settings,
        traced: dict[str, str],
        coarse: Step1Task | None,
        bases: dict[str, str],
    ) -> CellTask:
        """Train and measure a row.

        Args:
            scene, row, seed: what tells the cell from others.
            settings: of the row in this scene.
            traced: fingerprints of the training views' pictures.
            coarse: the model that step 2 starts from.
            bases: fingerprints of base images by split and view; {} where the row reads none.
        """
        views, seconds = list(traced), self.request.seconds
        model, step2 = settings.model.model_dump(mode="json"), settings.finetune.step2.model_dump(mode="json")
        used = [f"train/{name}" for name in views if row.network] + [f"test/{name}" for name in scene.test]
        base = [bases[name] for name in used] if bases else None
        time = [seconds, row.full_step1] if seconds else None
        train = [seed, list(traced.values()), step2, coarse and coarse.fingerprint, time]
        fingerprint = digest(
            [CELL_VERSION, __version__, scene.inputs, sorted(self.references[scene.name].values()), model, base]
            + ([train, self.device, self.threads] if row.network else [])
            + [self.perceptual]
        )
        folder = self.request.out / "cells" / scene.name
        return CellTask(
            **files_of(folder, fingerprint),
            scene=scene.name,
            seed=seed,
            workspace=scene.workspace.root,
            settings=settings,
            network=row.network,
            views=views if row.network else [],
            targets=traced_split(self.request.base, row.spp),
            coarse=coarse and coarse.folder,
            coarse_cost=coarse and coarse.result(),
            seconds=seconds if row.network else None,
            full_step1=row.full_step1,
            pace=self._pace_file(scene, "step2", settings.model, settings.finetune.step2, str(len(views))),
            picture=folder / f"{fingerprint}.png" if seed == 0 else None,
            code=code_state(),
            label=f"{scene.name} {row.name}",
        )

    def _pace_file(self, scene: Scene, step: str, model: ModelSettings, schedule: Strict, *more: str | int) -> Path:
        """Where the seconds of an epoch are kept; whatever makes epochs longer or shorter is in the name."""
        parts = [CELL_VERSION, scene.inputs, step, model.model_dump(), schedule.model_dump(mode="json"), *more]
        return self.request.out / "pace" / scene.name / f"{digest([*parts, self.device, self.threads])}.json"

    def _views(self, scene: Scene, row: Row, seed: int, step1: dict[tuple[str, str], Step1Task]) -> list[str]:
        if row.views == "rl":
            return step1[scene.name, row.name].result().selected
        if row.views == "all":
            return list(scene.train)
        names, budget = list(scene.train), row.budget or self.request.base.select.budget
        # Farthest points are the same views for every seed.
        chosen = choose_by_pose(list(scene.train.values()), row.views, budget, seed if row.views == "random" else 0)
        return [names[place] for place in chosen]

    def settings_of(self, row: Row, scene: Scene | None = None) -> Settings:
        """The row's settings; with a scene, without what its effect plan leaves off."""
        settings = settings_of(row, self.request.base, self.request.overrides)
        if not row.network and settings.model.base == "none":
            raise UserError(f"row {row.name}: preset '{settings.preset}' has no base image (model.base is none)")
        if scene is None:
            return settings
        model = plan_of(scene.workspace, settings).model(settings.model)
        return settings.model_copy(update={"model": model})

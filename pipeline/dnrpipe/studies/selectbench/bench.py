"""The loop over all cells: what is due, in an order that gives a whole table early, resumable at any point.

<out>/
  scenes/<scene>.dnr                 the scene converted, once
  scenes/<scene>-<pool>.dnr          its candidates and test views: passes; ray tracing as far as somebody chose them
  selections/<scene>-<pool>/<fingerprint>.json   the views that a rule, or active learning, chose, why, at what cost
  step1/<scene>-<pool>/<fingerprint>.json   the same of a trained policy, and coarse models (weights beside them)
  cells/<scene>-<pool>/<fingerprint>.json   one cell each; the fingerprint is a hash of all that decides it
  results.json  report.md  views.png  seconds.png
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from ... import __version__
from ...core.console import Console
from ...core.settings import Settings
from ...core.workspace import digest
from ...effects.store import plan_of
from ...stages.trainer import perceptual_weights
from ..cells.cell import CELL_VERSION
from ..cells.measure import written_seconds
from ..cells.provenance import code_state
from ..cells.request import StudyRequest
from ..cells.scenes import base_file, make_bases, trace_references, trace_train
from ..cells.tasks import CellTask, ChoiceFile, Step1Task, StudyTask, files_of, once
from ..cells.worker_pool import WorkerPool
from .active.settings import ActiveSettings, ActiveTask
from .policies import Contender, rules_fingerprint, settings_of
from .pools import Pool, place_pool, share_light
from .rule_worker import RuleTask

CHOICE_VERSION = 1  # raise when what a selection's file holds changes
SHARED_COARSE = "farthest"
"""Step 1 without a selector trains the same for every policy, so that all share one coarse model."""


@dataclass(frozen=True, kw_only=True)
class Request(StudyRequest):
    """The budget of ``base`` is the largest of ``budgets``."""

    pools: list[str]
    budgets: list[int]
    policies: list[Contender]


@dataclass(frozen=True)
class Place:
    """Where a cell stands in the tables."""

    scene: str
    pool: str
    budget: int
    policy: str
    seed: int


ChoiceTask = RuleTask | ActiveTask | Step1Task


@dataclass(frozen=True)
class PlannedCell:
    """A cell's task, and the file of the selection that its views come from."""

    task: CellTask
    choice: Path


@dataclass
class Bench:
    """The state of one run: pools, workers, and the cells known so far."""

    request: Request
    console: Console
    worker_pool: WorkerPool
    perceptual: bool = False
    pools: list[Pool] = field(default_factory=list)
    references: dict[str, list[str]] = field(default_factory=dict)
    cells: dict[Place, PlannedCell] = field(default_factory=dict)
    """Places whose policies chose the same views share one fingerprint."""
    written_seconds: Callable[..., float] = field(default_factory=lambda: functools.cache(written_seconds))

    def run(self) -> Iterator[int]:
        """Prepare all pools, then go seed by seed; yields each seed when its cells are done, a whole table."""
        request = self.request
        self.perceptual = perceptual_weights(self.console) is not None
        places = [(source, name) for source in request.scenes for name in request.pools]
        with self.console.bar("scenes and cameras", len(places)) as bar:  # all, before anything takes long
            for source, name in places:
                self.pools.append(place_pool(source, name, request.out, request.base, self.console))
                bar.advance(note=f"{source.stem}-{name}")
        with self.console.bar("pools", len(self.pools)) as bar:
            for pool in self.pools:
                traced = trace_references(pool.data, self._settings(pool))
                self.references[pool.folder] = sorted(traced.values())
                bar.advance(note=pool.folder)
        for seed in range(request.seeds):
            self._seed(seed)
            yield seed

    def _seed(self, seed: int) -> None:
        chosen: dict[Place, ChoiceTask] = {}
        starts: dict[Place, Step1Task] = {}
        for pool in self.pools:
            for budget in self.request.budgets:
                for contender in self.request.policies:
                    place = Place(pool.scene, pool.name, budget, contender.name, seed)
                    settings = settings_of(contender, self._settings(pool), budget)
                    chosen[place] = task = self._choice_task(pool, contender, settings, seed)
                    if settings.starts_coarse:
                        coarse = isinstance(task, Step1Task)
                        starts[place] = task if coarse else self._step1_task(pool, settings, SHARED_COARSE, seed)
        tasks = [*chosen.values(), *starts.values()]
        self._work(f"selections, seed {seed}", "selectbench.rule_worker", tasks, RuleTask)
        self._work(f"active selections, seed {seed}", "selectbench.active.active_worker", tasks, ActiveTask)
        self._work(f"step 1, seed {seed}", "cells.cell", tasks, Step1Task)
        for pool in self.pools:
            places = [place for place in chosen if (place.scene, place.pool) == (pool.scene, pool.name)]
            self._trace_and_plan(pool, {place: chosen[place] for place in places}, starts)
        cells = [cell.task for place, cell in self.cells.items() if place.seed == seed]
        self._work(f"cells, seed {seed}", "cells.cell", cells, CellTask)

    def _work(self, label: str, module: str, tasks: Sequence[StudyTask], kind: type[StudyTask]) -> None:
        """Run the tasks of a kind."""
        due = once(task for task in tasks if isinstance(task, kind))
        self.worker_pool.work(label, f"dnrpipe.studies.{module}", due)

    # -- selections ------------------------------------------------------------------------------------

    def _choice_task(self, pool: Pool, contender: Contender, settings: Settings, seed: int) -> ChoiceTask:
        """A selection by the contender's policy."""
        policy, budget, inputs = contender.policy, settings.select.budget, pool.data.inputs
        if contender.kind == "step1":
            return self._step1_task(pool, settings, policy, seed)
        common: dict[str, Any] = {"workspace": pool.data.workspace.root, "policy": policy, "seed": seed}
        folder = self.request.out / "selections" / pool.folder
        if contender.kind == "rule":
            fingerprint = digest([CHOICE_VERSION, rules_fingerprint(), inputs, policy, budget, seed])
            label, output = f"{pool.folder} {contender.name} {budget}", folder / f"{fingerprint}.json"
            return RuleTask(**common, fingerprint=fingerprint, output=output, budget=budget, label=label)
        model, step1 = settings.model.coarse().model_dump(), settings.select.step1.model_dump()
        fingerprint = digest(
            [
                *(CHOICE_VERSION, CELL_VERSION, __version__, inputs, model, step1, asdict(ActiveSettings())),
                *(policy, budget, seed, self.worker_pool.device, self.worker_pool.threads),
            ]
        )
        label = f"{pool.folder} {policy} {budget}"
        return ActiveTask(**common, **files_of(folder, fingerprint), settings=settings, label=label)

    def _step1_task(self, pool: Pool, settings: Settings, policy: str, seed: int) -> Step1Task:
        """Step 1: a trained policy's selection, or the coarse model that all others share."""
        model, step1 = settings.model.coarse().model_dump(), settings.select.step1.model_dump()
        fingerprint = digest(
            [
                *(CELL_VERSION, __version__, pool.data.inputs, model, step1, policy, settings.select.budget, seed),
                *(self.worker_pool.device, self.worker_pool.threads),
            ]
        )
        return Step1Task(
            **files_of(self.request.out / "step1" / pool.folder, fingerprint),
            workspace=pool.data.workspace.root,
            settings=settings,
            policy=policy,
            seconds=None,  # the preset's epochs: what step 1 takes is part of what its policy costs
            seed=seed,
            label=f"{pool.folder} step 1",
        )

    # -- cells -----------------------------------------------------------------------------------------

    def _trace_and_plan(
        self,
        pool: Pool,
        chosen: Mapping[Place, ChoiceTask],
        starts: Mapping[Place, Step1Task],
    ) -> None:
        """Trace what anybody chose in this pool, and note the tasks of its cells."""
        settings = self._settings(pool)
        order = {name: index for index, name in enumerate(pool.data.train)}
        # In the pool's order: two policies that choose the same views in another order are the same cell.
        views = {place: sorted(read_choice(task.output).views, key=order.__getitem__) for place, task in chosen.items()}
        everything = sorted({name for names in views.values() for name in names})
        traced, bases = trace_train(pool.data, settings, everything), {}
        if settings.model.base != "none":
            share_light([other for other in self.pools if other.scene == pool.scene])
            bases = make_bases(pool.data, settings, everything)
        for place, names in views.items():
            fingerprints = {name: traced[name] for name in names}
            task = self._cell_task(pool, settings, place, fingerprints, starts.get(place), bases)
            self.cells[place] = PlannedCell(task, chosen[place].output)

    def _cell_task(
        self,
        pool: Pool,
        settings: Settings,
        place: Place,
        traced: dict[str, str],
        coarse: Step1Task | None,
        bases: dict[str, str],
    ) -> CellTask:
        """Train on the views and measure.

        Args:
            pool: of the candidates.
            settings: of the pool.
            place: in the tables.
            traced: fingerprints of the training views' pictures.
            coarse: the model that step 2 starts from.
            bases: fingerprints of base images by split and view; {} where the model reads none.
        """
        views = list(traced)
        model, step2 = settings.model.model_dump(mode="json"), settings.finetune.step2.model_dump(mode="json")
        worker_pool, data = self.worker_pool, pool.data
        used = [f"train/{name}" for name in views] + [f"test/{name}" for name in data.test]
        shown = [CELL_VERSION, __version__, data.inputs, self.references[pool.folder], model]
        shown.append([bases[name] for name in used] if bases else None)
        start = coarse and coarse.fingerprint
        train = [place.seed, list(traced.values()), step2, start, self.request.seconds]
        fingerprint = digest([*shown, train, worker_pool.device, worker_pool.threads, self.perceptual])
        pace = [*shown[:5], len(views), step2, worker_pool.device, worker_pool.threads]
        return CellTask(
            **files_of(self.request.out / "cells" / pool.folder, fingerprint),
            scene=pool.scene,
            seed=place.seed,
            workspace=data.workspace.root,
            settings=settings,
            network=True,
            views=views,
            coarse=coarse and coarse.folder,
            coarse_cost=coarse and coarse.result(),
            seconds=self.request.seconds,
            # Where step 2 starts from a coarse model, all policies give step 1 the same share of their time.
            full_step1=coarse is not None,
            pace=self.request.out / "pace" / pool.folder / f"{digest(pace)}.json",
            picture=None,
            code=code_state(),
            label=f"{pool.folder} {place.policy} {place.budget}",
        )

    def _settings(self, pool: Pool) -> Settings:
        """The run's settings without what the scene's effect plan leaves off."""
        base = self.request.base
        model = plan_of(pool.data.workspace, base).model(base.model)
        return base.model_copy(update={"model": model})

    # -- what views cost -------------------------------------------------------------------------------

    @property
    def clock(self) -> Literal["seconds", "cpu_seconds"]:
        """What costs are counted in: processor time where the model trains on a CPU."""
        return "cpu_seconds" if self.worker_pool.device == "cpu" else "seconds"

    def view_seconds(self, pool: Pool, names: Sequence[str]) -> float:
        """Seconds of ray tracing the views and their base images, by the files."""
        kind, workspace = self._settings(pool).model.base, pool.data.workspace
        files = [workspace.raytraced("train", name) for name in names]
        if kind not in ("none", "raster"):
            files += [base_file(workspace, kind, "train", name) for name in names]
        return sum(self.written_seconds(file, self.clock) for file in files)


def read_choice(path: Path) -> ChoiceFile:
    """The file of a selection, of whichever kind."""
    return ChoiceFile.model_validate_json(path.read_bytes())

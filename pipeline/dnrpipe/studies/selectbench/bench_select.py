"""`dnrpipe bench-select` behind its options: the loop over all cells, and what it writes.

<out>/, beside what every study has (`cells.study`), whose <scene> is <scene>-<pool> here
  scenes/<scene>.dnr          the scene converted, once
  scenes/<scene>-<pool>.dnr   its candidates and test views: passes; ray tracing as far as somebody chose them
  selections/<scene>-<pool>/<fingerprint>.json   the views that a rule, or active learning, chose, why, at what cost
  report.md  views.png  seconds.png
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from dnrtrain.atomic import write_text

from ... import __version__
from ...core.console import Console
from ...core.errors import UserError
from ...core.settings import Settings, merge, resolve
from ...core.workspace import digest
from ..cells.cell import CELL_VERSION
from ..cells.measure import METRICS, mean_of, written_seconds
from ..cells.request import SMOKE_RUN, SMOKE_SCENE, epochs_of, merged
from ..cells.scenes import base_files, find_scenes, make_bases, trace_references, trace_train, without_left_out
from ..cells.study import CELL_WORKER, Study
from ..cells.tasks import CellTask, ChoiceFile, Step1Task, files_of
from .bench_plots import plot
from .bench_tables import SCHEMA, markdown
from .policies import ActiveSettings, ActiveTask, Contender, choose_policies, rules_fingerprint, settings_of
from .pools import Pool, choose_pools, place_pool, share_light
from .rule_worker import RuleTask

CHOICE_VERSION = 1  # raise when what a selection's file holds changes
SHARED_COARSE = "farthest"
"""Step 1 without a selector trains the same for every policy, so that all share one coarse model."""
SMOKE: dict[str, Any] = {
    "cameras": {"train": 10},
    "model": {"base": "none", "chain": False, "filter": 0, "output": "display", "guides": False},
    "finetune": {"step2": {"start": "fresh"}},
}
SMOKE_REQUEST = {"pools": "dome,path", "budgets": "2,4", "policies": "random,farthest,kmedoids"}
CORE = {"pools": "all", "budgets": "10,25", "policies": "core"}
CANDIDATES = 100
_written_seconds = functools.cache(written_seconds)  # results are written after every seed


def run_bench(
    *,
    scenes: str | None,
    pools: str | None,
    budgets: str | None,
    policies: str | None,
    views: int | None,
    preset: str,
    assignments: Sequence[str],
    smoke: bool,
    console: Console,
    **more: Any,
) -> dict[str, Any]:
    """`Study.carry_out` with the command's options. more: fields of `Study`.

    Raises UserError: unknown names, settings that do not fit.
    """
    # Step 2 trains all cells; validation views would cost passes and decide nothing.
    cameras = {"train": CANDIDATES, "val": 0}
    given = {} if views is None else {"cameras": {"train": views}}
    overrides = merged([{"cameras": cameras}, *([SMOKE_RUN, SMOKE] if smoke else []), given], assignments)
    count = resolve(preset, overrides, environment={}).cameras.train
    defaults = SMOKE_REQUEST if smoke else CORE
    wanted = choose_budgets(budgets or defaults["budgets"], count)
    base = resolve(preset, merge(overrides, {"select": {"budget": max(wanted)}}), environment={})
    if base.cameras.source != "auto":
        raise UserError(f"cameras.source={base.cameras.source}: the pools decide where cameras stand; use --pools")
    return Bench(
        sources=find_scenes(scenes or (SMOKE_SCENE if smoke else None)),
        pool_names=choose_pools(pools or defaults["pools"]),
        budgets=wanted,
        policies=choose_policies(policies or defaults["policies"]),
        base=base,
        console=console,
        **more,
    ).carry_out()


def choose_budgets(text: str, candidates: int) -> list[int]:
    """``"10,25"``, or ``"full"``: 5 to 30 by 5, then by 10 up to all candidates.

    Raises UserError: not a number, or not between 1 and the number of candidates.
    """
    found: set[int] = set()
    for part in filter(None, (part.strip() for part in text.split(","))):
        if part == "full":
            found |= {n for n in [*range(5, 31, 5), *range(40, candidates, 10), candidates] if n <= candidates}
        elif not part.isdecimal() or not 1 <= int(part) <= candidates:
            raise UserError(f"--budgets {part}: name numbers of views from 1 to {candidates} (--views), or full")
        else:
            found.add(int(part))
    if not found:
        raise UserError("--budgets: names none; for example 10,25")
    return sorted(found)


@dataclass(frozen=True)
class Place:
    """Where a cell stands in the tables."""

    scene: str
    pool: str
    budget: int
    policy: str
    seed: int


ChoiceTask = RuleTask | ActiveTask | Step1Task


@dataclass(kw_only=True)
class Bench(Study[Place]):
    """The budget of ``base`` is the largest of ``budgets``.

    steps: of step 2 for every budget, as near as whole epochs come; None: the preset's epochs. pools: by (scene, name).
    chosen: the selections that the cells' views come from.
    """

    COMMAND, SCHEMA, SINGLE = "bench-select", SCHEMA, True
    steps: int | None
    pool_names: list[str]
    budgets: list[int]
    policies: list[Contender]
    pools: dict[tuple[str, str], Pool] = field(default_factory=dict, init=False)
    chosen: dict[Place, ChoiceTask] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps is not None and self.steps < 1:
            raise UserError(f"--steps {self.steps}: must be at least 1")
        if self.steps is not None and self.seconds is not None:
            raise UserError("--steps and --seconds: choose one of them")

    def open_scenes(self) -> None:
        places = [(source, name) for source in self.sources for name in self.pool_names]
        with self.console.bar("scenes and cameras", len(places)) as bar:  # all, before anything takes long
            for source, name in places:
                pool = place_pool(source, name, self.out, self.base, self.console)
                self.pools[pool.scene, name] = pool
                bar.advance(note=pool.folder)
        with self.console.bar("pools", len(self.pools)) as bar:
            for pool in self.pools.values():
                self.references[pool.folder] = trace_references(pool.data, self._settings(pool))
                bar.advance(note=pool.folder)

    def run_seed(self, seed: int) -> None:
        super().run_seed(seed)
        self.write()

    def plan_cells(self, seed: int) -> None:
        starts: dict[Place, Step1Task] = {}
        chosen: dict[Place, ChoiceTask] = {}
        for pool, budget, contender in itertools.product(self.pools.values(), self.budgets, self.policies):
            place = Place(pool.scene, pool.name, budget, contender.name, seed)
            own = self._settings(pool)
            settings = settings_of(contender, own, budget)
            chosen[place] = task = self._choice_task(pool, contender, settings, seed)
            if own.starts_coarse:
                if isinstance(task, Step1Task) and settings.model.coarse() == own.model.coarse():
                    starts[place] = task
                else:
                    # Of the largest budget: the coarse model of a rule's cells does not depend on the views it chose.
                    starts[place] = self.step1_task(pool.data, own, SHARED_COARSE, seed)
        for label, worker, kind in (
            ("selections", "dnrpipe.studies.selectbench.rule_worker", RuleTask),
            ("active selections", "dnrpipe.studies.selectbench.active.active_worker", ActiveTask),
            ("step 1", CELL_WORKER, Step1Task),
        ):
            tasks = [task for task in (*chosen.values(), *starts.values()) if isinstance(task, kind)]
            self.worker_pool.work(f"{label}, seed {seed}", worker, tasks)
        self.chosen |= chosen
        for pool in self.pools.values():
            places = [place for place in chosen if (place.scene, place.pool) == (pool.scene, pool.name)]
            self._plan_pool(pool, places, starts)

    def _choice_task(self, pool: Pool, contender: Contender, settings: Settings, seed: int) -> ChoiceTask:
        policy, kind, budget, inputs = contender.policy, contender.kind, settings.select.most, pool.data.inputs
        if budget == len(pool.data.train):  # nothing to choose, so no agent is trained, and all policies share one file
            policy, kind = "farthest", "rule"
        if kind == "step1":  # the preset's epochs: what step 1 takes is part of what its policy costs
            return self.step1_task(pool.data, settings, policy, seed)
        decisive = [CHOICE_VERSION, rules_fingerprint(), inputs, policy, budget, seed]
        if kind == "active":
            model, step1 = settings.model.coarse().model_dump(), settings.select.step1.model_dump()
            decisive = [CHOICE_VERSION, CELL_VERSION, __version__, inputs, model, step1, asdict(ActiveSettings())]
            decisive += [policy, budget, seed, *self.environment]
        common: dict[str, Any] = {
            **files_of(self.out / "selections" / pool.folder, digest(decisive)),
            "workspace": pool.data.workspace.root,
            "policy": policy,
            "seed": seed,
            "label": f"{pool.folder} {contender.name} {budget}",
        }
        if kind == "rule":
            return RuleTask(**common, budget=budget)
        return ActiveTask(**common, settings=settings)

    def _plan_pool(self, pool: Pool, places: Sequence[Place], starts: Mapping[Place, Step1Task]) -> None:
        """Trace what anybody chose in this pool, and note the tasks of its cells."""
        settings = self._settings(pool)
        order = {name: index for index, name in enumerate(pool.data.train)}
        # In the pool's order: two policies that choose the same views in another order are the same cell.
        views = {place: sorted(self._choice(place).views, key=order.__getitem__) for place in places}
        everything = sorted({name for names in views.values() for name in names})
        traced, bases = trace_train(pool.data, settings, everything), {}
        if settings.model.base != "none":
            share_light([other for other in self.pools.values() if other.scene == pool.scene])
            bases = make_bases(pool.data, settings, everything)
        for place, names in views.items():
            coarse = starts.get(place)
            self.cells[place] = self.cell_task(
                pool.data,
                self._for_steps(settings, len(names)),
                place.seed,
                {name: traced[name] for name in names},
                coarse,
                bases,
                label=f"{place.policy} {place.budget}",
                # Where step 2 starts from a coarse model, all policies give step 1 the same share of their time.
                full_step1=coarse is not None,
            )

    def _for_steps(self, settings: Settings, views: int) -> Settings:
        """With the epochs of so many views that make ``steps``."""
        if self.steps is None:
            return settings
        changed = settings.model_copy(deep=True)
        changed.finetune.step2.epochs = epochs_of(self.steps, views, changed.finetune.step2.batch)
        return changed

    def _settings(self, pool: Pool) -> Settings:
        """The run's settings without what the scene's effect plan leaves off."""
        return without_left_out(pool.data.workspace, self.base)

    def _choice(self, place: Place) -> ChoiceFile:
        """The file of a selection, of whichever kind."""
        return ChoiceFile.model_validate_json(self.chosen[place].output.read_bytes())

    # -- results ---------------------------------------------------------------------------------------

    def compared(self) -> dict[str, Any]:
        return {
            "candidates": self.base.cameras.train,
            "step2_steps": self.steps,
            "pools": self.pool_names,
            "budgets": self.budgets,
            "device": self.device,
            "threads": self.threads,
            "precision": [self.precision_of(self.base)],
            "policies": {contender.name: contender.what for contender in self.policies},
        }

    def line(self, place: Place, task: CellTask) -> dict[str, Any]:
        """One cell: metrics as means over the test views, and the seconds of each part.

        select_seconds: choosing, step 1 included where it chooses; view_seconds: tracing the views and their base
        images; train_seconds: step 2, and step 1 where it only gives the start; total_seconds: all of them. On a CPU
        seconds are of the processor.
        """
        cell, choice = task.result(), self._choice(place)
        clock: Literal["seconds", "cpu_seconds"] = "cpu_seconds" if self.device == "cpu" else "seconds"
        training = cell.training
        assert training is not None  # every cell has a network
        step1 = training.step1
        chooses = step1 is not None and step1.key == choice.key
        train = getattr(training.step2, clock) + (getattr(step1, clock) if step1 and not chooses else 0.0)
        workspace = self.pools[place.scene, place.pool].data.workspace
        files = [workspace.raytraced("train", name) for name in cell.views]
        files += base_files(workspace, cell.base, "train", cell.views)
        seconds = {
            "select_seconds": getattr(choice, clock),
            "view_seconds": sum(_written_seconds(file, clock) for file in files),
            "train_seconds": train,
        }
        return {
            **asdict(place),
            "key": cell.key,
            **{name: mean_of(cell.tests, name) for name in METRICS},
            "train_psnr": cell.train_psnr and round(cell.train_psnr, 5),
            "views": choice.views,
            **{name: round(value, 3) for name, value in seconds.items()},
            "total_seconds": round(sum(seconds.values()), 3),
            "select_peak_mb": choice.peak_mb and round(choice.peak_mb),
            "epochs": training.epochs,
            "steps": training.step2.steps,
            "commit": cell.code["commit"],
        }

    def show(self, results: dict[str, Any]) -> None:
        out = self.out
        write_text(out / "report.md", markdown(results))
        plot(results, out / "views.png", "views")
        plot(results, out / "seconds.png", "total_seconds")

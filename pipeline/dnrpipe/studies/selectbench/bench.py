"""The loop over all cells: what is due, in an order that gives a whole table early, resumable at any point.

<out>/
  scenes/<scene>.dnr                 the scene converted, once
  scenes/<scene>-<pool>.dnr          its candidates and test views: passes; ray tracing as far as somebody chose them
  selections/<scene>-<pool>/<key>.json   the views that a rule, or active learning, chose, why, and what that took
  step1/<scene>-<pool>/<key>.json    the same of a trained policy, and coarse models (weights beside them)
  cells/<scene>-<pool>/<key>.json    one cell each; the key is a hash of all that decides it
  results.json  report.md  views.png  seconds.png
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ... import __version__
from ...core.console import Console
from ...core.settings import Settings
from ...core.workspace import digest
from ...effects.store import plan_of
from ...stages.trainer import perceptual_weights
from ..cells.cell import CELL_VERSION
from ..cells.measure import written_seconds
from ..cells.provenance import code_state
from ..cells.scenes import base_file, make_bases, trace_references, trace_train
from ..cells.worker_pool import WorkerPool
from .active.settings import ActiveSettings
from .policies import Contender, Kind, rules_fingerprint, settings_of
from .pools import Placed, Pool, place_pool, share_light

CHOICE_VERSION = 1  # raise when what a selection's file holds changes
SHARED_COARSE = "farthest"
"""Step 1 without a selector trains the same for every policy, so that all share one coarse model."""


@dataclass(frozen=True)
class Request:
    """What to run. ``base``: settings of all cells; its budget is the largest of ``budgets``."""

    scenes: list[Path]
    pools: list[str]
    budgets: list[int]
    policies: list[Contender]
    seeds: int
    base: Settings
    seconds: float | None
    out: Path
    jobs: int = 0


@dataclass(frozen=True)
class Place:
    """Where a cell stands in the tables."""

    scene: str
    pool: str
    budget: int
    policy: str
    seed: int


@dataclass
class Bench:
    """The state of one run: pools, workers, and the cells known so far."""

    request: Request
    console: Console
    worker_pool: WorkerPool
    perceptual: bool = False
    pools: list[Pool] = field(default_factory=list)
    references: dict[str, list[str]] = field(default_factory=dict)
    cells: dict[Place, dict[str, Any]] = field(default_factory=dict)
    """Tasks of the cells; places whose policies chose the same views share one key."""
    written_seconds: Callable[..., float] = field(default_factory=lambda: functools.cache(written_seconds))

    def run(self) -> Iterator[int]:
        """Prepare all pools, then go seed by seed; yields each seed when its cells are done, a whole table."""
        request = self.request
        self.perceptual = perceptual_weights(self.console) is not None
        places = [(source, name) for source in request.scenes for name in request.pools]
        placed: list[Placed] = []
        with self.console.bar("scenes and cameras", len(places)) as bar:  # all, before anything takes long
            for source, name in places:
                placed.append(place_pool(source, name, request.out, request.base, self.console))
                bar.advance(note=f"{source.stem}-{name}")
        with self.console.bar("pools", len(placed)) as bar:
            for one in placed:
                pool = one.prepare(self.console)
                traced = trace_references(pool.data, self._settings(pool), self.console)
                self.references[pool.folder] = sorted(traced.values())
                self.pools.append(pool)
                bar.advance(note=pool.folder)
        for seed in range(request.seeds):
            self._seed(seed)
            yield seed

    def _seed(self, seed: int) -> None:
        work: dict[Kind, list[dict[str, Any]]] = {"rule": [], "active": [], "step1": []}
        chosen: dict[Place, dict[str, Any]] = {}
        starts: dict[Place, dict[str, Any]] = {}
        for pool in self.pools:
            for budget in self.request.budgets:
                for contender in self.request.policies:
                    place = Place(pool.scene, pool.name, budget, contender.name, seed)
                    settings = settings_of(contender, self._settings(pool), budget)
                    if contender.kind == "rule":
                        chosen[place] = self._choice(pool, contender, budget, seed)
                    elif contender.kind == "active":
                        chosen[place] = self._active(pool, settings, contender.policy, seed)
                    else:
                        chosen[place] = self._step1(pool, settings, contender.policy, seed)
                    work[contender.kind].append(chosen[place])
                    if settings.starts_coarse:
                        own = contender.kind == "step1"
                        starts[place] = chosen[place] if own else self._step1(pool, settings, SHARED_COARSE, seed)
        label = f", seed {seed}"
        self.worker_pool.work(f"selections{label}", "dnrpipe.studies.selectbench.rule_worker", _once(work["rule"]))
        self.worker_pool.work(
            f"active selections{label}", "dnrpipe.studies.selectbench.active.active_worker", _once(work["active"])
        )
        self.worker_pool.work(f"step 1{label}", "dnrpipe.studies.cells.cell", _once([*work["step1"], *starts.values()]))
        for pool in self.pools:
            places = [place for place in chosen if (place.scene, place.pool) == (pool.scene, pool.name)]
            self._trace_and_plan(pool, {place: chosen[place] for place in places}, starts)
        self.worker_pool.work(
            f"cells{label}",
            "dnrpipe.studies.cells.cell",
            _once([task for place, task in self.cells.items() if place.seed == seed]),
        )

    # -- selections ------------------------------------------------------------------------------------

    def _choice(self, pool: Pool, contender: Contender, budget: int, seed: int) -> dict[str, Any]:
        """The task of a rule's selection."""
        key = digest([CHOICE_VERSION, rules_fingerprint(), pool.data.inputs, contender.policy, budget, seed])
        return {
            "key": key,
            "workspace": str(pool.data.workspace.root),
            "policy": contender.policy,
            "budget": budget,
            "seed": seed,
            "output": str(self.request.out / "selections" / pool.folder / f"{key}.json"),
            "label": f"{pool.folder} {contender.name} {budget}",
        }

    def _active(self, pool: Pool, settings: Settings, policy: str, seed: int) -> dict[str, Any]:
        """The task of a selection by active learning."""
        model, step1, budget = settings.model.coarse(), settings.select.step1, settings.select.budget
        key = digest(
            [
                *(CHOICE_VERSION, CELL_VERSION, __version__, pool.data.inputs, model.model_dump(), step1.model_dump()),
                *(asdict(ActiveSettings()), policy, budget, seed, self.worker_pool.device, self.worker_pool.threads),
            ]
        )
        folder = self.request.out / "selections" / pool.folder / key
        return {
            "key": key,
            "workspace": str(pool.data.workspace.root),
            "settings": settings.model_dump(mode="json"),
            "policy": policy,
            "seed": seed,
            "folder": str(folder),
            "output": f"{folder}.json",
            "label": f"{pool.folder} {policy} {budget}",
        }

    def _step1(self, pool: Pool, settings: Settings, policy: str, seed: int) -> dict[str, Any]:
        """The task of a step 1: a trained policy's selection, or the coarse model that all others share."""
        model, step1, budget = settings.model.coarse(), settings.select.step1, settings.select.budget
        key = digest(
            [
                *(CELL_VERSION, __version__, pool.data.inputs, model.model_dump(), step1.model_dump()),
                *(policy, budget, seed, self.worker_pool.device, self.worker_pool.threads),
            ]
        )
        folder = self.request.out / "step1" / pool.folder / key
        return {
            "kind": "step1",
            "key": key,
            "workspace": str(pool.data.workspace.root),
            "settings": settings.model_dump(mode="json"),
            "policy": policy,
            "seconds": None,  # the preset's epochs: what step 1 takes is part of what its policy costs
            "pace": "",
            "seed": seed,
            "folder": str(folder),
            "output": f"{folder}.json",
            "label": f"{pool.folder} step 1",
        }

    def _trace(self, pool: Pool, names: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
        """Ray-trace candidates and render base images; -> fingerprints, see ``trace_train`` and ``make_bases``."""
        settings = self._settings(pool)
        traced = trace_train(pool.data, settings, self.console, names)
        if settings.model.base == "none":
            return traced, {}
        share_light([other for other in self.pools if other.scene == pool.scene])
        return traced, make_bases(pool.data, settings, self.console, names)

    # -- cells -----------------------------------------------------------------------------------------

    def _trace_and_plan(
        self, pool: Pool, chosen: dict[Place, dict[str, Any]], starts: dict[Place, dict[str, Any]]
    ) -> None:
        """Trace what anybody chose in this pool, and note the tasks of its cells."""
        settings = self._settings(pool)
        order = {name: index for index, name in enumerate(pool.data.train)}
        # In the pool's order: two policies that choose the same views in another order are the same cell.
        views = {place: sorted(read_choice(task)["views"], key=order.__getitem__) for place, task in chosen.items()}
        everything = sorted({name for names in views.values() for name in names})
        traced, bases = self._trace(pool, everything)
        for place, names in views.items():
            self.cells[place] = self._cell(pool, settings, place, names, traced, bases, starts.get(place))
            self.cells[place]["choice"] = chosen[place]["output"]

    def _cell(
        self,
        pool: Pool,
        settings: Settings,
        place: Place,
        views: list[str],
        traced: dict[str, str],
        bases: dict[str, str],
        coarse: dict[str, Any] | None,
    ) -> dict[str, Any]:
        """The cell's task (`ablation.cells.Worker`); its key is a hash of all that decides what comes out."""
        model, step2 = settings.model.model_dump(mode="json"), settings.finetune.step2.model_dump(mode="json")
        worker_pool, data = self.worker_pool, pool.data
        used = [f"train/{name}" for name in views] + [f"test/{name}" for name in data.test]
        shown = [CELL_VERSION, __version__, data.inputs, self.references[pool.folder], model]
        shown.append([bases[name] for name in used] if bases else None)
        train = [place.seed, [traced[name] for name in views], step2, coarse and coarse["key"], self.request.seconds]
        key = digest([*shown, train, worker_pool.device, worker_pool.threads, self.perceptual])
        pace = [*shown[:5], len(views), step2, worker_pool.device, worker_pool.threads]
        folder = self.request.out / "cells" / pool.folder
        return {
            "kind": "cell",
            "key": key,
            "scene": pool.scene,
            "seed": place.seed,
            "workspace": str(data.workspace.root),
            "settings": settings.model_dump(mode="json"),
            "network": True,
            "views": views,
            "coarse": coarse and coarse["folder"],
            "coarse_cost": coarse and json.loads(Path(coarse["output"]).read_text(encoding="utf-8")),
            "seconds": self.request.seconds,
            # Where step 2 starts from a coarse model, all policies give step 1 the same share of their time.
            "full_step1": coarse is not None,
            "pace": str(self.request.out / "pace" / pool.folder / f"{digest(pace)}.json"),
            "folder": str(folder / key),
            "output": str(folder / f"{key}.json"),
            "picture": None,
            "code": code_state(),
            "label": f"{pool.folder} {place.policy} {place.budget}",
        }

    def _settings(self, pool: Pool) -> Settings:
        """The run's settings without what the scene's effect plan leaves off."""
        base = self.request.base
        model = plan_of(pool.data.workspace, base).model(base.model)
        return base.model_copy(update={"model": model})

    # -- what views cost -------------------------------------------------------------------------------

    def view_seconds(self, pool: Pool, names: Sequence[str]) -> float:
        """Seconds of ray tracing the views and their base images, by the files: processor time on a CPU."""
        kind, workspace = self._settings(pool).model.base, pool.data.workspace
        clock = "cpu_seconds" if self.worker_pool.device == "cpu" else "seconds"
        files = [workspace.raytraced("train", name) for name in names]
        if kind not in ("none", "raster"):
            files += [base_file(workspace, kind, "train", name) for name in names]
        return sum(self.written_seconds(file, clock) for file in files)


def read_choice(task: dict[str, Any]) -> dict[str, Any]:
    """A selection's file, a rule's or a trained policy's alike: "views", "seconds", "cpu_seconds"."""
    made = json.loads(Path(task["output"]).read_text(encoding="utf-8"))
    return made if "views" in made else made | {"views": made["selected"]}


def _once(tasks: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Tasks of different keys."""
    return list({task["key"]: task for task in tasks}.values())

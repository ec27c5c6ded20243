"""The loop over all cells: what is due, in an order that gives a whole table early, resumable at any point.

<out>/
  scenes/<scene>.dnr            workspaces
  step1/<scene>/<key>.json      coarse models and selections that several rows share (weights beside them)
  cells/<scene>/<key>.json      one cell each; the key is a hash of all that decides it
  pictures/<scene>.png          one test view: reference and rows side by side
  results.json  tables.md  plot.png
"""

from __future__ import annotations

import json
from collections.abc import Sequence
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
from ...stages.trainer import perceptual_weights
from ..cells.cell import CELL_VERSION, STEP1_SHARE
from ..cells.provenance import code_state
from ..cells.scenes import Scene, make_bases, prepare_scene, trace_references, trace_train, traced_split
from ..cells.worker_pool import WorkerPool, make_pool
from .rows import Row, needs_base, needs_coarse, settings_of, step1_policy


@dataclass(frozen=True)
class Request:
    """What to run. ``base``: the preset's settings; ``overrides``: the user's, which hold for all rows."""

    scenes: list[Path]
    rows: list[Row]
    seeds: int
    base: Settings
    overrides: dict[str, Any]
    seconds: float | None
    out: Path
    jobs: int = 0


@dataclass
class Ablation:
    """The state of one run: scenes, the workers' environment, and the cells known so far."""

    request: Request
    console: Console
    device: str = ""
    threads: int = 0
    worker_pool: WorkerPool = field(init=False)
    perceptual: bool = False
    scenes: list[Scene] = field(default_factory=list)
    references: dict[str, dict[str, str]] = field(default_factory=dict)
    cells: dict[tuple[str, str, int], str] = field(default_factory=dict)
    """(scene, row, seed) -> key; rows that come to the same share one cell"""

    def check(self) -> None:
        """Refuse rows whose settings cannot be, before any work is done. Raises UserError."""
        for row in self.request.rows:
            self._settings(row)

    def run(self) -> None:
        """Prepare all scenes, then go seed by seed, so that a whole table of the first seed exists early."""
        request = self.request
        self.worker_pool = make_pool(request.base, request.jobs, request.out / "logs" / "cells.log", self.console)
        self.device, self.threads = self.worker_pool.device, self.worker_pool.threads
        self.perceptual = perceptual_weights(self.console) is not None
        with self.console.bar("scenes", len(request.scenes)) as bar:
            for source in request.scenes:
                scene = self._open(source)
                self.references[scene.name] = trace_references(scene, request.base, self.console)
                self.scenes.append(scene)
                bar.advance(note=scene.name)
        for seed in range(request.seeds):
            step1 = self._step1(seed)
            self._cells(seed, step1)

    def _open(self, source: Path) -> Scene:
        return prepare_scene(source, self.request.out, self.request.base, self.console)

    # -- step 1 ----------------------------------------------------------------------------------------

    def _step1(self, seed: int) -> dict[tuple[str, str], dict[str, Any]]:
        """Coarse models and RL selections of the seed -> by scene and row: folder, key, result."""
        found: dict[tuple[str, str], dict[str, Any]] = {}
        tasks: dict[str, dict[str, Any]] = {}
        for scene in self.scenes:
            for row in self.request.rows:
                settings = self._settings(row, scene)
                if not needs_coarse(row, settings):
                    continue
                policy, budget, step1 = step1_policy(row), settings.select.budget, settings.select.step1
                model = settings.model.coarse()
                limit = None if row.full_step1 or not self.request.seconds else STEP1_SHARE * self.request.seconds
                key = digest(
                    [
                        *(CELL_VERSION, __version__, scene.inputs, model.model_dump(), step1.model_dump()),
                        *(policy, budget, seed, limit, self.device, self.threads),
                    ]
                )
                folder = self.request.out / "step1" / scene.name / key
                tasks[key] = {
                    "kind": "step1",
                    "key": key,
                    "workspace": str(scene.workspace.root),
                    "settings": settings.model_dump(mode="json"),
                    "policy": policy,
                    "seconds": limit,
                    "pace": str(self._pace_file(scene, "step1", model, step1, policy, budget)),
                    "seed": seed,
                    "folder": str(folder),
                    "output": f"{folder}.json",
                    "label": f"{scene.name} step 1",
                }
                found[scene.name, row.name] = tasks[key]
        self._work(f"step 1, seed {seed}", list(tasks.values()))
        return {place: task | {"result": _read(task)} for place, task in found.items()}

    # -- cells -----------------------------------------------------------------------------------------

    def _cells(self, seed: int, step1: dict[tuple[str, str], dict[str, Any]]) -> None:
        tasks: dict[str, dict[str, Any]] = {}
        for scene in self.scenes:
            chosen = {row.name: self._views(scene, row, seed, step1) for row in self.request.rows}
            everything = sorted({name for names in chosen.values() for name in names})
            by_spp: dict[int | None, set[str]] = {}
            for row in self.request.rows:
                by_spp.setdefault(row.spp, set()).update(chosen[row.name])
            traced = {
                spp: trace_train(scene, self.request.base, self.console, names, spp) for spp, names in by_spp.items()
            }
            bases: dict[str, dict[str, str]] = {}
            for row in self.request.rows:
                settings = self._settings(row, scene)
                kind = settings.model.base
                if needs_base(row, settings) and kind not in bases:
                    bases[kind] = make_bases(scene, settings, self.console, everything)
                coarse = step1.get((scene.name, row.name)) if settings.finetune.step2.start == "coarse" else None
                base = bases[kind] if needs_base(row, settings) else {}
                task = self._cell(scene, row, seed, settings, chosen[row.name], traced[row.spp], coarse, base)
                self.cells[scene.name, row.name, seed] = task["key"]
                tasks.setdefault(task["key"], task)
        self._work(f"cells, seed {seed}", list(tasks.values()))

    def _cell(
        self,
        scene: Scene,
        row: Row,
        seed: int,
        settings: Settings,
        views: list[str],
        traced: dict[str, str],
        coarse: dict[str, Any] | None,
        bases: dict[str, str],
    ) -> dict[str, Any]:
        """The cell's task; its key is a hash of all that decides what comes out."""
        model, step2 = settings.model.model_dump(mode="json"), settings.finetune.step2.model_dump(mode="json")
        used = [f"train/{name}" for name in views if row.network] + [f"test/{name}" for name in scene.test]
        base = [bases[name] for name in used] if bases else None
        time = [self.request.seconds, row.full_step1] if self.request.seconds else None
        train = [seed, [traced[name] for name in views], step2, coarse and coarse["key"], time]
        key = digest(
            [CELL_VERSION, __version__, scene.inputs, sorted(self.references[scene.name].values()), model, base]
            + ([train, self.device, self.threads] if row.network else [])
            + [self.perceptual]
        )
        folder = self.request.out / "cells" / scene.name
        return {
            "kind": "cell",
            "key": key,
            "scene": scene.name,
            "seed": seed,
            "workspace": str(scene.workspace.root),
            "settings": settings.model_dump(mode="json"),
            "network": row.network,
            "views": views if row.network else [],
            "targets": traced_split(self.request.base, row.spp),
            "coarse": coarse and coarse["folder"],
            "coarse_cost": coarse and coarse["result"],
            "seconds": self.request.seconds if row.network else None,
            "full_step1": row.full_step1,
            "pace": str(self._pace_file(scene, "step2", settings.model, settings.finetune.step2, str(len(views)))),
            "folder": str(folder / key),
            "output": str(folder / f"{key}.json"),
            "picture": str(folder / f"{key}.png") if seed == 0 else None,
            "code": code_state(),
            "label": f"{scene.name} {row.name}",
        }

    def _pace_file(self, scene: Scene, step: str, model: ModelSettings, schedule: Strict, *more: str | int) -> Path:
        """Where the seconds of an epoch are kept; whatever makes epochs longer or shorter is in the name."""
        parts = [CELL_VERSION, scene.inputs, step, model.model_dump(), schedule.model_dump(mode="json"), *more]
        return self.request.out / "pace" / scene.name / f"{digest([*parts, self.device, self.threads])}.json"

    def _views(self, scene: Scene, row: Row, seed: int, step1: dict[tuple[str, str], dict[str, Any]]) -> list[str]:
        budget = row.budget or self.request.base.select.budget
        if row.views == "rl":
            return step1[scene.name, row.name]["result"]["selected"]
        if row.views == "all":
            return list(scene.train)
        return scene.random(budget, seed) if row.views == "random" else scene.farthest(budget)

    def _settings(self, row: Row, scene: Scene | None = None) -> Settings:
        """The row's settings; with a scene, without what its effect plan leaves off."""
        settings = settings_of(row, self.request.base, self.request.overrides)
        if not row.network and settings.model.base == "none":
            raise UserError(f"row {row.name}: preset '{settings.preset}' has no base image (model.base is none)")
        if scene is None:
            return settings
        model = plan_of(scene.workspace, settings).model(settings.model)
        return settings.model_copy(update={"model": model})

    def _work(self, label: str, tasks: Sequence[dict[str, Any]]) -> None:
        self.worker_pool.work(label, "dnrpipe.studies.cells.cell", tasks)


def _read(task: dict[str, Any]) -> dict[str, Any]:
    return json.loads(Path(task["output"]).read_text(encoding="utf-8"))

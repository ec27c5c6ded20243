"""`dnrpipe ablate` behind its options: the loop over all cells, and what it writes.

<out>/, beside what every study has (`cells.study`)
  scenes/<scene>.dnr    workspaces
  pictures/<scene>.png  one test view: reference and rows side by side
  tables.md  plot.png
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dnrtrain.atomic import write_text
from dnrtrain.selector.names import TRAINED_NAMES

from ...core.console import Console
from ...core.errors import UserError
from ...core.settings import Settings, resolve
from ...stages.stage import Run
from ..cells.cell import STEP1_SHARE
from ..cells.measure import METRICS, mean_of, pictured
from ..cells.request import SMOKE_RUN, SMOKE_SCENE, merged
from ..cells.scenes import (
    BY_POSE,
    Scene,
    choose_by_pose,
    find_scenes,
    make_bases,
    prepared,
    raster_engine,
    scene_workspace,
    trace_references,
    trace_train,
    without_left_out,
)
from ..cells.study import CELL_WORKER, Study
from ..cells.tasks import CellTask, Step1Task
from .ablation_plots import contact_sheet, plot
from .ablation_tables import SCHEMA, markdown
from .rows import Row, choose_rows, needs_base, needs_coarse, settings_of, step1_policy

SMOKE, SMOKE_ROWS = {"cameras": {"train": 6, "val": 1}, "select": {"budget": 3}}, "vanilla,paper"


def run_ablation(
    *,
    scenes: str | None,
    rows: str | None,
    preset: str,
    budget: int | None,
    assignments: Sequence[str],
    smoke: bool,
    console: Console,
    **more: Any,
) -> dict[str, Any]:
    """`Study.carry_out` with the command's options. more: fields of `Study`.

    Raises UserError: unknown names, settings that do not fit.
    """
    budgeted = {} if budget is None else {"select": {"budget": budget}}
    overrides = merged([*([SMOKE_RUN, SMOKE] if smoke else []), budgeted], assignments)
    return Ablation(
        sources=find_scenes(scenes or (SMOKE_SCENE if smoke else None)),
        rows=choose_rows(rows or (SMOKE_ROWS if smoke else "core")),
        base=resolve(preset, overrides, environment={}),
        overrides=overrides,
        console=console,
        **more,
    ).carry_out()


@dataclass(kw_only=True)
class Ablation(Study[tuple[str, str, int]]):
    """Cells by (scene, row, seed). overrides: the user's settings, which hold for all rows; ``base`` has them, too."""

    COMMAND, SCHEMA = "ablate", SCHEMA
    rows: list[Row]
    overrides: dict[str, Any]
    scenes: list[Scene] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        for row in self.rows:  # a row whose settings cannot be is refused before any work is done
            self.settings_of(row)

    def open_scenes(self) -> None:
        with self.console.bar("scenes", len(self.sources)) as bar:
            for source in self.sources:
                scene = self._open(source)
                self.references[scene.name] = trace_references(scene, self.base)
                self.scenes.append(scene)
                bar.advance(note=scene.name)

    def _open(self, source: Path) -> Scene:
        workspace = scene_workspace(source, self.out / "scenes" / f"{source.stem}.dnr")
        return prepared(source.stem, Run(workspace, self.base, self.console), self.COMMAND)

    def plan_cells(self, seed: int) -> None:
        step1: dict[tuple[str, str], Step1Task] = {}
        for scene in self.scenes:
            for row in self.rows:
                settings = self.settings_of(row, scene)
                if needs_coarse(row, settings):
                    seconds = STEP1_SHARE * self.seconds if self.seconds else None
                    step1[scene.name, row.name] = self.step1_task(
                        scene, settings, step1_policy(settings), seed, seconds
                    )
        self.worker_pool.work(f"step 1, seed {seed}", CELL_WORKER, step1.values())
        for scene in self.scenes:
            self._plan_scene(scene, seed, step1)

    def _plan_scene(self, scene: Scene, seed: int, step1: dict[tuple[str, str], Step1Task]) -> None:
        own = {row.name: self.settings_of(row, scene) for row in self.rows}
        chosen = {row.name: self._views(scene, row, own[row.name], seed, step1) for row in self.rows}
        everything = sorted({name for names in chosen.values() for name in names})
        by_spp: dict[int | None, set[str]] = {}
        for row in self.rows:
            by_spp.setdefault(row.spp, set()).update(chosen[row.name])
        traced = {spp: trace_train(scene, self.base, names, spp) for spp, names in by_spp.items()}
        bases: dict[str, dict[str, str]] = {}
        for row in self.rows:
            settings = own[row.name]
            kind, based = settings.model.base, needs_base(row, settings)
            if based and kind not in bases:
                bases[kind] = make_bases(scene, settings, everything)
            self.cells[scene.name, row.name, seed] = self.cell_task(
                scene,
                settings,
                seed,
                {name: traced[row.spp][name] for name in chosen[row.name]},
                step1.get((scene.name, row.name)) if settings.starts_coarse else None,
                bases[kind] if based else {},
                label=row.name,
                network=row.network,
                spp=row.spp,
                picture=seed == 0,
            )

    def _views(
        self, scene: Scene, row: Row, settings: Settings, seed: int, step1: dict[tuple[str, str], Step1Task]
    ) -> list[str]:
        if row.everything:
            return list(scene.train)
        policy = settings.select.policy
        if policy in TRAINED_NAMES:
            return step1[scene.name, row.name].result().selected
        budget = row.budget or self.base.select.most
        # Farthest points are the same views for every seed.
        chosen = choose_by_pose(list(scene.train.values()), policy, budget, seed if policy == "random" else 0)
        return [view.name for view in chosen]

    def settings_of(self, row: Row, scene: Scene | None = None) -> Settings:
        """The row's settings; with a scene, without what its effect plan leaves off."""
        settings = settings_of(row, self.base, self.overrides)
        if not row.network and settings.model.base == "none":
            raise UserError(f"row {row.name}: preset '{settings.preset}' has no base image (model.base is none)")
        policy = settings.select.policy
        if not row.everything and policy not in (*BY_POSE, *TRAINED_NAMES):
            known = ", ".join((*BY_POSE, *TRAINED_NAMES))
            raise UserError(f"row {row.name}: select.policy={policy}: an ablation's views are chosen by {known}")
        return settings if scene is None else without_left_out(scene.workspace, settings)

    # -- results ---------------------------------------------------------------------------------------

    def compared(self) -> dict[str, Any]:
        return {
            "budget": self.base.select.most,
            "device": self.device,
            "threads": self.threads,
            "precision": sorted({self.precision_of(self.settings_of(row)) for row in self.rows}),
            "rows": {row.name: row.what for row in self.rows},
        }

    def line(self, place: tuple[str, str, int], task: CellTask) -> dict[str, Any]:
        cell = task.result()
        training = cell.training
        step1 = training and training.step1
        return {
            **dict(zip(("scene", "row", "seed"), place, strict=True)),
            "key": cell.key,
            **{name: mean_of(cell.tests, name) for name in METRICS},
            "train_psnr": cell.train_psnr and round(cell.train_psnr, 5),
            "views": len(cell.views),
            "epochs": training and training.epochs,
            "steps": training and training.step2.steps,
            "step1_steps": step1 and step1.steps,
            "raster_engine": raster_engine(task.workspace) if step1 else None,
            "train_seconds": training and round(training.seconds, 2),
            "train_cpu_seconds": training and round(training.cpu_seconds, 2),
            "step1_cpu_seconds": step1 and round(step1.cpu_seconds, 2),
            "frame_ms": cell.frame_ms and round(cell.frame_ms, 2),
            "base_ms": cell.base_ms and round(cell.base_ms, 2),
            "commit": cell.code["commit"],
        }

    def show(self, results: dict[str, Any]) -> None:
        out = self.out
        write_text(out / "tables.md", markdown(results))
        plot(results, out / "plot.png")
        for scene in results["scenes"]:
            pictures = [("reference", out / "cells" / scene / "truth.png")]
            for (name, row, _), task in self.cells.items():
                if name == scene and task.picture is not None and task.output.exists():
                    pictures.append((f"{row} {pictured(task.result().tests)['psnr']:.1f} dB", task.picture))
            if len(pictures) > 1 and all(path.exists() for _, path in pictures):
                contact_sheet(pictures, out / "pictures" / f"{scene}.png")

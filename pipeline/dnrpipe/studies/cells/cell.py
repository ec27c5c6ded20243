"""One cell of a study, (scene, row, seed), in a worker process: train, measure, write one JSON file.

Scenes are loaded once per process and kept while cells ask for them.
"""

from __future__ import annotations

import functools
import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from filelock import FileLock
from pydantic import Field, TypeAdapter

from dnrtrain.atomic import write_json
from dnrtrain.contract import ContractError
from dnrtrain.events import Event, Selected

from ...core.scene_files import read_frame, split_views
from ...core.settings import Settings
from ...core.workspace import Workspace
from ...stages.trainer import perceptual_weights
from .measure import base_pictures, measure, network_pictures, rendered_ms, training_psnr
from .scenes import base_files, raster_file
from .tasks import CellResult, CellTask, FileWorker, Step1Result, Step1Task, Training, TrainingCost

if TYPE_CHECKING:
    from dnrtrain.dataset import Base, ViewSet
    from dnrtrain.records import Epoch

CELL_VERSION = 4  # raise when training or measuring changes what a cell holds, or what fingerprints hash
STEP1_SHARE = 1 / 3
"""Share of the training time that step 1 may take where all rows train equally long."""


class Worker(FileWorker):
    TASK = TypeAdapter(Annotated[Step1Task | CellTask, Field(discriminator="kind")])

    def __init__(self, common: dict[str, Any]) -> None:
        super().__init__(common)
        self.views = functools.lru_cache(maxsize=8)(load_cell_views)  # a cell needs two
        self.weights = perceptual_weights(None)  # the parent has told; fingerprints of cells hold whether there are any

    def answer(self, task: Step1Task | CellTask) -> Step1Result | CellResult:
        return self._step1(task) if isinstance(task, Step1Task) else self._cell(task)

    def _step1(self, task: Step1Task) -> Step1Result:
        """The coarse model on rasterised candidates, and the views its policy chooses."""
        settings = task.settings
        if task.seconds is not None:
            limit = max(1, int(task.seconds / self._pace(task)))
            settings = _with_epochs(settings, min(limit, settings.select.step1.epochs))
        events = self._events(task, settings, task.folder)
        selected = next(event for event in events if isinstance(event, Selected))
        return Step1Result(
            key=task.fingerprint,
            selected=selected.selection.views,
            epochs=settings.select.step1.epochs,
            **training_cost(task.folder).model_dump(),
        )

    def _cell(self, task: CellTask) -> CellResult:
        """Train where the row has a network, measure all test views, keep one picture."""
        settings, base = task.settings, task.settings.model.base
        workspace = Workspace.open(task.workspace)
        test = self.views(task.workspace, "test", raytraced=True, base=base)
        training = self._train(task) if task.network else None
        if task.network:
            pictures, frame_ms = network_pictures(task.folder, test, self.device)
            learned = training_psnr(task.folder, self._training_views(task), self.device)
            shutil.rmtree(task.folder)
        else:
            pictures, frame_ms, learned = base_pictures(test), None, None
        return CellResult(
            key=task.fingerprint,
            scene=task.scene,
            seed=task.seed,
            settings={
                "model": settings.model.model_dump(mode="json"),
                "step2": settings.finetune.step2.model_dump(mode="json"),
            },
            views=task.views,
            training=training,
            train_psnr=learned,
            frame_ms=frame_ms,
            base_ms=rendered_ms(base_files(workspace, base, "test", test.names)),
            threads=self.threads,
            device=self.device,
            tests=measure(pictures, test, workspace, self.weights, task.picture),
            code=task.code,
            finished=time.time(),
        )

    # -- training --------------------------------------------------------------------------------------

    def _train(self, task: CellTask) -> Training:
        """Step 2 in the cell's own folder."""
        settings, coarse = task.settings, task.coarse_cost
        if task.seconds is not None:
            pace = self._pace(task)
            spent = STEP1_SHARE * task.seconds if task.full_step1 else self._clock(coarse) if coarse else 0.0
            left = task.seconds - spent
            if left < pace:
                raise ContractError(
                    f"--seconds {task.seconds:g}: step 1 leaves {max(left, 0.0):.1f} s, and an epoch of step 2"
                    f" takes {pace:.1f} s; give more"
                )
            settings = _with_epochs(settings, int(left / pace))
        for _ in self._events(task, settings, task.folder):
            pass
        cost = training_cost(task.folder)
        return Training(
            epochs=settings.finetune.step2.epochs,
            step1=coarse,
            step2=cost,
            seconds=cost.seconds + (coarse.seconds if coarse else 0.0),
            cpu_seconds=cost.cpu_seconds + (coarse.cpu_seconds if coarse else 0.0),
            perceptual=self.weights is not None,
        )

    def _pace(self, task: Step1Task | CellTask) -> float:
        """Seconds of one epoch: the second of two (the first warms up), kept for the row's other seeds."""
        from dnrtrain.checkpoint import finished_record

        task.pace.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{task.pace}.lock"):  # cells side by side train by one figure, not by one each
            if not task.pace.exists():
                scratch = task.folder.with_name(f"{task.folder.name}.pace")
                for _ in self._events(task, _with_epochs(task.settings, 2), scratch):
                    pass
                last = finished_record(scratch).history[-1]
                shutil.rmtree(scratch)
                write_json(task.pace, self._clock(last))
        return float(json.loads(task.pace.read_text()))

    def _clock(self, cost: TrainingCost | Epoch) -> float:
        """Seconds of training; on a CPU by processor time, which other work on the machine does not stretch."""
        return cost.cpu_seconds / self.threads if self.device == "cpu" else cost.seconds

    def _events(self, task: Step1Task | CellTask, settings: Settings, folder: Path) -> Iterator[Event]:
        """Train the task's step into ``folder``."""
        from dnrtrain.step1 import run_step1
        from dnrtrain.step2 import run_step2

        run: dict[str, Any] = {"seed": task.seed, "device": self.device, "checkpoints": folder}
        run["fingerprint"] = task.fingerprint
        model, step1, step2 = settings.model, settings.select.step1, settings.finetune.step2
        if isinstance(task, Step1Task):
            views = self.views(task.workspace, "train", raytraced=False, base="none")
            return run_step1(views, None, model, step1, policy=task.policy, budget=settings.select.most, **run)
        coarse = task.coarse or folder  # not read by a fresh start
        return run_step2(self._training_views(task), None, coarse, model, step2, weights=self.weights, **run)

    def _training_views(self, task: CellTask) -> ViewSet:
        names, base = tuple(task.views), task.settings.model.base
        return self.views(task.workspace, "train", names, raytraced=True, base=base, targets=task.targets)


def load_cell_views(
    root: Path,
    split: str,
    names: tuple[str, ...] | None = None,
    *,
    raytraced: bool,
    base: Base,
    targets: str | None = None,
) -> ViewSet:
    """Views of a workspace with ray-traced or rasterised targets and their base images.

    names: None for all of the split. targets: folder of the ray-traced pictures, where it is not the split's.
    """
    from dnrtrain.dataset import load_views

    workspace = Workspace.open(root)
    views = {view.name: view for view in split_views(workspace)[split]}
    chosen = [views[name] for name in names or views]
    bases = base_files(workspace, base, split, [view.name for view in chosen])
    passes = [workspace.passes(split, view.name) for view in chosen]
    if base == "raster" and split == "test":
        passes = [raster_file(workspace, view.name) for view in chosen]
    return load_views(
        bases or passes,
        [workspace.raytraced(targets or split, view.name) for view in chosen] if raytraced else None,
        read_frame(workspace),
        cameras=chosen,
        folder=workspace.scene,
        base=base,
        base_files=bases or None,
    )


def _with_epochs(settings: Settings, epochs: int) -> Settings:
    """Of whichever step is trained by them."""
    changed = settings.model_copy(deep=True)
    changed.select.step1.epochs = changed.finetune.step2.epochs = epochs
    return changed


def training_cost(folder: Path) -> TrainingCost:
    """Sums over all epochs, those of an interrupted run included, and what the choice at the end took."""
    from dnrtrain.checkpoint import finished_record

    record = finished_record(folder)
    cost: dict[str, Any] = {
        name: sum(getattr(epoch, name) for epoch in record.history) + record.choosing.get(name, 0)
        for name in TrainingCost.model_fields
    }
    return TrainingCost(**cost)

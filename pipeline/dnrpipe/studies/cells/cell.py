"""One cell of the ablation, (scene, row, seed), in a worker process: train, measure, write one JSON file.

Tasks are JSON (see :class:`Worker`). Scenes are loaded once per process and kept while cells ask for them.
"""

from __future__ import annotations

import json
import shutil
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock

from dnrtrain.atomic import write_json
from dnrtrain.contract import ContractError
from dnrtrain.events import Event, Selected

from ...core.scene_files import read_frame, split_views
from ...core.settings import Settings
from ...core.workspace import Workspace
from .measure import base_pictures, measure, network_pictures, rendered_ms
from .scenes import base_file, raster_file

if TYPE_CHECKING:
    from dnrtrain.dataset import ViewSet
    from dnrtrain.records import ModelRecord

STEP1_SHARE = 1 / 3
"""Share of the training time that step 1 may take where all rows train equally long."""
KEPT_SETS = 8
"""Sets of views in memory; a cell needs two."""


class Worker:
    """Runs tasks of two kinds; the answer is what the task's ``output`` file holds.

    step1   workspace, settings, policy, seed, seconds (at most; or None) -> {"selected", "epochs", its cost}
    cell    ... views, targets (folder under raytraced/ of their pictures; default train), coarse (folder of step 1
            or None), seconds (both steps; or None) -> see ``_cell``
    """

    def __init__(self, common: dict[str, Any]) -> None:
        import torch

        from dnrtrain.weights import WeightsMissing, load_weights

        if common["threads"]:
            torch.set_num_threads(common["threads"])
        self.device, self.threads = common["device"], torch.get_num_threads()
        self.memory: OrderedDict[str, ViewSet] = OrderedDict()
        try:
            self.weights: Any = load_weights()
        except WeightsMissing:  # the parent has said so, and cells are keyed by it
            self.weights = None

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        settings = Settings.model_validate(task["settings"])
        workspace = Workspace.open(Path(task["workspace"]))
        made = (self._step1 if task["kind"] == "step1" else self._cell)(task, settings, workspace)
        write_json(Path(task["output"]), made)
        return made

    # -- the two kinds of tasks ------------------------------------------------------------------------

    def _step1(self, task: dict[str, Any], settings: Settings, workspace: Workspace) -> dict[str, Any]:
        """The coarse model on rasterised candidates, and the views its policy chooses."""
        folder = Path(task["folder"])
        if task["seconds"] is not None:
            short = settings.model_copy(deep=True)
            short.select.step1.epochs = 2
            pace = self._pace(Path(task["pace"]), folder, lambda at: self._coarse(task, short, workspace, at))
            settings = settings.model_copy(deep=True)
            settings.select.step1.epochs = min(max(1, int(task["seconds"] / pace)), settings.select.step1.epochs)
        selected = next(e for e in self._coarse(task, settings, workspace, folder) if isinstance(e, Selected))
        epochs = settings.select.step1.epochs
        return {"key": task["key"], "selected": selected.views, "epochs": epochs, **training_cost(folder)}

    def _coarse(self, task: dict[str, Any], settings: Settings, workspace: Workspace, folder: Path) -> Iterator[Event]:
        from dnrtrain.step1 import run_step1

        views = self._views(workspace, "train", None, raytraced=False, base="none")
        return run_step1(
            views,
            None,
            settings.model,
            settings.select.step1,
            policy=task["policy"],
            budget=settings.select.budget,
            seed=task["seed"],
            device=self.device,
            checkpoints=folder,
            fingerprint=task["key"],
        )

    def _cell(self, task: dict[str, Any], settings: Settings, workspace: Workspace) -> dict[str, Any]:
        """Train where the row has a network, measure all test views, keep one picture."""
        base = settings.model.base
        test = self._views(workspace, "test", None, raytraced=True, base=base)
        training: dict[str, Any] | None = None
        if task["network"]:
            training, folder = self._train(task, settings, workspace)
            pictures, frame_ms = network_pictures(folder, test, self.device)
            shutil.rmtree(folder)
        else:
            pictures, frame_ms = base_pictures(test), None
        rows = measure(pictures, test, workspace, self.weights, Path(task["picture"]) if task["picture"] else None)
        return {
            "key": task["key"],
            "scene": task["scene"],
            "seed": task["seed"],
            "settings": {
                "model": settings.model.model_dump(mode="json"),
                "step2": settings.finetune.step2.model_dump(mode="json"),
            },
            "views": task["views"],
            "training": training,
            "frame_ms": frame_ms,
            "base_ms": None if base in ("none", "raster") else self._base_ms(workspace, base, test),
            "threads": self.threads,
            "device": self.device,
            "tests": rows,
            "code": task["code"],
            "finished": time.time(),
        }

    # -- training --------------------------------------------------------------------------------------

    def _train(self, task: dict[str, Any], settings: Settings, workspace: Workspace) -> tuple[dict[str, Any], Path]:
        """Step 2 in the cell's own folder -> (what training took, folder of the model)."""
        folder = Path(task["folder"])
        coarse: dict[str, Any] | None = task["coarse_cost"]
        pace = None
        if task["seconds"] is not None:
            short = settings.model_copy(deep=True)
            short.finetune.step2.epochs = 2
            pace = self._pace(Path(task["pace"]), folder, lambda at: self._step2(task, short, workspace, at))
            spent = STEP1_SHARE * task["seconds"] if task["full_step1"] else self._clock(coarse) if coarse else 0.0
            left = task["seconds"] - spent
            if left < pace:
                raise ContractError(
                    f"--seconds {task['seconds']:g}: step 1 leaves {max(left, 0.0):.1f} s, and an epoch of step 2"
                    f" takes {pace:.1f} s; give more"
                )
            settings = settings.model_copy(deep=True)
            settings.finetune.step2.epochs = int(left / pace)
        for _ in self._step2(task, settings, workspace, folder):
            pass
        cost = training_cost(folder)
        return {
            "epochs": settings.finetune.step2.epochs,
            "seconds_per_epoch": pace,
            "step1": coarse,
            "step2": cost,
            "seconds": cost["seconds"] + (coarse["seconds"] if coarse else 0.0),
            "cpu_seconds": cost["cpu_seconds"] + (coarse["cpu_seconds"] if coarse else 0.0),
            "perceptual": self.weights is not None,
        }, folder

    def _pace(self, file: Path, folder: Path, train: Callable[[Path], Iterator[Event]]) -> float:
        """Seconds of one epoch: the second of two (the first warms up), kept in ``file`` for the row's other seeds."""
        file.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{file}.lock"):  # cells side by side train by one figure, not by one each
            if not file.exists():
                scratch = folder.with_name(f"{folder.name}.pace")
                for _ in train(scratch):
                    pass
                last = _record(scratch).history[-1]
                shutil.rmtree(scratch)
                write_json(file, self._clock(last.data()))
        return float(json.loads(file.read_text()))

    def _clock(self, cost: dict[str, Any]) -> float:
        """Seconds of training; on a CPU by processor time, which other work on the machine does not stretch."""
        return cost["cpu_seconds"] / self.threads if self.device == "cpu" else cost["seconds"]

    def _step2(self, task: dict[str, Any], settings: Settings, workspace: Workspace, folder: Path) -> Iterator[Event]:
        from dnrtrain.step2 import run_step2

        return run_step2(
            self._views(
                workspace,
                "train",
                task["views"],
                raytraced=True,
                base=settings.model.base,
                targets=task.get("targets"),
            ),
            None,
            Path(task["coarse"] or folder),  # not read by a fresh start
            settings.model,
            settings.finetune.step2,
            seed=task["seed"],
            device=self.device,
            checkpoints=folder,
            fingerprint=task["key"],
            weights=self.weights,
        )

    def _base_ms(self, workspace: Workspace, kind: str, views: ViewSet) -> float | None:
        return rendered_ms([base_file(workspace, kind, "test", name) for name in views.names])

    # -- data ------------------------------------------------------------------------------------------

    def _views(
        self,
        workspace: Workspace,
        split: str,
        names: list[str] | None,
        *,
        raytraced: bool,
        base: str,
        targets: str | None = None,
    ) -> ViewSet:
        """Views of the split (None: all), with ray-traced or rasterised targets; from memory if they are there.

        targets: folder of the ray-traced pictures, where it is not the split's.
        """
        key = repr((workspace.root, split, names, raytraced, base, targets))
        if key not in self.memory:
            self.memory[key] = load_cell_views(workspace, split, names, raytraced=raytraced, base=base, targets=targets)
        self.memory.move_to_end(key)
        while len(self.memory) > KEPT_SETS:
            self.memory.popitem(last=False)
        return self.memory[key]


def load_cell_views(
    workspace: Workspace,
    split: str,
    names: list[str] | None,
    *,
    raytraced: bool,
    base: str,
    targets: str | None = None,
) -> ViewSet:
    """Views of the split (None: all) with ray-traced or rasterised targets and their base images.

    targets: folder of the ray-traced pictures, where it is not the split's.
    """
    from dnrtrain.dataset import load_views

    views = {view.name: view for view in split_views(workspace)[split]}
    chosen = [views[name] for name in names or views]
    passes = [workspace.passes(split, view.name) for view in chosen]
    extra: dict[str, Any] = {}
    if base == "raster":
        extra = {"base": base}
        if split == "test":
            passes = [raster_file(workspace, view.name) for view in chosen]
    elif base != "none":
        extra = {"base": base, "base_files": [base_file(workspace, base, split, view.name) for view in chosen]}
    images = [workspace.raytraced(targets or split, view.name) for view in chosen] if raytraced else None
    frame = read_frame(workspace)
    return load_views(passes, images, frame, cameras=chosen, folder=workspace.scene, **extra)


def _record(folder: Path) -> ModelRecord:
    from dnrtrain.checkpoint import read_record

    record = read_record(folder)
    assert record is not None  # its step has just finished
    return record


def training_cost(folder: Path) -> dict[str, Any]:
    """Sums over all epochs, those of an interrupted run included, and what the choice at the end took."""
    record = _record(folder)
    names = ("seconds", "cpu_seconds", "steps", "skipped")
    cost: dict[str, Any] = {name: sum(getattr(epoch, name) for epoch in record.history) for name in names}
    for name, value in record.choosing.items():
        cost[name] += value
    return cost


CELL_VERSION = 1  # raise when training or measuring changes what a cell holds

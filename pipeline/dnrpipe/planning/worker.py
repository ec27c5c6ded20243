"""The pilot's worker: a short training, and frames of ours and of path tracing with a denoiser."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dnrtrain.contract import View
from dnrtrain.exr import read_exr, read_metadata

from ..scene_files import read_frame
from ..settings import Settings
from ..workspace import Workspace

if TYPE_CHECKING:
    from dnrtrain.dataset import ViewSet

WARM = 2


class Worker:
    """Answers the pilot's tasks.

    common: {"workspace", "settings", "threads"}
    task "train": {"views", "base_files", "images", "folder", "fingerprint", "epochs"}
        -> {"seconds", "cpu_seconds": of a step, "startup", "steps", "threads"}
    task "frames": {"views", "images", "folder": of the model, "light", "samples", "methods": the ladder}
        -> {"base", "neural", "rival": rows {"name", "ms", "psnr"}, "noise_rmse"}
    """

    def __init__(self, common: dict[str, Any]) -> None:
        import torch

        if common["threads"]:
            torch.set_num_threads(int(common["threads"]))
        self.threads = torch.get_num_threads()
        self.workspace = Workspace.open(Path(common["workspace"]))
        self.settings = Settings.model_validate(common["settings"])

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        views = [View.model_validate(view) for view in task["views"]]
        return self._train(task, views) if task["kind"] == "train" else self._frames(task, views)

    def _train(self, task: dict[str, Any], views: list[View]) -> dict[str, Any]:
        from dnrtrain.checkpoint import read_record
        from dnrtrain.step2 import run_step2
        from dnrtrain.weights import WeightsMissing, load_weights

        from ..training import torch_device

        try:
            weights: Any = load_weights()
        except WeightsMissing:  # training will do without, too
            weights = None
        started = time.monotonic()
        step2 = self.settings.finetune.step2.model_copy(
            update={"epochs": task["epochs"], "start": "fresh", "validation_views": 0}
        )
        folder = Path(task["folder"])
        events = run_step2(
            self._load(views, task),
            None,
            folder,
            self.settings.model,
            step2,
            seed=self.settings.finetune.seed,
            device=torch_device(self.settings),
            checkpoints=folder,
            fingerprint=task["fingerprint"],
            weights=weights,
        )
        for _ in events:
            pass
        took = time.monotonic() - started
        record = read_record(folder)
        assert record is not None  # training has just finished
        history = record["history"]
        later = history[1:] or history  # the first epoch warms up
        steps = sum(entry["steps"] for entry in later)
        seconds = sum(entry["seconds"] for entry in later) / steps
        total = sum(entry["steps"] for entry in history)
        return {
            "seconds": seconds,
            "cpu_seconds": sum(entry["cpu_seconds"] for entry in later) / steps,
            "startup": max(0.0, took - seconds * total),
            "steps": total,
            "threads": self.threads,
        }

    def _load(self, views: list[View], task: dict[str, Any]) -> ViewSet:
        from dnrtrain.dataset import load_views

        files = [Path(path) for path in task["base_files"]]
        return load_views(
            files,  # base images bring their G-buffer along
            [Path(path) for path in task["images"]],
            read_frame(self.workspace),
            cameras=views,
            folder=self.workspace.scene,
            base=self.settings.model.base,
            base_files=files,
        )

    def _frames(self, task: dict[str, Any], views: list[View]) -> dict[str, Any]:
        from ..frames.ours import BASE, NEURAL, Ours
        from ..frames.rival import climb, make_rungs
        from ..frames.scene import Clock, open_scene

        scene = open_scene(self.workspace.root, views, self.threads, self.settings)
        light = Path(task["light"]) if task["light"] else None
        ours = Ours(scene, (), Path(task["folder"]), light)
        truth = [scene.shown(_picture(Path(path))) for path in task["images"]]
        noises = [(read_metadata(Path(path)) or {}).get("noise_rmse") or 0.0 for path in task["images"]]
        clock, samples, methods = Clock("cpu", self.threads), tuple(task["samples"]), tuple(task["methods"])
        for _ in range(WARM):
            climb(scene, views[0], 1, clock, make_rungs(samples, methods))
            ours.frame(views[0], clock)
        rungs = make_rungs(samples, methods)
        rows: dict[str, _Row] = {}
        for number, view in enumerate(views):
            climb(scene, view, 10_007 * (number + 1), clock, rungs)
            for name, frame in ours.frame(view, clock).items():
                row = rows.setdefault(BASE if name.startswith(BASE) else NEURAL, _Row())
                row.add(frame["picture"], truth[number], frame["parts"])
        rival = []
        for rung in rungs.values():
            row = _Row()
            for number, picture in enumerate(rung.pictures):
                parts = {name: values[number] for name, values in rung.parts.items()}
                row.add(picture.float(), truth[number], parts)
            rival.append({"name": rung.name, **row.summary()})
        return {
            "base": {"name": BASE, **rows[BASE].summary()},
            "neural": {"name": NEURAL, **rows[NEURAL].summary()},
            "rival": rival,
            "noise_rmse": float(np.sqrt(np.mean(np.square(noises)))),
        }


class _Row:
    def __init__(self) -> None:
        self.ms: list[float] = []
        self.psnr: list[float] = []

    def add(self, picture: Any, truth: Any, parts: dict[str, float]) -> None:
        from dnrtrain.metrics import psnr

        self.ms.append(sum(parts.values()))
        self.psnr.append(float(psnr(picture, truth).mean()))

    def summary(self) -> dict[str, float]:
        return {"ms": float(np.median(self.ms)), "psnr": float(np.mean(self.psnr))}


def _picture(path: Path) -> np.ndarray:
    channels, _ = read_exr(path)
    return np.stack([channels[channel] for channel in "RGBA"], axis=-1)

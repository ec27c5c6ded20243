"""The pilot's worker: short trainings, and frames of ours and of path tracing with a denoiser.

Notation
    A, B      two independent path-traced pictures of a held-out view in display space, as they were traced
    D         a picture to be judged, made without their samples
    mse(D)    mean of (D - A)(D - B): the noise of A and that of B cancel in the product (`without_reference`)
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dnrtrain.contract import View

from ...core.scene_files import read_frame
from ...core.settings import Settings
from ...core.workspace import Workspace
from ...stages.trainer import perceptual_weights, torch_device
from ...stages.trust import best_share
from .records import Record

if TYPE_CHECKING:
    from dnrtrain.dataset import ViewSet
    from dnrtrain.model import DNR

    from ..frames.scene import BenchScene

WARM = 2
HALVES, REFERENCE_SPP = 2, 64
"""A and B are means of so many pictures of so many samples: a kernel that the baselines need anyway."""
SEED = 0x5EED0000
"""Far from the baselines' seeds, so that A and B share no samples with what they judge."""
LEAST_MSE = 1e-6


class PilotCommon(Record):
    """What all tasks share."""

    workspace: Path
    settings: Settings


class TrainTask(Record):
    """Train short step 2s on the same views -> fields of `records.TrainingPart`.

    Args:
        base_files, images: base images with their G-buffers, and path-traced pictures, a file per view.
        folders, epochs: of each training.
    """

    kind: Literal["train"] = "train"
    views: list[View]
    base_files: list[Path]
    images: list[Path]
    folders: list[Path]
    epochs: list[int]
    fingerprint: str


class FramesTask(Record):
    """Render and judge frames by every model, by the base image alone and by the baselines.

    The answer holds fields of `records.FramePart`, and "unknown": pixels that no reference knows.

    train: views with references, which say how far the shipped corrector is trusted. folders: of the models. light:
    file of the baked light, None where there is none. samples, methods: of the baselines.
    """

    kind: Literal["frames"] = "frames"
    views: list[View]
    train: TrainTask
    folders: list[Path]
    light: Path | None
    samples: list[int]
    methods: list[str]


class Worker:
    """Answers the pilot's tasks. common: a `PilotCommon`; task: a `TrainTask` or a `FramesTask`."""

    def __init__(self, common: dict[str, Any]) -> None:
        import torch

        shared = PilotCommon.model_validate(common)
        self.threads = torch.get_num_threads()
        self.workspace, self.settings = Workspace.open(shared.workspace), shared.settings

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        if task["kind"] == "train":
            return self._train(TrainTask.model_validate(task))
        return self._frames(FramesTask.model_validate(task))

    def _train(self, task: TrainTask) -> dict[str, Any]:
        weights = perceptual_weights(None)  # training will do without, too
        found = [
            self._train_one(task, weights, folder, epochs)
            for folder, epochs in zip(task.folders, task.epochs, strict=True)
        ]
        return found[-1] | {"steps": [one["steps"] for one in found], "threads": self.threads}

    def _train_one(self, task: TrainTask, weights: Any, folder: Path, epochs: int) -> dict[str, Any]:
        from dnrtrain.checkpoint import finished_record, step_seconds
        from dnrtrain.events import EpochEnd
        from dnrtrain.step2 import run_step2

        started = time.monotonic()
        step2 = self.settings.finetune.step2.model_copy(
            update={"epochs": epochs, "start": "fresh", "validation_views": 0}
        )
        events = run_step2(
            self._views(task),
            None,
            folder,
            self.settings.model,
            step2,
            seed=self.settings.finetune.seed,
            device=torch_device(self.settings),
            checkpoints=folder,
            fingerprint=task.fingerprint,
            weights=weights,
        )
        gaps, last = [], None
        for event in events:
            now = (time.monotonic(), time.process_time())
            if isinstance(event, EpochEnd):
                if last is not None:
                    gaps.append((now[0] - last[0] - event.seconds, now[1] - last[1] - event.cpu_seconds))
                last = now
        took = time.monotonic() - started
        between, cpu_between = np.maximum(0.0, np.median(gaps, axis=0)).tolist()
        record = finished_record(folder)
        (seconds, cpu_seconds), history = step_seconds(record), record.history
        booked = sum(entry.seconds for entry in history)
        return {
            "seconds": seconds,
            "cpu_seconds": cpu_seconds,
            "between": between,
            "cpu_between": cpu_between,
            "startup": max(0.0, took - booked - between * len(history)),
            "steps": sum(entry.steps for entry in history),
        }

    def _views(self, task: TrainTask, *, raw: bool = False) -> ViewSet:
        from dnrtrain.dataset import load_views

        return load_views(
            task.base_files,  # base images bring their G-buffer along
            task.images,
            read_frame(self.workspace),
            cameras=task.views,
            folder=self.workspace.scene,
            raw=raw,
            base=self.settings.model.base,
            base_files=task.base_files,
        )

    def _shipped(self, task: TrainTask) -> DNR | None:
        """The shipped corrector, as far as the training views trust it; None where it corrects no such base image."""
        from dnrtrain.shipped import corrector

        if self.settings.model.base != "baked":
            return None
        model = corrector()
        best_share(model, self._views(task, raw=True), self._views(task))
        return model

    def _frames(self, task: FramesTask) -> dict[str, Any]:
        from dnrtrain.checkpoint import load_model

        from ..frames.baselines import make_baselines, render_baselines
        from ..frames.ours import BASE, NEURAL, Ours
        from ..frames.scene import Clock, open_scene

        views = task.views
        scene = open_scene(self.workspace.root, views, self.threads, self.settings)
        ours = Ours(scene, (), task.folders[-1], task.light, smoothed=False)
        models = [load_model(folder) for folder in task.folders]
        shipped = self._shipped(task.train)
        models += [] if shipped is None else [shipped]
        truth = [_references(scene, view, number) for number, view in enumerate(views)]
        clock = Clock("cpu", self.threads)
        for _ in range(WARM):
            render_baselines(scene, views[0], 1, clock, make_baselines(task.samples, task.methods))
            ours.frame(views[0], clock)
        baselines = make_baselines(task.samples, task.methods)
        base, neural = _Row(), [_Row() for _ in models]
        for number, view in enumerate(views):
            render_baselines(scene, view, 10_007 * (number + 1), clock, baselines)
            for row, ours.model in zip(neural, models, strict=True):
                frames = ours.frame(view, clock)
                for name, frame in frames.items():
                    if name.startswith(NEURAL):
                        row.add(frame["picture"], truth[number], frame["parts"])
                    elif name.startswith(BASE) and row is neural[0]:
                        base.add(frame["picture"], truth[number], frame["parts"])
        rival = []
        for baseline in baselines.values():
            row = _Row()
            for number, picture in enumerate(baseline.pictures):
                parts = {name: values[number] for name, values in baseline.parts.items()}
                row.add(picture.float(), truth[number], parts)
            rival.append({"name": baseline.name, **row.summary()})
        return {
            "base": {"name": BASE, **base.summary()},
            "neural": [{"name": NEURAL, **row.summary()} for row in neural[: len(task.folders)]],
            "shipped": None if shipped is None else {"name": "shipped", **neural[-1].summary()},
            "rival": rival,
            "deviation": float(np.std(base.psnr, ddof=1)) if len(views) > 1 else 0.0,
            "unknown": sum(int((~known).sum()) for _, _, known in truth),
        }


class _Row:
    def __init__(self) -> None:
        self.ms: list[float] = []
        self.psnr: list[float] = []

    def add(self, picture: Any, truth: tuple[Any, Any, Any], parts: dict[str, float]) -> None:
        self.ms.append(sum(parts.values()))
        mean, error = without_reference(picture, *truth)
        self.psnr.append(-10 * math.log10(max(mean, error, LEAST_MSE)))

    def summary(self) -> dict[str, float]:
        return {"ms": float(np.median(self.ms)), "psnr": float(np.mean(self.psnr))}


def without_reference(picture: Any, first: Any, second: Any, known: Any) -> tuple[float, float]:
    """(mean square error of D = ``picture`` in display space, its standard error) without a noise-free reference.

    picture, first = A, second = B: [1, 3, H, W]; known: bool [H, W], pixels that count. For independent A and B whose
    mean is the truth T, E (D - A)(D - B) = (D - T)²: neither noise nor a denoiser's bias counts against D. The mean may
    come out below 0 where D is better than the noise lets tell. (The display curve bends the mean of A and B by half
    its curvature times their variance: a hundredth of a dark pixel's value at 30 % noise.)
    """
    products = ((picture - first) * (picture - second)).double().mean(dim=(0, 1))[known]
    return float(products.mean()), float(products.std() / math.sqrt(products.numel()))


def _references(scene: BenchScene, view: View, number: int) -> tuple[Any, Any, Any]:
    """(A, B, pixels that are finite in both), each the mean of HALVES pictures of REFERENCE_SPP samples.

    A sample picture counts where it is finite; a pixel that is so in none of a half is not known, and takes no part.
    """
    import torch

    shown, known = [], np.ones((view.height, view.width), bool)
    for half in range(2):
        seeds = [SEED + 1009 * number + 2 * part + half for part in range(HALVES)]
        images = np.stack([scene.frames.path(view, REFERENCE_SPP, seed) for seed in seeds])
        finite = np.isfinite(images).all(axis=-1, keepdims=True)
        count = finite.sum(axis=0)
        known &= count[..., 0] > 0
        mean = np.where(finite, images, 0).sum(axis=0) / np.maximum(count, 1)
        shown.append(scene.shown(mean))
    return shown[0], shown[1], torch.from_numpy(known)

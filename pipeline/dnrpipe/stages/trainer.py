"""Stage `finetune` (step 2), and what it shares with step 1: feed workspace files to the trainer, book its epochs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dnrtrain.contract import DamagedFile, View, read_cameras
from dnrtrain.events import Diverged, EpochEnd, Event, Note
from dnrtrain.records import PROGRESS, Progress, Selection, read

from ..core.console import Bar, Console
from ..core.errors import UserError
from ..core.ledger import CostRecord
from ..core.scene_files import read_frame
from ..core.settings import Settings
from ..core.workspace import Workspace
from .base_images import RENDERED, base_path

if TYPE_CHECKING:
    from dnrtrain.dataset import Base, ViewSet


def read_selection(workspace: Workspace) -> Selection:
    """``selection.json``. Raises UserError: there is none. DamagedFile: it does not read, or names other views."""
    path = workspace.selection
    try:
        selection = read(path, Selection)
    except FileNotFoundError:
        raise UserError(f"{workspace.root}: no views selected yet; run `dnrpipe select` first") from None
    cameras = workspace.cameras("train")
    unknown = sorted(set(selection.views) - {view.name for view in read_cameras(cameras)}) if cameras.exists() else []
    if unknown:
        raise DamagedFile(path, f"views {', '.join(unknown)[:200]} are no candidates")
    return selection


def load(
    workspace: Workspace, views: list[View], split: str, *, raytraced: bool = False, base: Base = "none"
) -> ViewSet:
    """G-buffers of the views, with rasterised (train, val) or ray-traced targets, or none (test).

    base: the base image to load beside them (:mod:`.base`).
    """
    from dnrtrain.dataset import load_views

    frame = read_frame(workspace)
    return load_views(
        [workspace.passes(split, view.name) for view in views],
        [workspace.raytraced(split, view.name) for view in views] if raytraced else None,
        frame,
        cameras=views,
        folder=workspace.scene,
        target=split != "test" or raytraced,
        base=base,
        base_files=[base_path(workspace, split, view.name) for view in views] if base in RENDERED else None,
    )


def torch_device(settings: Settings) -> str:
    """The device the setting names; auto is CUDA where torch has it, else the CPU."""
    import torch

    if settings.device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if settings.device.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(f"device {settings.device}: torch sees no CUDA device here; use --set device=cpu")
    return settings.device


def perceptual_weights(console: Console) -> Any:
    """VGG16, AlexNet and LPIPS weights from the cache, or None after saying what that means."""
    from dnrtrain.weights import WeightsMissing, load_weights

    try:
        return load_weights()
    except WeightsMissing:
        console.warn(
            "no VGG16/LPIPS weights on this machine: training drops the perceptual loss and no LPIPS is"
            " measured; fetch them with `dnrpipe weights`"
        )
        return None


def epochs_done(folder: Path, wanted: int, finished: bool) -> tuple[int, int]:
    """(epochs trained, epochs wanted) by the files of a training; all of them where it is ``finished``."""
    if finished and (folder / "model.safetensors").exists():
        return wanted, wanted
    try:
        return min(read(folder / PROGRESS, Progress).epoch, wanted - 1), wanted
    except (OSError, DamagedFile):  # no epoch, or a damaged file: the stage itself reads the weights
        return 0, wanted


def follow(
    events: Iterator[Event],
    stage: Literal["select", "finetune"],
    epochs: int,
    workspace: Workspace,
    console: Console,
    run_id: str,
) -> Iterator[Event]:
    """Pass events through while showing a bar and booking every epoch."""
    with console.bar("step 1" if stage == "select" else "step 2", epochs) as bar:
        for event in events:
            if isinstance(event, EpochEnd):
                _book_epoch(event, stage, workspace, run_id, bar)
                console.events.send(
                    "epoch",
                    stage=stage,
                    epoch=event.epoch,
                    epochs=event.epochs,
                    losses=event.losses,
                    val=event.val,
                    seconds=event.seconds,
                )
                if event.skipped:
                    console.warn(f"epoch {event.epoch}: skipped {event.skipped} non-finite steps")
            elif isinstance(event, Diverged):
                workspace.ledger.append(_epoch_record(event, f"epoch {event.epoch} (diverged)", stage, run_id))
                console.warn(event.text)
            elif isinstance(event, Note):
                console.warn(event.text)
            yield event


def _book_epoch(
    event: EpochEnd, stage: Literal["select", "finetune"], workspace: Workspace, run_id: str, bar: Bar
) -> None:
    workspace.ledger.append(_epoch_record(event, f"epoch {event.epoch}", stage, run_id))
    behind = event.epoch - bar.done - 1  # epochs that an earlier run did
    if behind > 0:
        bar.advance(behind)
    total = event.losses.get("total", sum(event.losses.values()))
    note = f"loss {total:.4f}"
    if "psnr" in event.val:
        note += f", val {event.val['psnr']:.2f} dB"
    bar.advance(note=note)


def _epoch_record(
    event: EpochEnd | Diverged, name: str, stage: Literal["select", "finetune"], run_id: str
) -> CostRecord:
    return CostRecord(
        time=time.time(),
        run=run_id,
        stage=stage,
        purpose="training",
        unit="epoch",
        name=name,
        seconds=event.seconds,
        cpu_seconds=event.cpu_seconds,
        device=event.device,
        steps=event.steps,
    )

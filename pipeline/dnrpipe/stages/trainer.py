"""Stage `finetune` (step 2), and what it shares with step 1: feed workspace files to the trainer, book its epochs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dnrtrain.contract import DamagedFile, View
from dnrtrain.events import Diverged, EpochEnd, Event, Note
from dnrtrain.records import PROGRESS, Progress, read

from ..core.console import Bar, Console
from ..core.errors import UserError
from ..core.scene_files import read_frame
from ..core.settings import Settings
from ..core.workspace import Workspace
from .base_images import RENDERED, base_path
from .stage import Run

if TYPE_CHECKING:
    from dnrtrain.dataset import Base, ViewSet


def load(
    workspace: Workspace,
    views: list[View],
    split: str,
    *,
    raytraced: bool = False,
    raw: bool = False,
    base: Base = "none",
    base_files: Sequence[Path] | None = None,
) -> ViewSet:
    """G-buffers of the views, with rasterised (train, val) or ray-traced targets, or none (test).

    Base images that are rendered bring G-buffers of their own, which are those that novel views have.

    Args:
        raw: ray-traced targets before the denoiser.
        base_files: where those that are rendered lie, instead of ``base/<split>``.
    """
    from dnrtrain.dataset import load_views

    rendered = base_files or [base_path(workspace, split, view.name) for view in views]
    base_files = rendered if base in RENDERED else None
    return load_views(
        base_files or [workspace.passes(split, view.name) for view in views],
        [workspace.raytraced(split, view.name) for view in views] if raytraced else None,
        read_frame(workspace),
        cameras=views,
        folder=workspace.scene,
        target=raytraced or split in ("train", "val"),
        raw=raw,
        base=base,
        base_files=base_files,
    )


def trained_pixels(settings: Settings, width: int, height: int) -> int:
    """Pixels of an optimiser step of step 2 on views of that size: of a patch, where the settings have one."""
    patch = settings.finetune.step2.patch or max(width, height)
    return min(patch, width) * min(patch, height)


def torch_device(settings: Settings) -> str:
    """The device the setting names; auto is CUDA where torch has it, else the CPU."""
    import torch

    if settings.device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if settings.device.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(f"device {settings.device}: torch sees no CUDA device here; use --set device=cpu")
    return settings.device


def perceptual_weights(console: Console | None) -> Any:
    """VGG16, AlexNet and LPIPS weights from the cache, or None, after telling the console what that means."""
    from dnrtrain.weights import WeightsMissing, load_weights

    try:
        return load_weights()
    except WeightsMissing:
        if console is not None:
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


def follow(run: Run, events: Iterator[Event], epochs: int) -> Iterator[Event]:
    """Pass events through while showing a bar and booking every epoch."""
    console = run.console
    with console.bar("step 1" if run.stage == "select" else "step 2", epochs) as bar:
        for event in events:
            if isinstance(event, EpochEnd):
                _book_epoch(run, event, f"epoch {event.epoch}")
                _show_epoch(event, bar)
                facts = {name: getattr(event, name) for name in ("epoch", "epochs", "losses", "val", "seconds")}
                console.events.send("epoch", stage=run.stage, **facts)
                if event.skipped:
                    console.warn(f"epoch {event.epoch}: skipped {event.skipped} non-finite steps")
            elif isinstance(event, Diverged):
                _book_epoch(run, event, f"epoch {event.epoch} (diverged)")
                console.warn(event.text)
            elif isinstance(event, Note):
                console.warn(event.text)
            yield event


def _book_epoch(run: Run, event: EpochEnd | Diverged, name: str) -> None:
    facts = {field: getattr(event, field) for field in ("cpu_seconds", "device", "steps")}
    run.book("training", "epoch", name, event.seconds, **facts)


def _show_epoch(event: EpochEnd, bar: Bar) -> None:
    behind = event.epoch - bar.done - 1  # epochs that an earlier run did
    if behind > 0:
        bar.advance(behind)
    note = f"loss {event.losses.get('total', sum(event.losses.values())):.4f}"
    if "psnr" in event.val:
        note += f", val {event.val['psnr']:.2f} dB"
    bar.advance(note=note)

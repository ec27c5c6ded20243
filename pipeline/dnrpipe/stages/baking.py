"""Procedural textures are baked before a scene is exported: tasks, progress, and what could not be baked."""

from __future__ import annotations

from pathlib import Path

from ..blender.tasks import BakeCommon, BakeTask, PendingBakes
from ..workers.answers import answers, warn_of_retries
from ..workers.view_tasks import worker_count
from .stage import Run

FOLDER = "bakes"
"""Of a workspace: baked values by content hash. They outlive ``--force`` and changes elsewhere in the file."""


def bake(run: Run, source: Path, geometry: Path, pending: PendingBakes) -> list[str]:
    """Bake in worker processes; returns the keys of values that could not be baked.

    Every value appears on disk whole: after Ctrl-C only what is missing is baked again.

    Args:
        geometry: ``geometry.npz`` of the conversion that asked for the bakes.
        pending: what it asked for.
    """
    passes, console = run.settings.passes, run.console
    count = min(worker_count(passes.workers), len(pending.layers))
    folder = run.workspace.root / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    common = BakeCommon(
        source=source,
        frame=pending.frame,
        geometry=geometry,
        folder=folder,
        size=passes.bake_size,
        threads=max(1, worker_count(0) // count),
    )
    refused: list[str] = []
    tasks = [BakeTask(layer=layer, output=folder).data() for layer in pending.layers]
    with console.bar("bakes", len(tasks)) as bar:
        for outcome in answers(
            "dnrpipe.blender.baking.bake",
            common.data(),
            tasks,
            workers=count,
            log=run.log,
            retried=warn_of_retries("bake", console),
        ):
            if outcome.result is None:
                layer = BakeTask.model_validate(outcome.task).layer
                names = ", ".join(f"'{entry.material}'" for entry in layer[:5])
                console.warn(f"could not bake textures of {names}: {outcome.error}; averages stand for them")
                refused += [tap.key for entry in layer for tap in entry.taps]
            else:
                for name, lost in outcome.result["repaired"].items():
                    console.warn(
                        f"repaired: {lost} baked texels of '{name}' were not finite; neighbours stand for them"
                    )
            bar.advance()
    return refused

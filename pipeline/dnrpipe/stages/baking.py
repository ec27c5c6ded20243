"""Bake procedural textures before a scene is exported: tasks, progress, and what could not be baked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..workers.answers import answers, warn_of_retries
from ..workers.view_tasks import worker_count
from .stage import Run

FOLDER = "bakes"
"""Of a workspace: baked values by content hash. They outlive ``--force`` and changes elsewhere in the file."""


def bake(run: Run, source: Path, geometry: Path, pending: dict[str, Any]) -> list[str]:
    """Run the bake tasks in worker processes; returns the keys of values that could not be baked.

    Every task appears on disk whole: after Ctrl-C only what is missing is baked again.

    Args:
        geometry: ``geometry.npz`` of the conversion that asked for the bakes.
        pending: its ``bakes``: layers of tasks, and the scene's frame.
    """
    layers: Sequence[list[dict[str, Any]]] = pending["layers"]
    passes, console = run.settings.passes, run.console
    count = min(worker_count(passes.workers), len(layers))
    folder = run.workspace.root / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    common = {
        "source": str(source),
        "geometry": str(geometry),
        "frame": pending["frame"],
        "folder": str(folder),
        "size": passes.bake_size,
        "threads": max(1, worker_count(0) // count),
    }
    refused: list[str] = []
    tasks = [{"layer": layer, "output": str(folder)} for layer in layers]
    with console.bar("bakes", len(tasks)) as bar:
        for outcome in answers(
            "dnrpipe.blender.baking.bake",
            common,
            tasks,
            workers=count,
            log=run.log,
            retried=warn_of_retries("bake", console),
        ):
            if outcome.result is None:
                names = ", ".join(f"'{entry['material']}'" for entry in outcome.task["layer"][:5])
                console.warn(f"could not bake textures of {names}: {outcome.error}; averages stand for them")
                refused += [tap["key"] for entry in outcome.task["layer"] for tap in entry["taps"]]
            else:
                for name, lost in outcome.result["repaired"].items():
                    console.warn(
                        f"repaired: {lost} baked texels of '{name}' were not finite; neighbours stand for them"
                    )
            bar.advance()
    return refused

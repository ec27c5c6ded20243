"""Bake procedural textures before a scene is exported: tasks, progress, and what could not be baked."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..core.console import Console
from ..core.workspace import Workspace
from ..workers.processes import Retry, run_tasks
from ..workers.view_tasks import worker_count

FOLDER = "bakes"
"""Of a workspace: baked values by content hash. They outlive ``--force`` and changes elsewhere in the file."""


def bake(
    workspace: Workspace,
    console: Console,
    source: Path,
    geometry: Path,
    pending: dict[str, Any],
    size: int,
    workers: int,
) -> list[str]:
    """Run the bake tasks in worker processes; returns the keys of values that could not be baked.

    Every task appears on disk whole: after Ctrl-C only what is missing is baked again.
    """
    layers: Sequence[list[dict[str, Any]]] = pending["layers"]
    count = min(worker_count(workers), len(layers))
    folder = workspace.root / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    common = {
        "source": str(source),
        "geometry": str(geometry),
        "frame": pending["frame"],
        "folder": str(folder),
        "size": size,
        "threads": max(1, worker_count(0) // count),
    }
    refused: list[str] = []
    tasks = [{"layer": layer} for layer in layers]
    with console.bar("bakes", len(tasks)) as bar:
        outcomes = run_tasks("dnrpipe.blender.baking.bake", common, tasks, workers=count, log=workspace.log("prepare"))
        try:
            for outcome in outcomes:
                if isinstance(outcome, Retry):
                    console.warn(f"bake: {outcome.reason}; trying once more")
                elif outcome.errno == errno.ENOSPC:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
                elif outcome.result is None:
                    names = ", ".join(f"'{entry['material']}'" for entry in outcome.task["layer"][:5])
                    console.warn(f"could not bake textures of {names}: {outcome.error}; averages stand for them")
                    refused += [tap["key"] for entry in outcome.task["layer"] for tap in entry["taps"]]
                    bar.advance()
                else:
                    for name, lost in outcome.result["repaired"].items():
                        console.warn(
                            f"repaired: {lost} baked texels of '{name}' were not finite; neighbours stand for them"
                        )
                    bar.advance()
        finally:
            outcomes.close()  # type: ignore[attr-defined]
    return refused

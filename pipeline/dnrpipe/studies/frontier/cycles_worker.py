"""The artist's own renderer as a rival: frames of Cycles, measured against Cycles' own reference.

The two path tracers do not agree to the last decibel (docs/fidelity.md), so each is judged by its own converged
picture: Cycles by a reference with as many samples as ours, raw, with another seed.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.atomic import write_json
from dnrtrain.display import DisplayTransform

from ...core.scene_files import read_frame
from ...core.workspace import Workspace
from ..frames.scene import shown
from .path_tracing_worker import load_lpips, masks_of, quality_of, read_rgba

REFERENCE = "reference"
PREFIX = "Cycles "


class Worker:
    """task: {"workspace", "views": names, "frames": JSON of :mod:`..blender.passes.cycles_frames`, "folder", "output"}.

    Answers and writes to ``output`` {"threads", "rungs"}, each rung as of :mod:`.rivals`, its name beginning with
    ``Cycles``.
    """

    def __init__(self, common: dict[str, Any]) -> None:
        import torch

        if common["threads"]:
            torch.set_num_threads(int(common["threads"]))

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        workspace, folder = Workspace.open(Path(task["workspace"])), Path(task["folder"])
        frames = json.loads(Path(task["frames"]).read_text(encoding="utf-8"))
        display = DisplayTransform(read_frame(workspace), workspace.scene)
        names = list(task["views"])

        def pictures(name: str) -> list[Any]:
            return [shown(display, read_rgba(folder / name / f"{view}.exr")) for view in names]

        truth, masks, lpips = pictures(REFERENCE), masks_of(workspace, names), load_lpips()
        rungs = [
            {
                "name": PREFIX + name,
                "spp": int(name.split()[0]),
                "denoised": not name.endswith("raw"),
                "ms": float(np.median(ms)),
                **quality_of(pictures(name), truth, masks, lpips),
            }
            for name, ms in frames["ms"].items()
        ]
        made = {"threads": frames["threads"], "rungs": rungs}
        write_json(Path(task["output"]), made)
        return made

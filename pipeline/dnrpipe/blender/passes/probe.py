"""``python -m dnrpipe.blender.passes.probe ENGINE``: can this machine draw with EEVEE or Workbench, and how fast?

Prints a `RasterTrial` as one JSON line. It runs in a process of its own: without
EGL Blender aborts the process when it first needs the GPU.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np

from ..tasks import RasterTrial
from .raster import configure_raster, render_to
from .scratch import read_channels

SIZE = 256  # pixels per side
SAMPLES = 4


def probe(engine: str) -> RasterTrial:
    """Render Blender's default cube twice at 256²; the first frame compiles shaders."""
    bpy.ops.wm.read_factory_settings()
    scene = bpy.context.scene
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.resolution_percentage = 100
    configure_raster(scene, engine, SAMPLES)
    seconds: list[float] = []
    alpha = np.zeros(0)
    with tempfile.TemporaryDirectory(prefix="dnrpipe-probe-") as folder:
        for _ in range(2):
            started = time.perf_counter()
            render_to(scene, Path(folder) / "frame.exr")
            alpha = read_channels(Path(folder) / "frame.exr")["A"]
            seconds.append(time.perf_counter() - started)
    # A driver that fails softly leaves the frame empty.
    return {"ok": bool(0 < alpha.mean() < 1), "seconds_first": seconds[0], "seconds_next": seconds[1]}


if __name__ == "__main__":
    print(json.dumps(probe(sys.argv[1])), flush=True)

"""What the corrector makes of scenes that it never saw: base images and their corrections against path tracing.

python -m tools.pretrain.judge FOLDER [SCENE.blend ...] [--weights W.safetensors] [--views 6] [--out rows.json]

FOLDER keeps the scenes' workspaces. Without scenes: the example scenes of the repository.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dnrpipe.core.console import Console
from dnrpipe.core.scene_files import split_views
from dnrpipe.core.settings import resolve
from dnrpipe.core.workspace import Source, Workspace, file_sha256
from dnrpipe.stages.base_images import base_views
from dnrpipe.stages.pipeline import run_stage
from dnrpipe.stages.raytrace import trace_views
from dnrpipe.stages.stage import Run
from dnrpipe.stages.trainer import load
from dnrpipe.studies.cells.measure import base_pictures
from dnrtrain.metrics import psnr
from dnrtrain.model import DNR, render_views
from dnrtrain.shipped import WEIGHTS, corrector

SCENES = Path(__file__).resolve().parents[2] / "blender_scenes"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    model = corrector(options.weights)
    rows = [
        judged(path, options.folder / f"{path.stem}.dnr", model, options.views)
        for path in options.scenes or sorted(SCENES.glob("*.blend"))
    ]
    base, ours = (float(np.mean([np.mean(row[name]) for row in rows])) for name in ("base", "corrected"))
    print(f"mean of {len(rows)}: {base:.2f} -> {ours:.2f} dB")
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


def judged(scene: Path, root: Path, model: DNR, views: int) -> dict[str, Any]:
    """PSNR over white of each test view: base image, correction."""
    workspace = Workspace.create(root, Source(path=str(scene.resolve()), sha256=file_sha256(scene)))
    cameras = {"train": 1, "val": 0, "test": views}
    settings = resolve("draft", {"cameras": cameras, "raytrace": {"evaluation_spp": 256}}, environment={})
    run = Run(workspace, settings, Console(quiet=True))
    run_stage("prepare", run)
    own = run.for_stage("evaluate")
    tests = split_views(workspace)["test"]
    started = time.monotonic()
    base_views(own, tests, "test")
    base_seconds = time.monotonic() - started
    trace_views(own, tests, "test")
    data = load(workspace, tests, "test", raytraced=True, base=settings.model.base)
    target = data.tensors.target
    assert target is not None
    with torch.inference_mode():
        pictures = {"base": base_pictures(data), "corrected": render_views(model, data)}
    found = {
        name: [round(float(psnr(p[None], t[None])), 3) for p, t in zip(shown, target, strict=True)]
        for name, shown in pictures.items()
    }
    means = [float(np.mean(values)) for values in found.values()]
    print(f"{scene.stem}: {means[0]:.2f} -> {means[1]:.2f} dB (light and base images {base_seconds:.0f} s)", flush=True)
    return {"scene": scene.stem, **found, "seconds": base_seconds}


if __name__ == "__main__":
    main()

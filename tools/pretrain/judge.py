"""What the corrector makes of scenes that it never saw: base images, their corrections, and these as far as they are
trusted (`dnrpipe.stages.trust`), against path tracing.

python -m tools.pretrain.judge FOLDER [SCENE.blend ...] [--weights W.safetensors ...] [--views 6] [--out rows.json]

FOLDER keeps the scenes' workspaces. Without scenes: the example scenes of the repository.
"""

from __future__ import annotations

import argparse
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
from dnrpipe.stages.trust import measure_trust
from dnrpipe.studies.cells.measure import base_pictures
from dnrtrain.atomic import write_json
from dnrtrain.metrics import psnr
from dnrtrain.model import render_views
from dnrtrain.shipped import WEIGHTS, corrector

SCENES = Path(__file__).resolve().parents[2] / "blender_scenes"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--weights", type=Path, nargs="+", default=[WEIGHTS])
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for path in options.scenes or sorted(SCENES.glob("*.blend")):
        rows += judged(path, options.folder / f"{path.stem}.dnr", options.weights, options.views)
        if options.out:
            write_json(options.out, rows)
    for weights in options.weights:
        own = [row for row in rows if row["weights"] == str(weights)]
        means = [float(np.mean([np.mean(row[name]) for row in own])) for name in ("base", "corrected", "trusted")]
        print(f"{weights}: mean of {len(own)}: " + " -> ".join(f"{mean:.2f}" for mean in means) + " dB")


def judged(scene: Path, root: Path, weights: list[Path], views: int) -> list[dict[str, Any]]:
    """PSNR over white of each test view, for each of the weights: base image, correction, trusted correction."""
    workspace = Workspace.create(root, Source(path=str(scene.resolve()), sha256=file_sha256(scene)))
    changes = {
        "cameras": {"train": 40, "val": 0, "test": views},
        "raytrace": {"evaluation_spp": 256},
        "select": {"budget": 0},
    }
    run = Run(workspace, resolve("draft", changes, environment={}), Console(quiet=True))
    run_stage("prepare", run)
    own = run.for_stage("evaluate")
    tests = split_views(workspace)["test"]
    started = time.monotonic()
    base_views(own, tests, "test")
    base_seconds = time.monotonic() - started
    trace_views(own, tests, "test")
    data = load(workspace, tests, "test", raytraced=True, base="baked")
    target = data.tensors.target
    assert target is not None
    rows = []
    for path in weights:
        model = corrector(path)
        with torch.inference_mode():
            pictures = {"base": base_pictures(data), "corrected": render_views(model, data)}
        trust = measure_trust(run.for_stage("finetune"), model)
        pictures["trusted"] = render_views(model, data)
        found = {
            name: [round(float(psnr(p[None], t[None])), 3) for p, t in zip(shown, target, strict=True)]
            for name, shown in pictures.items()
        }
        told = " -> ".join(f"{np.mean(values):.2f}" for values in found.values())
        print(f"{scene.stem}: {told} dB ({trust.share:.0%}; light and base images {base_seconds:.0f} s)", flush=True)
        rows.append({"scene": scene.stem, "weights": str(path), **found, "share": trust.share, "seconds": base_seconds})
    return rows


if __name__ == "__main__":
    main()

"""Both training steps on a scene on disk, as a process of its own that a test can kill.

``python run_steps.py SCENE OUT POLICY`` prints the selection as JSON. SCENE was made by synthetic.write_scene.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import synthetic
import torch

from dnrtrain.dataset import ViewSet, load_views
from dnrtrain.events import Selected
from dnrtrain.settings import LossWeights, ModelSettings, Step1Settings, Step2Settings
from dnrtrain.step1 import run_step1
from dnrtrain.step2 import run_step2

VIEWS, SIDE, BUDGET = 8, 24, 3
MODEL = ModelSettings(texture_size=16, width=8, depth=2, aggregator="residual")
STEP1 = Step1Settings(epochs=6, precision="bfloat16", embedding=16)
STEP2 = Step2Settings(epochs=12, batch=2, loss=LossWeights(perceptual=0))


def load(folder: Path, *, traced: bool) -> ViewSet:
    views = synthetic.dome(VIEWS, SIDE)
    passes = [folder / "passes" / f"{view.name}.exr" for view in views]
    images = [folder / "raytraced" / f"{view.name}.exr" for view in views] if traced else None
    return load_views(passes, images, synthetic.FRAME, cameras=views, folder=folder)


def run(scene: Path, out: Path, policy: str) -> list[str]:
    raster, traced = load(scene, traced=False), load(scene, traced=True)
    selected: list[str] = []
    for event in run_step1(
        raster, traced.subset([0]), MODEL, STEP1,
        policy=policy, budget=BUDGET, seed=5, device="cpu", checkpoints=out / "step1", fingerprint="a",
    ):  # fmt: skip
        if isinstance(event, Selected):
            selected = event.selection.views
    chosen = traced.subset([traced.index(name) for name in selected])
    for _ in run_step2(
        chosen, None, out / "step1", MODEL, STEP2,
        seed=5, device="cpu", checkpoints=out / "step2", fingerprint="a", weights=None,
    ):  # fmt: skip
        pass
    return selected


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(run(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])))

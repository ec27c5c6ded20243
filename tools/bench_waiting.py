"""Training steps by how long torch's threads spin before they sleep: idle, and beside other processes.

    python -m tools.bench_waiting scene.dnr [--spins 0 1000 300000] [--others 4]

scene.dnr: a workspace with ray-traced training views and base images. Each figure is a process of its own.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

VIEWS, EPOCHS, WARM = 6, 9, 2


def step_ms(root: Path) -> tuple[float, float]:
    """(wall, processor) milliseconds of an optimiser step of the workspace's step 2, first epochs left out."""
    from dnrpipe.core.scene_files import split_views
    from dnrpipe.core.workspace import Workspace
    from dnrpipe.stages.session import resolve_settings
    from dnrpipe.stages.trainer import perceptual_weights
    from dnrpipe.studies.cells.cell import load_cell_views
    from dnrtrain.checkpoint import finished_record, step_seconds
    from dnrtrain.step2 import run_step2

    workspace = Workspace.open(root)
    settings = resolve_settings(workspace, {}, None)
    pictures = next((f for f in sorted((root / "raytraced").glob("train*")) if any(f.glob("*.exr"))), None)
    names = tuple(
        view.name
        for view in split_views(workspace)["train"]
        if pictures and (pictures / f"{view.name}.exr").exists() and (root / "base/train" / f"{view.name}.exr").exists()
    )[:VIEWS]
    if not names or pictures is None:
        raise SystemExit(f"{root}: has no ray-traced training views with base images; run `dnrpipe run` first")
    data = load_cell_views(root, "train", names, raytraced=True, base=settings.model.base, targets=pictures.name)
    step2 = settings.finetune.step2.model_copy(update={"epochs": EPOCHS, "start": "fresh", "validation_views": 0})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for _ in run_step2(
            data,
            None,
            folder,
            settings.model,
            step2,
            seed=0,
            device="cpu",
            checkpoints=folder,
            fingerprint="bench",
            weights=perceptual_weights(None),
        ):
            pass
        wall, processor = step_seconds(finished_record(folder), WARM)
    return 1000 * wall, 1000 * processor


def main() -> int:
    """A line per number of spins and of other processes."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench_waiting", description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--spins", nargs="+", default=["0", "1000", "300000"])
    parser.add_argument("--others", type=int, default=4, help="processes that do nothing but count")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print("{:.1f} ms, {:.1f} ms of processor time".format(*step_ms(options.workspace)))
        return 0
    clean = {key: value for key, value in os.environ.items() if key not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    command = [sys.executable, "-m", "tools.bench_waiting", str(options.workspace), "--one"]
    for others in (0, options.others):
        busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(others)]
        try:
            for spins in options.spins:
                done = subprocess.run(
                    command, env=clean | {"GOMP_SPINCOUNT": spins}, capture_output=True, text=True, check=True
                )
                print(f"{others} other processes, {spins} spins: {done.stdout.strip()}", flush=True)
        finally:
            for process in busy:
                process.kill()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

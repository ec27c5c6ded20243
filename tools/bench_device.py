"""Milliseconds of a frame, and of a training step at the paper's schedule, on this machine's device (a GPU, if any).

python -m tools.bench_device frames WORKSPACE.dnr [--sizes 256x256,800x800,1280x720] --out RESULTS.json
python -m tools.bench_device training WORKSPACE.dnr [--sides 128,256,800] --out RESULTS.json

frames: of the workspace's first test view, with baked light and the shipped corrector; beside it path tracing. The
workspace was prepared, and its light baked (`dnrpipe run --budget 0`). Medians of wall milliseconds.
training: steps 1 and 2 as the preset `paper-128` has them (`paper` from 400 pixels on), float32 and, where the device
has it, bfloat16, on eight ray-traced views of the workspace, enlarged: what they show does not change the seconds.
Both add to what the file holds. Nothing else should run.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import statistics
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from dnrpipe.core.errors import UserError
from dnrpipe.core.settings import resolve
from dnrpipe.core.workspace import Workspace
from dnrpipe.stages.trainer import torch_device
from dnrpipe.studies.cells.results import made_by, table
from dnrtrain.atomic import write_json

VIEWS = 8
LARGE = 400
"""From this side on the network has the size of the preset `paper`."""
REPEATS = 10
SAMPLES = 4
REFERENCE = 128


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("frames", "training"))
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--sizes", default="256x256,800x800,1280x720")
    parser.add_argument("--sides", default="128,256,800")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    old = json.loads(given.out.read_text()) if given.out.exists() else {}
    if given.what == "frames":
        rows = frames(given.workspace, [tuple(int(n) for n in size.split("x")) for size in given.sizes.split(",")])
    else:
        rows = []
        for side in given.sides.split(","):
            rows += training(given.workspace, int(side))
            print(json.dumps(rows[-2:]), flush=True)
    command = shlex.join(["python", "-m", "tools.bench_device", *sys.argv[1:]])
    write_json(given.out, old | {given.what: {**made_by(), "command": command, "device": device_name(), "rows": rows}})


def device_name() -> str:
    """The GPU's, or "cpu"."""
    import torch

    return torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"


def markdown(results: dict[str, Any]) -> str:
    """Its tables: columns are what was measured."""
    parts = []
    for name, made in results.items():
        rows = [[str(value) for value in row.values()] for row in made["rows"]]
        when = f"{made['date'][:10]}; {made['device']}, torch {made['versions']['torch']}"
        head = f"{name.capitalize()}: `{made['command']}`, {when}."
        parts.append(f"{head}\n\n{table(list(made['rows'][0]), rows)}")
    return "\n\n".join(parts)


# -- frames ------------------------------------------------------------------------------------------------------


def frames(root: Path, sizes: list[tuple[int, ...]]) -> list[dict[str, Any]]:
    """A row a size. The first of the repeats, which compiles, does not count."""
    from dnrpipe.core.scene_files import split_views
    from dnrpipe.raytrace.frames import Frames
    from dnrpipe.stages.shots.open_shot import resized
    from dnrpipe.studies.frames.ours import NEURAL, Ours
    from dnrpipe.studies.frames.scene import Clock, open_scene
    from dnrtrain.precision import decide_bfloat16
    from dnrtrain.shipped import corrector

    view = split_views(Workspace.open(root))["test"][0]
    cores = os.cpu_count() or 1
    scene, clock, device = (
        open_scene(root, [view], cores),
        Clock("wall", cores),
        torch_device(resolve("draft", {}, environment={})),
    )
    rays = scene.settings.base.samples
    ours = Ours(scene, (rays,), smoothed=False)
    ours.model = corrector().to(device)
    ours.model.use_bfloat16 = decide_bfloat16("auto", device)
    rows = []
    for width, height in sizes:
        seen = resized(view, width, height)
        pictures = scene.frames = Frames(scene.engine, scene.bundle, scene.integrator, scene.max_depth, (width, height))
        taken = [ours.frame(seen, clock)[f"{NEURAL}, {rays} rays"]["parts"] for _ in range(1 + REPEATS)][1:]
        row: dict[str, Any] = {"rays": rays, "size": f"{width}x{height}", "variant": scene.engine.variant}
        row |= {name: round(statistics.median(parts[name] for parts in taken), 2) for name in taken[0]}
        for samples, repeats in ((SAMPLES, REPEATS), (REFERENCE, 2)):
            spent = [clock.time(partial(pictures.path, seen, samples, 1))[1] for _ in range(1 + repeats)][1:]
            row[f"path tracing, {samples} samples"] = round(statistics.median(spent), 2)
        rows.append(row)
        print(json.dumps(row), flush=True)
    return rows


# -- training ----------------------------------------------------------------------------------------------------


def training(root: Path, side: int) -> list[dict[str, Any]]:
    """A row for each precision that the device has."""
    import torch

    from dnrpipe.core.scene_files import split_views
    from dnrpipe.studies.cells.cell import load_cell_views
    from dnrtrain.perceptual import random_weights
    from dnrtrain.precision import decide_bfloat16
    from dnrtrain.step1 import run_step1
    from dnrtrain.step2 import run_step2

    preset = "paper" if side >= LARGE else "paper-128"
    settings = resolve(preset, {}, environment={})
    device = torch_device(settings)
    workspace = Workspace.open(root)
    candidates = [view.name for view in split_views(workspace)["train"]]
    names = tuple(name for name in candidates if workspace.raytraced("train", name).exists())[:VIEWS]
    if len(names) < 2:
        raise UserError(f"{root}: has fewer than two ray-traced views; run `dnrpipe raytrace-selected` first")
    drawn, traced = (
        enlarged(load_cell_views(root, "train", names, raytraced=raytraced, base="none"), side)
        for raytraced in (False, True)
    )
    rows = []
    for precision in ("float32", "bfloat16") if decide_bfloat16("auto", device) else ("float32",):
        step1 = settings.select.step1.model_copy(update={"epochs": 4, "precision": precision})
        step2 = settings.finetune.step2.model_copy(update={"epochs": 4, "precision": precision})
        row: dict[str, Any] = {"side": side, "preset": preset, "precision": precision}
        common: dict[str, Any] = {"seed": 0, "device": device, "fingerprint": "bench"}
        if device == "cuda":
            torch.cuda.reset_peak_memory_stats()
        with tempfile.TemporaryDirectory() as folder:
            first, second = Path(folder) / "step1", Path(folder) / "step2"
            events = run_step1(
                drawn, None, settings.model, step1, policy="rl-paper", budget=len(names), checkpoints=first, **common
            )
            row["step 1"] = step_ms(events)
            common |= {"checkpoints": second, "weights": {"vgg": random_weights("vgg")}}
            events = run_step2(traced, None, first, settings.model, step2, **common)
            row["step 2"] = step_ms(events)
        if device == "cuda":
            row["peak_gib"] = round(torch.cuda.max_memory_allocated() / 2**30, 2)
        rows.append(row)
    return rows


def enlarged(views: Any, side: int) -> Any:
    """The views with all maps at ``side`` pixels."""
    from dataclasses import replace

    from torch.nn.functional import interpolate

    return replace(views, tensors=views.tensors._map(lambda maps: interpolate(maps, size=(side, side))))


def step_ms(events: Any) -> float:
    """Milliseconds of a step: of the fastest epoch, without what is loaded in the first."""
    from dnrtrain.events import EpochEnd

    ended = [event for event in events if isinstance(event, EpochEnd)]
    return round(1000 * min(event.seconds / event.steps for event in ended[1:]), 2)


if __name__ == "__main__":
    main()

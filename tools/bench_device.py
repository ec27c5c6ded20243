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
import math
import os
import shlex
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from dnrpipe.core.errors import UserError
from dnrpipe.core.settings import resolve
from dnrpipe.core.workspace import Workspace
from dnrpipe.studies.cells.results import made_by
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
    lines: list[str] = []
    for made in results.values():
        columns = list(made["rows"][0])
        lines += [f"`{made['command']}`, {made['date'][:10]}; {made['device']}, torch {made['versions']['torch']}.", ""]
        lines += [f"| {' | '.join(columns)} |", "|" + " --- |" * len(columns)]
        lines += [f"| {' | '.join(str(row[column]) for column in columns)} |" for row in made["rows"]]
        lines += [""]
    return "\n".join(lines[:-1])


# -- frames ------------------------------------------------------------------------------------------------------


def frames(root: Path, sizes: list[tuple[int, ...]]) -> list[dict[str, Any]]:
    """A row a size."""
    import torch

    from dnrpipe.core.scene_files import split_views
    from dnrpipe.raytrace.base_renderer import CHAIN, BaseRenderer
    from dnrpipe.raytrace.base_worker import denoised, without_grain
    from dnrpipe.raytrace.frames import Frames
    from dnrpipe.raytrace.light_worker import read_light
    from dnrpipe.raytrace.sensors import scaled_view
    from dnrpipe.stages.base_images import light_path
    from dnrpipe.stages.shots.open_shot import resized
    from dnrpipe.studies.frames.scene import open_scene
    from dnrtrain.dataset import load_views
    from dnrtrain.exr import write_exr
    from dnrtrain.model import render_views
    from dnrtrain.shipped import corrector

    workspace = Workspace.open(root)
    view = split_views(workspace)["test"][0]
    scene = open_scene(root, [view], os.cpu_count() or 1)
    scale = scene.engine.unit_scale
    loaded = scene.engine.scenes[str(scene.bundle)]
    gloss = not scene.settings.base.denoise
    renderer = BaseRenderer(scene.engine.mi, loaded, read_light(light_path(workspace)), gloss=gloss)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    network = corrector().to(device)
    network.use_bfloat16 = network.use_bfloat16 or device == "cuda"
    rows = []
    for width, height in sizes:
        seen = resized(view, width, height)
        pictures = Frames(scene.engine, scene.bundle, scene.integrator, scene.max_depth, (width, height))
        row: dict[str, Any] = {"size": f"{width}x{height}", "variant": scene.engine.variant}
        rays = scene.settings.base.samples
        channels, row["base image and G-buffer"] = timed(partial(renderer.frame, scaled_view(seen, scale), rays, 0))
        mask = channels["mask"] > 0.5
        coverage, row["silhouettes"] = timed(partial(pictures.coverage, seen, mask))
        channels |= {name: channels[name] / scale for name in ("depth.Z", *CHAIN)} | {"coverage": coverage}
        _, row["denoiser"] = timed(partial(denoised, channels, diffuse=renderer.passes_light))
        clean = without_grain(channels, renderer)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "view.exr"
            write_exr(file, clean, {})
            data = load_views(
                [file], None, scene.frame, cameras=[seen], folder=workspace.scene, target=False, base="baked",
                base_files=[file],
            ).to(device)  # fmt: skip
        _, row["network"] = timed(partial(render_views, network, data))
        _, row[f"path tracing, {SAMPLES} samples"] = timed(partial(pictures.path, seen, SAMPLES, 1))
        _, row[f"path tracing, {REFERENCE} samples"] = timed(partial(pictures.path, seen, REFERENCE, 1), repeats=2)
        rows.append({"rays": rays, **row})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def timed(function: Callable[[], Any], repeats: int = REPEATS) -> tuple[Any, float]:
    """(result, median wall milliseconds). The first call, which compiles, does not count."""
    result, seconds = function(), []
    for _ in range(repeats):
        started = time.perf_counter()
        result = function()  # ends in memory of the CPU, so it waits for the device
        seconds.append(time.perf_counter() - started)
    return result, round(1000 * statistics.median(seconds), 2)


# -- training ----------------------------------------------------------------------------------------------------


def training(root: Path, side: int) -> list[dict[str, Any]]:
    """A row for each precision that the device has."""
    import torch

    from dnrpipe.core.scene_files import split_views
    from dnrpipe.studies.cells.cell import load_cell_views
    from dnrtrain.precision import decide_bfloat16
    from dnrtrain.step1 import run_step1
    from dnrtrain.step2 import run_step2

    device = "cuda" if torch.cuda.is_available() else "cpu"
    preset = "paper" if side >= LARGE else "paper-128"
    settings = resolve(preset, {}, environment={})
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
            events = run_step2(
                traced, None, first, settings.model, step2, checkpoints=second, weights=random_weights(), **common
            )
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


def random_weights() -> dict[str, Any]:
    """Of the perceptual network: what they are does not change the seconds, and they may not be at hand."""
    import torch

    from dnrtrain.perceptual import weight_shapes

    generator = torch.Generator().manual_seed(0)
    shapes = weight_shapes("vgg")
    return {
        "vgg": {
            name: torch.randn(shape, generator=generator) * (2.0 / max(1, math.prod(shape[1:]))) ** 0.5
            for name, shape in shapes.items()
        }
    }


if __name__ == "__main__":
    main()

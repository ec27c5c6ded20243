"""One training scene: built from its seed, converted, lit, and looked at. A process of its own, on one core.

python -m tools.pretrain.scene SEED FOLDER

FOLDER/
  maps.npy    float16 [views, channels, side, side], radiance in units of display white (times 2^exposure)
  scene.json  `pretraining_data.Scene`: what the channels are, the views, the display transform, what it took
  *.npz       the display transform's table, where the scene has one
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.core.cameras import spread
from dnrpipe.core.console import Console
from dnrpipe.core.scene_files import read_frame, read_summary
from dnrpipe.core.settings import resolve
from dnrpipe.core.workspace import Source, Workspace, file_sha256
from dnrpipe.effects.plan import EffectPlan
from dnrpipe.effects.store import plan_of
from dnrpipe.raytrace.variants import choose_variant
from dnrpipe.stages.prepare import scene_and_views
from dnrpipe.stages.stage import Run
from dnrtrain.atomic import write_json
from dnrtrain.contract import View
from dnrtrain.pretraining_data import BRIGHT, RAY_COUNTS, Scene, channel_names

FACTORY = Path(__file__).resolve().parents[2] / "blender_scenes" / "factory" / "build.py"
LEFT_OUT = ("remix",)
"""Families that are made of the example scenes: what is measured on those must come from weights that saw none."""
DEPTH = 24
"""Of the references; base images follow 16 vertices."""
SIZES = ((96, 6), (128, 4), (192, 2), (288, 1))
"""(pixels a side, views), one of them drawn for a scene."""
LIGHT_MAPS = ((256, 24), (384, 16))
"""(texels a side, paths per texel), one of them drawn for a scene."""
REFERENCE_SPP = 128
"""Not denoised: noise of the references averages out over steps, a denoiser's softness would be learned."""
MOST_FRAMES, RESTING = 16, 0.2
"""Earlier frames of a base image that remembers, at most; in this share of the views the camera rests."""
MOST = 60000.0
"""Largest radiance that is kept: half floats end at 65504."""
Took = Callable[[str], None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seed", type=int)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    options.folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="pretrain-") as scratch:
        make(options.seed, options.folder, Path(scratch))


def make(seed: int, folder: Path, scratch: Path) -> None:
    """Write ``folder``, whole or not at all."""
    timings: dict[str, float] = {}
    clock = time.monotonic()

    def took(name: str) -> None:
        nonlocal clock
        timings[name], clock = round(time.monotonic() - clock, 2), time.monotonic()

    blend = scratch / f"{seed}.blend"
    command = [sys.executable, FACTORY, blend, "--seed", str(seed), "--without", *LEFT_OUT]
    built = subprocess.run(command, check=True, capture_output=True)
    family = next(word for word in reversed(built.stdout.decode().split("\n")) if word and not word.startswith("Info"))
    took("build")
    workspace = Workspace.create(scratch / "scene.dnr", Source(path=str(blend), sha256=file_sha256(blend)))
    random = np.random.default_rng([seed, 7])
    draw = lambda: int(random.choice(RAY_COUNTS))  # noqa: E731
    inputs = [f"{draw()}", f"{RAY_COUNTS[-1]} denoised", f"{draw()} remembered"]
    if (fewer := draw()) != RAY_COUNTS[-1]:  # which is what workspaces have
        inputs.append(f"{fewer} denoised")
    side, views = SIZES[int(random.integers(len(SIZES)))]
    cameras = {"source": "animation", "train": views, "val": 0, "test": 0, "width": side, "height": side}
    changes = {"cameras": cameras, "passes": {"workers": 1}, "raytrace": {"max_depth": DEPTH}}
    settings = resolve("draft", changes, environment={})
    _, by_split = scene_and_views(Run(workspace, settings, Console(quiet=True)))
    path = by_split["train"]  # all frames of the animation
    chosen = spread(path, views)
    took("convert")
    ways = [way(path, path.index(view), random) for view in chosen]
    maps, noise = _look(workspace, plan_of(workspace, settings), ways, inputs, seed, took)
    frame = read_frame(workspace)
    bright = [name.partition("@")[0] in BRIGHT for name in channel_names(inputs)]
    maps[:, bright] *= 2.0**frame.exposure
    temporary = folder.with_name(f".{folder.name}")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    np.save(temporary / "maps.npy", np.clip(maps, -MOST, MOST).astype(np.float16))
    if frame.display_lut is not None:
        shutil.copy(workspace.scene / frame.display_lut, temporary)
    scene = Scene(
        seed=seed,
        family=family.strip(),
        views=chosen,
        inputs=inputs,
        frame=frame.model_copy(update={"exposure": 0.0}),
        triangles=read_summary(workspace.scene).triangles,
        noise=noise,
        seconds=timings,
    )
    write_json(temporary / "scene.json", scene.model_dump(mode="json"))
    temporary.rename(folder)


def way(path: list[View], last: int, random: np.random.Generator) -> list[View]:
    """Frames of a camera that comes to the view ``last`` of a path, or rests there: that view is the last of them."""
    view, before = path[last], path[last - 1 if last else 1]
    count = int(random.integers(1, MOST_FRAMES + 1))
    step = 0.0 if random.random() < RESTING else random.uniform(0.1, 1.0) / count
    return [*(between(view, before, step * number) for number in range(count, 0, -1)), view]


def between(view: View, other: View, share: float) -> View:
    """A camera on the way from ``view`` to ``other``."""
    matrix = (1 - share) * view.matrix + share * other.matrix
    left, _, right = np.linalg.svd(matrix[:3, :3])
    matrix[:3, :3] = left @ right
    return view.model_copy(update={"c2w": tuple(map(tuple, matrix.tolist()))}) if share else view


def _look(
    workspace: Workspace,
    plan: EffectPlan,
    ways: list[list[View]],
    inputs: list[str],
    seed: int,
    took: Took,
) -> tuple[np.ndarray, float]:
    """(float32 [views, channels, side, side], relative RMSE of the references), by this process, on one core.

    ways: of the cameras; their last frames are the views. inputs: as in `Scene`.
    """
    choice = choose_variant("auto")
    os.environ.update(choice.environment)
    from dnrpipe.raytrace.base_renderer import BaseRenderer
    from dnrpipe.raytrace.base_worker import without_grain
    from dnrpipe.raytrace.engine import Engine
    from dnrpipe.raytrace.frames import Frames
    from dnrpipe.raytrace.history import History
    from dnrpipe.raytrace.light_worker import indirect_integrator
    from dnrpipe.raytrace.lightmap import LightBaker
    from dnrpipe.raytrace.noise import half_noise
    from dnrpipe.raytrace.pictures import finished, repair
    from dnrpipe.raytrace.texels import grouped_meshes

    bundle = workspace.scene / "scene.xml"
    engine = Engine(choice.variant, 1, [bundle])
    scene = engine.scenes[str(bundle)]
    took("load")
    indirect = indirect_integrator(engine.mi, scene, plan.integrator, DEPTH)
    size, spp = LIGHT_MAPS[seed % len(LIGHT_MAPS)]
    light = LightBaker(engine.mi, scene, indirect, grouped_meshes(bundle)).bake(size, spp, seed)
    took("light")
    views = [way[-1] for way in ways]
    silhouettes = Frames(engine, bundle, "path", 2, (views[0].width, views[0].height))
    grainy, smooth = (
        BaseRenderer(engine.mi, scene, light, gloss=gloss, unit_scale=engine.unit_scale) for gloss in (True, False)
    )
    history = History(engine.mi)

    def base(way: list[View], chosen: str) -> dict[str, np.ndarray]:
        """The base image called so of the way's last view, with its G-buffer."""
        samples, _, kind = chosen.partition(" ")
        renderer, tiles, view = smooth if kind else grainy, not kind, way[-1]
        if kind == "remembered":
            history.begin()
            for frame in way[:-1]:
                history.take(frame, renderer.frame(frame, int(samples), history.number, tiles=tiles))
            channels = history.take(view, renderer.frame(view, int(samples), history.number, tiles=tiles))
        else:
            channels = renderer.frame(view, int(samples), tiles=tiles)
        channels["coverage"] = silhouettes.coverage(view, channels["mask"] > 0.5, alpha=channels["base.A"])
        return without_grain(channels, renderer) if kind else channels

    bases = {chosen: [base(way, chosen) for way in ways] for chosen in inputs}
    took("base images")
    integrator, _ = engine.integrator(bundle, plan.integrator, DEPTH)
    pictures, noises = [], []
    for number, view in enumerate(views):
        sensor = engine.sensor(view)

        def traced(launch: int, sensor: Any = sensor, view: View = view, number: int = number) -> np.ndarray:
            random = 1000 * seed + 32 * number + launch
            return engine.frame(bundle, integrator, sensor, view, REFERENCE_SPP // 2, random)[0]

        halves = [traced(0), traced(1)]
        repair(halves, lambda attempt, half: traced(2 + 2 * attempt + half))
        image = (halves[0] + halves[1]) / 2
        raw = half_noise(*halves)
        target, figures = finished(engine, bundle, view, image, (halves[0], halves[1]), raw, smooth=False)
        noises.append(figures["noise"] or 0.0)
        channels = bases[inputs[0]][number] | {f"target.{c}": target[c] for c in "RGBA"}
        for chosen, found in bases.items():
            channels |= {f"{channel}@{chosen}": values for channel, values in found[number].items()}
        pictures.append(np.stack([channels[name] for name in channel_names(inputs)]).astype(np.float32))
    took("references")
    return np.stack(pictures), float(np.mean(noises))


if __name__ == "__main__":
    main()

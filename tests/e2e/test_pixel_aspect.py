"""Pixels that are not square: Blender's G-buffer, base image and path tracing see the same, and a stretched picture."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dnrpipe.raytrace.variants import choose_variant
from dnrtrain.contract import View, read_cameras
from dnrtrain.exr import read_exr

pytestmark = [pytest.mark.slow, pytest.mark.e2e]

BLENDER = """
import json, sys
from dnrpipe.blender.passes.worker import Worker
common = {"scene_dir": sys.argv[1], "raster_engine": "workbench", "raster_samples": 1, "coverage_samples": 64}
Worker(common)({"view": json.loads(sys.argv[2]), "output": sys.argv[3], "raster": False, "fingerprint": "f"})
"""
MITSUBA = """
import json, sys
import numpy as np
from pathlib import Path
from dnrpipe.raytrace.base_worker import Worker
from dnrpipe.raytrace.frames import Frames
from dnrtrain.contract import View
variant, workspace, out = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
bundle = workspace / "scene" / "scene.xml"
common = {"bundle": str(bundle), "variant": variant, "kind": "baked", "samples": 16, "denoise": False}
worker = Worker({**common, "light": str(workspace / "base" / "light.npz")})
engine = worker.engine
integrator, _ = engine.integrator(bundle, "path", 4)
for name, data in json.loads(sys.argv[4]).items():
    view = View.model_validate(data)
    frames = Frames(engine, bundle, "path", 4, (view.width, view.height))
    kept = {f"kept.{k}": v for k, v in frames.gbuffer(view).items()}
    lens = {"aperture_radius": 1e-6, "focus_distance": 1.0}
    traced = [engine.frame(bundle, integrator, engine.sensor(view, given), view, 64, 1)[0] for given in (None, lens)]
    np.savez(out / f"{name}.npz", traced=traced[0], lens=traced[1], path=frames.path(view, 64, 2), **kept,
             **worker.channels(view))
"""


@pytest.fixture(scope="module")
def pictures(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, np.ndarray]]:
    """The same picture with square pixels, 64x64, and with flat ones, 64x80; G-buffer by Blender of the latter."""
    folder, choice = tmp_path_factory.mktemp("aspect"), choose_variant()
    if choice.variant.startswith("scalar"):
        pytest.skip("base images need a jit variant of Mitsuba")
    square = read_cameras(tiny / "cameras" / "train.json")[0].model_copy(update={"cx": 29.0, "cy": 36.0})
    flat = square.model_copy(update={"height": 80, "fl_y": 1.25 * square.fl_y, "cy": 1.25 * square.cy})
    views: dict[str, View] = {"square": square, "flat": flat}
    data = {name: view.model_dump(mode="json") for name, view in views.items()}
    commands = [
        [BLENDER, str(tiny / "scene"), json.dumps(data["flat"]), str(folder / "flat.exr")],
        [MITSUBA, choice.variant, str(tiny), str(folder), json.dumps(data)],
    ]
    for code, *arguments in commands:
        command = [sys.executable, "-c", code, *arguments]
        environment = {**os.environ, **choice.environment}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    found = {name: dict(np.load(folder / f"{name}.npz")) for name in views}
    return {**found, "blender": read_exr(folder / "flat.exr")[0]}


def test_blender_and_mitsuba_see_the_same(pictures: dict[str, dict[str, np.ndarray]]) -> None:
    flat, blender = pictures["flat"], pictures["blender"]
    mask = blender["mask"] > 0.5
    assert mask.shape == (80, 64) and 0.1 < mask.mean() < 0.9
    for kind in ("", "kept."):
        both = mask & (flat[f"{kind}mask"] > 0.5)
        assert both.sum() / (mask | (flat[f"{kind}mask"] > 0.5)).sum() > 0.995
        off = np.abs(flat[f"{kind}depth.Z"] / np.where(both, blender["depth.Z"], 1) - 1)[both]
        assert np.quantile(off, 0.99) < 1e-4
        assert np.abs(flat[f"{kind}coverage"] - blender["coverage"]).mean() < 0.01
    for picture in ("traced", "lens", "path"):
        assert np.abs(flat[picture][..., 3] - blender["coverage"]).mean() < 0.01


@pytest.mark.parametrize("picture", ["base", "traced", "lens", "path"])
def test_it_is_the_picture_of_square_pixels_stretched(pictures: dict[str, dict[str, np.ndarray]], picture: str) -> None:
    """Means of 4 rows of square pixels and of 5 flat ones; against another aspect they are far off."""

    def blocks(name: str, rows: int) -> np.ndarray:
        found = pictures[name]
        image = np.stack([found[f"base.{c}"] for c in "RGBA"], axis=-1) if picture == "base" else found[picture]
        return image[: len(image) // rows * rows].reshape(-1, rows, 16, 4, 4).mean(axis=(1, 3))

    square, flat = blocks("square", 4), blocks("flat", 5)
    level = square.mean()
    assert np.abs(square - flat).mean() < 0.04 * level
    assert np.abs(square - blocks("flat", 4)[:16]).mean() > 0.15 * level

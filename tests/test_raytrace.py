"""The Mitsuba worker: rays, alpha, noise estimate, determinism, variant probing."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.scene_records import sphere_summary

from dnrpipe.core.cameras import make_cameras
from dnrpipe.core.errors import UserError
from dnrpipe.core.settings import CameraSettings
from dnrpipe.raytrace.noise import half_noise
from dnrpipe.raytrace.variants import choose_variant, llvm_libraries
from dnrpipe.workers.task_list import TaskResult, run_tasks
from dnrtrain.exr import read_exr, write_exr

SUMMARY = sphere_summary((0.0, 0.0, 0.0), 1.2)
BUNDLE = """<scene version="3.0.0">
  <integrator type="path"/>
  <emitter type="constant"/>
  <shape type="sphere"><bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
</scene>"""


def _view(**changes):
    settings = CameraSettings(train=1, val=0, test=0, width=48, height=32)
    return make_cameras(SUMMARY, settings)["train"][0].model_copy(update=changes)


def _trace(folder: Path, tasks: list[dict], workers: int = 1) -> list[dict]:
    (folder / "scene.xml").write_text(BUNDLE)
    choice = choose_variant()
    common = {"bundle": str(folder / "scene.xml"), "variant": choice.variant, "threads": 1}
    outcomes = run_tasks(
        "dnrpipe.raytrace.tracer",
        common,
        tasks,
        workers=workers,
        log=folder / "log.txt",
        environment=choice.environment,
    )
    results = [o for o in outcomes if isinstance(o, TaskResult)]
    assert all(o.result for o in results), [o.error for o in results]
    return [o.result for o in results if o.result]


def _task(folder: Path, name: str, **changes) -> dict:
    task = {
        "view": _view().model_dump(mode="json"),
        "output": str(folder / f"{name}.exr"),
        "spp": 64,
        "max_depth": 4,
        "seed": 3,
        "fingerprint": "f",
    }
    return task | changes


def test_mitsuba_looks_where_the_view_says() -> None:
    """Rays of the sensor at pixel centres equal View.ray_directions: off-centre lens, pixels that are not square, and
    through the middle of a lens with an aperture; through its rim they meet those in the plane that is in focus."""
    code = """
import json, sys, numpy as np
from dnrtrain.contract import View
from dnrpipe.raytrace import plugins
from dnrpipe.raytrace.sensors import sensor_dict
import mitsuba as mi
mi.set_variant("scalar_rgb")
plugins.register(mi)
view, lens = View.model_validate(json.loads(sys.argv[1])), json.loads(sys.argv[2])
sensor = mi.load_dict(sensor_dict(mi, view, lens))
directions = view.ray_directions()
worst = 0.0
for row in range(0, view.height, 5):
    for column in range(0, view.width, 5):
        at = [(column + 0.5) / view.width, (row + 0.5) / view.height]
        ray, _ = sensor.sample_ray(0, 0, at, [0.5, 0.5])
        worst = max(worst, float(np.abs(np.array(ray.d) - directions[row, column]).max()))
        assert np.abs(np.array(ray.o) - view.position).max() < 1e-3
        if lens is not None:
            rim, _ = sensor.sample_ray(0, 0, at, [0.9, 0.7])
            assert np.linalg.norm(np.array(rim.o) - view.position) > 0.5 * lens["aperture_radius"]
            ends = [
                np.array(one.o) + np.array(one.d) * (lens["focus_distance"] / -(np.array(one.d) @ view.matrix[:3, 2]))
                for one in (ray, rim)
            ]
            worst = max(worst, float(np.abs(ends[0] - ends[1]).max()))
print(worst)
"""
    aspect, lens = {"fl_y": 1.25 * _view().fl_x}, {"aperture_radius": 0.2, "focus_distance": 3.0}
    for changes, given in (({}, None), ({"cx": 10.0, "cy": 25.5}, None), (aspect, None), ({**aspect, "cx": 9.7}, lens)):
        data = [json.dumps(value) for value in (_view(**changes).model_dump(mode="json"), given)]
        done = subprocess.run([sys.executable, "-c", code, *data], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert float(done.stdout) < 1e-5


def test_a_grey_sphere_in_white_light(tmp_path: Path) -> None:
    """In uniform unit light a diffuse convex body shows its albedo; the background is transparent."""
    (result,) = _trace(tmp_path, [_task(tmp_path, "a", spp=256)])
    channels, metadata = read_exr(tmp_path / "a.exr")
    inside = channels["A"] > 0.999
    assert inside.sum() > 200
    assert channels["A"][0, 0] == 0
    assert channels["R"][0, 0] == 0
    assert channels["G"][inside].mean() == pytest.approx(0.5, rel=0.01)
    assert metadata["fingerprint"] == "f"
    assert metadata["spp"] == result["spp"] == 256


def test_same_seed_same_bits_other_seed_other_bits(tmp_path: Path) -> None:
    tasks = [_task(tmp_path, "a"), _task(tmp_path, "b"), _task(tmp_path, "c", seed=4), _task(tmp_path, "d")]
    _trace(tmp_path, tasks, workers=2)
    a, b, c, d = (read_exr(tmp_path / f"{n}.exr")[0]["R"] for n in "abcd")
    assert np.array_equal(a, b)
    assert np.array_equal(a, d)
    assert not np.array_equal(a, c)


def test_odd_and_single_sample_counts(tmp_path: Path) -> None:
    results = _trace(tmp_path, [_task(tmp_path, "a", spp=1), _task(tmp_path, "b", spp=7)])
    assert results[0]["spp"] == 1
    assert results[0]["noise"] is None
    assert results[1]["spp"] == 7


def test_the_noise_estimate_is_the_error_of_the_mean() -> None:
    """Against the known truth, for two independent halves with Gaussian noise well inside the display range."""
    rng = np.random.default_rng(0)
    truth = np.ones((400, 400, 4)) * [0.3, 0.3, 0.3, 1.0]
    halves = [truth + rng.normal(0, 0.02, truth.shape) * [1, 1, 1, 0] for _ in range(2)]
    estimated = half_noise(*halves).rmse
    slope = 1.055 / 2.4 * 0.3 ** (1 / 2.4 - 1)
    assert estimated == pytest.approx(slope * 0.02 / np.sqrt(2), rel=0.03)


def test_the_collector_does_not_free_a_scene_while_another_is_rendered() -> None:
    """Dr.Jit ends the process when it does. Here the collector comes at the worst moment if it comes at all."""
    code = """
import gc
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from dnrpipe.raytrace import plugins
from dnrpipe.raytrace.engine import Engine
from dnrpipe.raytrace.visibility import camera_integrator
plugins.register(mi)

tint = {"type": "rgb", "value": [0.2, 0.5, 0.8]}
glass = {"type": "dnr_transparent", "transmittance": tint}
Glass = type(mi.load_dict(glass))

def collecting(method):
    def call(*arguments):
        if gc.isenabled():
            gc.collect()
        return method(*arguments)
    return call

for name in ("sample", "eval", "pdf", "eval_pdf", "eval_null_transmission"):
    setattr(Glass, name, collecting(getattr(Glass, name)))
engine = Engine.__new__(Engine)
engine.mi = mi
for number in range(6):
    sheets = {
        f"sheet{at}": {
            "type": "rectangle", "bsdf": glass, "to_world": mi.ScalarTransform4f().translate([0, 0, 2 + at]).scale(9),
        } for at in range(1 + number % 3)
    }
    scene = mi.load_dict({"type": "scene", "light": {"type": "constant"}, **sheets})
    sensor = mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}})
    integrator, _ = camera_integrator(mi, scene, 8, "path")
    engine.render(scene, sensor=sensor, integrator=integrator, spp=4).numpy()
    kept = [scene]
    kept.append(kept)  # a cycle: only the collector frees it
    del scene, kept
assert gc.isenabled()
print("rendered")
"""
    chosen = choose_variant("auto")
    if not chosen.variant.startswith("llvm"):
        pytest.skip(f"{chosen.variant}: about LLVM")
    environment = {**os.environ, **chosen.environment}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.split() == ["rendered"], f"exit code {done.returncode}: {done.stderr[-500:]}"


def test_an_unusable_variant_is_refused_and_llvm_15_is_not_tried() -> None:
    with pytest.raises(UserError, match="cuda_ad_rgb") as caught:
        choose_variant("cuda_ad_rgb")
        pytest.skip("this machine has CUDA")
    assert "\n" not in str(caught.value)
    assert not [p for p in llvm_libraries() if "LLVM-15" in p.name or "LLVM-16" in p.name]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no way to leave a process one core here")
def test_one_core_is_enough_for_a_bundle_with_an_image(tmp_path: Path) -> None:
    """Mitsuba's EXR reader waited for ever there."""
    write_exr(tmp_path / "sky.exr", {c: np.ones((64, 128), np.float32) for c in "RGB"}, {})
    bundle = tmp_path / "scene.xml"
    bundle.write_text(
        BUNDLE.replace('"constant"/>', f'"envmap"><string name="filename" value="{tmp_path}/sky.exr"/></emitter>')
    )
    script = """
import os, sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from pathlib import Path
from dnrpipe.raytrace.engine import Engine
Engine(sys.argv[1], 0, [Path(sys.argv[2])])
"""
    choice = choose_variant()
    command = [sys.executable, "-c", script, choice.variant, str(bundle)]
    subprocess.run(command, check=True, env={**os.environ, **choice.environment}, timeout=60)

"""Frames by kept kernels: Mitsuba's own pictures, G-buffers that agree with geometry, nothing recorded twice."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.scene_records import sphere_summary

from dnrpipe.core.cameras import make_cameras
from dnrpipe.core.settings import CameraSettings
from dnrpipe.raytrace.variants import choose_variant

SUMMARY = sphere_summary((0.0, 0.0, 0.0), 1.2)
SPHERE = """<scene version="3.0.0">
  <emitter type="constant"/>
  <shape type="sphere"><bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.4, 0.2"/></bsdf></shape>
  %s
</scene>"""
LAMP = """<shape type="sphere" id="light-near"><transform name="to_world"><scale value="0.2"/>
  <translate x="%g" y="%g" z="%g"/></transform>
  <emitter type="area"><rgb name="radiance" value="5"/></emitter></shape>"""
HALF_THERE = """<shape type="sphere"><transform name="to_world"><scale value="1.3"/></transform>
  <bsdf type="mask"><float name="opacity" value="0.25"/><bsdf type="diffuse"/></bsdf></shape>"""
MIRROR = """<shape type="sphere"><transform name="to_world"><scale value="1.3"/></transform>
  <bsdf type="conductor"/></shape>"""

GLASS = """<shape type="sphere"><transform name="to_world"><scale value="1.3"/></transform>
  <bsdf type="dielectric"><float name="int_ior" value="1.05"/></bsdf></shape>"""

SCRIPT = """
import json, sys
from pathlib import Path
import numpy as np
from dnrtrain.contract import View
from dnrpipe.raytrace.engine import Engine
from dnrpipe.raytrace.frames import Frames
variant, folder, views = sys.argv[1], Path(sys.argv[2]), [View.model_validate(v) for v in json.loads(sys.argv[3])]
engine = Engine(variant, 0, [folder / "scene.xml"])
frames = Frames(engine, folder / "scene.xml", "path", 5, (views[0].width, views[0].height))
integrator, _ = engine.integrator(folder / "scene.xml", "path", 5)
answer = {}
def note(**values):
    answer.update({name: float(value) for name, value in values.items()})
"""


def _run(folder: Path, extra: str, code: str, views: int = 3) -> dict[str, Any]:
    """What the code notes down, in a process of its own."""
    (folder / "scene.xml").write_text(SPHERE % extra)
    choice = choose_variant()
    if choice.variant.startswith("scalar"):
        pytest.skip("needs a jit variant of Mitsuba")
    cameras = _views(views)
    data = json.dumps([view.model_dump(mode="json") for view in cameras])
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT + code + "\nprint(json.dumps(answer))", choice.variant, str(folder), data],
        env={**os.environ, **choice.environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def _views(count: int) -> list[Any]:
    """Off-centre, and with pixels that are not square."""
    camera = CameraSettings(train=count, val=0, test=0, width=48, height=32)
    views = make_cameras(SUMMARY, camera)["train"]
    return [view.model_copy(update={"fl_y": 0.9 * view.fl_x, "cx": 22.0, "cy": 17.5}) for view in views]


def test_a_frame_is_what_mitsuba_itself_renders(tmp_path: Path) -> None:
    """Same mean as the tracer's frame within its noise, for views that the kernel was not recorded with."""
    found = _run(
        tmp_path,
        LAMP % (0, 0, 2),
        """
worst = 0.0
for number, view in enumerate(views):
    kept = frames.path(view, 64, number)
    plain, _ = engine.frame(folder / "scene.xml", integrator, engine.sensor(view), view, 256, number)
    worst = max(worst, float(np.abs(kept - plain).mean()))
    note(alpha=np.abs(kept[..., 3].mean() - plain[..., 3].mean()))
before = frames._kernels["_path_kernel", 64].n_recordings
again = frames.path(views[0], 64, 0)
note(worst=worst, level=kept[..., :3].mean(), recorded=frames._kernels["_path_kernel", 64].n_recordings - before,
     same=np.abs(again - frames.path(views[0], 64, 0)).max(), other=np.abs(again - frames.path(views[0], 64, 1)).max())
""",
    )
    assert found["worst"] < 0.05 * found["level"]
    assert found["alpha"] < 2e-3
    assert found["recorded"] == 0
    assert found["same"] == 0
    assert found["other"] > 0


def test_a_picture_of_another_size_takes_the_kernels_that_are_there(tmp_path: Path) -> None:
    """And recording them is in no stopwatch's seconds, the first picture's rendering is."""
    found = _run(
        tmp_path,
        LAMP % (0, 0, 2),
        """
import time
import drjit as dr
from dnrpipe.raytrace.recorded import Stopwatch
def kernels(view):
    began, before, watch = time.monotonic(), Stopwatch.recording[0], Stopwatch()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        Frames(engine, folder / "scene.xml", "path", 5, (view.width, view.height)).path(view, 4, 0)
        known = {kernel["hash"] for kernel in dr.kernel_history((dr.KernelType.JIT,))}
    seconds, recording = watch.costs()["seconds"], Stopwatch.recording[0] - before
    return {"seconds": seconds, "recording": recording, "whole": time.monotonic() - began}, known
larger = views[0].model_copy(update={"width": 96, "height": 64, "cx": 44.0, "cy": 35.0})
(times, at_first), (_, later) = kernels(views[0]), kernels(larger)
note(at_first=len(at_first), new=len(later - at_first), **times)
""",
        views=1,
    )
    assert found["at_first"] >= 1 and found["new"] == 0
    assert found["seconds"] > 0 and found["recording"] > 0
    assert found["seconds"] + found["recording"] <= found["whole"]


def test_many_samples_in_several_launches_are_as_little_noisy(tmp_path: Path) -> None:
    """64 samples in four launches: other random numbers in each, and the noise of 64, which is half that of 16."""
    found = _run(
        tmp_path,
        LAMP % (0, 0, 2),
        """
from dnrpipe.raytrace import frames as module
exact, _ = engine.frame(folder / "scene.xml", integrator, engine.sensor(views[0]), views[0], 1024, 0)
def off(frames, spp):
    return np.abs(frames.path(views[0], spp, 5) - exact).mean()
note(whole=off(frames, 64), few=off(frames, 16))
module.MAX_RAYS = 16 * exact[..., 0].size
other = Frames(engine, folder / "scene.xml", "path", 5, frames.size)
note(parts=off(other, 64))
""",
        views=1,
    )
    assert found["parts"] == pytest.approx(found["whole"], rel=0.15)
    assert found["few"] > 1.6 * found["parts"]


def test_auxiliary_images_show_the_surface_and_not_the_lamp_before_it(tmp_path: Path) -> None:
    position = _views(1)[0].position * 0.6  # in front of the camera
    found = _run(
        tmp_path,
        LAMP % tuple(position),
        """
guide = frames.auxiliary(views[0], 16, 3)
inside = guide.coverage == 1
note(albedo=np.abs(guide.albedo[inside] - [0.6, 0.4, 0.2]).max(), inside=inside.sum(),
     length=np.linalg.norm(guide.normal[inside], axis=-1).min(),
     outside=np.abs(guide.normal[guide.coverage == 0]).max())
""",
        views=1,
    )
    assert found["inside"] > 200
    assert found["albedo"] < 1e-3
    assert found["length"] > 0.9
    assert found["outside"] == 0


def test_auxiliary_images_show_what_is_behind_glass(tmp_path: Path) -> None:
    code = """
kept = frames.auxiliary(views[0], 64, 3).albedo
albedo, normal, _ = engine.auxiliary(folder / "scene.xml", views[0], 64)
half = len(albedo) // 2
for name, image in (("frames", kept), ("engine", albedo)):
    note(**{name + colour: image[half, half, i] for i, colour in enumerate("RGB")})
note(normal=np.linalg.norm(normal[half, half]))
"""
    found = _run(tmp_path, GLASS, code, views=1)
    for name in ("frames", "engine"):  # a few of the rays are mirrored away, to where nothing is: albedo 1
        assert [found[name + colour] for colour in "RGB"] == pytest.approx([0.6, 0.4, 0.2], abs=0.01)
    assert found["normal"] > 0.9


def test_mirrors_have_albedo_one_and_half_transparent_surfaces_are_half_there(tmp_path: Path) -> None:
    mirror = _run(
        tmp_path, MIRROR, "g = frames.auxiliary(views[0], 16, 3); note(a=g.albedo[g.coverage == 1].min())", views=1
    )
    assert mirror["a"] == pytest.approx(1)
    code = """
g = frames.auxiliary(views[0], 256, 3)
rim = ~(np.abs(g.coverage - 1) < 1e-6) & (g.coverage > 0)
r = np.linalg.norm(np.cross(views[0].ray_directions(), views[0].position), axis=-1)
between = (r > 1.1) & (r < 1.2)
note(between=g.coverage[between].mean(), inside=g.coverage[r < 0.9].min(), outside=g.coverage[r > 1.4].max())
"""
    found = _run(tmp_path, HALF_THERE, code, views=1)
    # A ray beside the inner sphere meets the outer one twice: 1 - (1 - 1/4)².
    assert found["between"] == pytest.approx(1 - 0.75**2, abs=0.02)
    assert found["inside"] == 1
    assert found["outside"] == 0


def test_the_gbuffer_is_the_geometry(tmp_path: Path) -> None:
    """Against the unit sphere by formula; coverage, looked at along the rim only, against many rays everywhere."""
    found = _run(
        tmp_path,
        "",
        """
worst = dict(mask=0, position=0, normal=0, depth=0, cover=0)
for view in views:
    g = frames.gbuffer(view, rays=64)
    d, o = view.ray_directions().astype(np.float64), view.position
    b = d @ o
    root = b * b - (o @ o - 1)
    hit = root > 0
    t = -b - np.sqrt(np.where(hit, root, 0))
    p = o + d * t[..., None]
    both = hit & (g["mask"] > 0)
    position = np.stack([g[f"position.{a}"] for a in "XYZ"], -1)
    normal = np.stack([g[f"normal.{a}"] for a in "XYZ"], -1)
    sure = both & (root > 1e-2)
    now = dict(mask=(hit != (g["mask"] > 0)).sum(), position=np.abs(position - p)[sure].max(),
               normal=np.abs(normal - p)[sure].max(),
               depth=np.abs(g["depth.Z"] - (o - p) @ view.matrix[:3, 2])[sure].max(),
               cover=abs(g["coverage"].mean() - frames.auxiliary(view, 256, 1).coverage.mean()))
    worst = {k: max(float(v), worst[k]) for k, v in now.items()}
    assert not g["depth.Z"][g["mask"] == 0].any() and not position[g["mask"] == 0].any()
note(**worst)
""",
    )
    assert found["mask"] <= 2
    assert found["position"] < 1e-4
    assert found["normal"] < 1e-4
    assert found["depth"] < 1e-4
    assert found["cover"] < 1e-3


def test_silhouettes_in_several_launches_are_the_same(tmp_path: Path) -> None:
    """Memory is bounded: edge pixels are looked at in parts."""
    found = _run(
        tmp_path,
        "",
        """
from dnrpipe.raytrace import frames as module
mask = frames.gbuffer(views[0])["mask"] > 0
whole = frames.coverage(views[0], mask)
module.MAX_RAYS = 16 * 7
parts = frames.coverage(views[0], mask)
note(same=(whole == parts).all(), partial=((whole > 0) & (whole < 1)).sum())
""",
        views=1,
    )
    assert found["same"] == 1
    assert found["partial"] > 20


def test_cutouts_in_several_launches_cover_as_much(tmp_path: Path) -> None:
    """A quarter of a veil, everywhere: 16 rays a pixel in one launch, in four of four cells each, by formula."""
    found = _run(
        tmp_path,
        HALF_THERE,
        """
from dnrpipe.raytrace import frames as module
mask = frames.gbuffer(views[0])["mask"] > 0
whole = frames.coverage(views[0], mask)
module.MAX_RAYS = 4 * whole.size
other = Frames(engine, folder / "scene.xml", "path", 5, frames.size)
parts = other.coverage(views[0], mask)
again = other.coverage(views[0], mask)
steps = np.round(parts * 16) - parts * 16
exact = frames.coverage(views[0], mask, alpha=whole)
veil = (np.abs(exact - (1 - 0.75**2)) < 1e-4).sum() / ((whole > 0) & (whole < 0.9)).sum()
note(exact=exact.mean(), veil=veil, outside=exact[whole == 0].mean())
note(whole=whole.mean(), parts=parts.mean(), off=np.abs(whole - parts).mean(), steps=np.abs(steps).max(),
     fine=(np.round(parts * 4) != parts * 4).mean(), same=(parts == again).all())
""",
        views=1,
    )
    assert found["parts"] == pytest.approx(found["whole"], rel=0.02)
    assert 0 < found["off"] < 0.1  # other random points
    assert found["steps"] < 1e-4 and found["fine"] > 0.1  # of 16 rays, not of 4
    assert found["same"] == 1
    # Where a base image tells which pixels are partly covered, these are looked at alone, and without chance.
    assert found["exact"] == pytest.approx(found["whole"], rel=0.02)
    assert found["veil"] > 0.6  # the rest are rims
    assert found["outside"] < 0.01  # corners of rims


def test_views_of_another_size_and_odd_ray_counts_are_refused(tmp_path: Path) -> None:
    found = _run(
        tmp_path,
        "",
        """
try:
    frames.path(views[0].model_copy(update={"width": 20}), 1, 0)
    note(refused=0)
except ValueError as error:
    note(refused="is 20x32, the kernels are for" in str(error))
try:
    frames.gbuffer(views[0], rays=10)
    note(odd=0)
except ValueError as error:
    note(odd="is 10, expected a square number" in str(error))
""",
        views=1,
    )
    assert found["refused"] == found["odd"] == 1

"""Blender's G-buffers against Mitsuba's ``aov`` integrator, pixel by pixel at pixel centres.

The meshes are those of ``scene/geometry.npz`` with the atlas as UV, so that positions, normals and atlas
coordinates of both renderers must agree; the cameras are the views' own.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from e2e_harness import run

from dnrpipe.raytrace.variants import choose_variant
from dnrtrain.contract import read_cameras
from dnrtrain.exr import read_exr

pytestmark = [pytest.mark.slow, pytest.mark.e2e]

AOV = """
import json, sys, numpy as np
from pathlib import Path
import mitsuba as mi
mi.set_variant(sys.argv[1])
from dnrpipe.blender.geometry.frozen import load_geometry
from dnrpipe.raytrace.sensors import sensor_dict
from dnrtrain.contract import View
workspace, out = Path(sys.argv[2]), Path(sys.argv[3])
scene = {"type": "scene"}
for i, mesh in enumerate(load_geometry(workspace / "scene" / "geometry.npz")):
    shape = mi.Mesh(f"mesh{i}", 3 * mesh.triangles, mesh.triangles, has_vertex_normals=True, has_vertex_texcoords=True)
    params = mi.traverse(shape)
    params["vertex_positions"] = mesh.positions.ravel()
    params["vertex_normals"] = mesh.normals.ravel()
    params["vertex_texcoords"] = mesh.atlas.ravel()
    params["faces"] = np.arange(3 * mesh.triangles, dtype=np.uint32)
    params.update()
    scene[f"mesh{i}"] = shape
scene = mi.load_dict(scene)
for name, data in json.loads(sys.stdin.read()).items():
    view = View.model_validate(data)
    sensor = mi.load_dict(sensor_dict(mi, view))
    import drjit as dr
    y, x = np.mgrid[0:view.height, 0:view.width]
    at = [((a.ravel() + 0.5) / n).astype(np.float32) for a, n in ((x, view.width), (y, view.height))]
    at = mi.Point2f(at)
    ray, _ = sensor.sample_ray(0.0, 0.5, at, mi.Point2f(0.5, 0.5))
    si = scene.ray_intersect(ray)
    hit = np.array(si.is_valid())
    def image(value, n):
        return np.where(hit[:, None], np.array(value).T.reshape(-1, n) if n > 1 else np.array(value).reshape(-1, 1), 0)
    # Mitsuba's distance is along the ray; ours is planar.
    forward = -view.matrix[:3, 2]
    direction = np.array(ray.d).T
    origin = np.array(ray.o).T
    position = image(si.p, 3)
    depth = np.where(hit, (position - view.position) @ forward, 0)
    shape = (view.height, view.width, -1)
    np.savez(
        out / f"{name}.npz",
        mask=hit.reshape(shape[:2]),
        depth=depth.reshape(shape[:2]),
        uv=image(si.uv, 2).reshape(shape),
        normal=image(si.sh_frame.n, 3).reshape(shape),
        # Cycles turns the shading normal to the camera where it hits a back face.
        facing=np.sign((-direction * image(si.n, 3)).sum(-1)).reshape(shape[:2]),
    )
"""


def _compare(workspace: Path, scratch: Path) -> dict[str, float]:
    views = read_cameras(workspace / "cameras" / "train.json")[:4]
    choice = choose_variant("llvm_ad_rgb")
    import os

    done = subprocess.run(
        [sys.executable, "-c", AOV, choice.variant, str(workspace), str(scratch)],
        input=json.dumps({v.name: v.model_dump(mode="json") for v in views}),
        env={**os.environ, **choice.environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    worst = {"iou": 1.0, "depth": 0.0, "uv": 0.0, "normal": 0.0}
    for view in views:
        blender, _ = read_exr(workspace / "passes" / "train" / f"{view.name}.exr")
        mitsuba = np.load(scratch / f"{view.name}.npz")
        mask = blender["mask"] > 0.5
        both = mask & mitsuba["mask"]
        assert both.sum() > 100
        worst["iou"] = min(worst["iou"], both.sum() / (mask | mitsuba["mask"]).sum())
        relative = np.abs(blender["depth.Z"] - mitsuba["depth"])[both] / mitsuba["depth"][both]
        uv = np.stack([blender["uv.U"], blender["uv.V"]], -1)
        normal = np.stack([blender[f"normal.{c}"] for c in "XYZ"], -1)
        # A ray that grazes an edge may hit either triangle; such pixels (< 0.1 %) show as a jump in depth.
        worst["depth"] = max(worst["depth"], float(np.quantile(relative, 0.999)))
        worst["uv"] = max(worst["uv"], float(np.quantile(np.abs(uv - mitsuba["uv"]).max(-1)[both], 0.999)))
        cosine = np.clip((normal * mitsuba["normal"]).sum(-1) * mitsuba["facing"], -1, 1)[both]
        worst["normal"] = max(worst["normal"], float(np.degrees(np.arccos(np.quantile(cosine, 0.01)))))
    print(worst)
    return worst


def _check(worst: dict[str, float]) -> None:
    assert worst["iou"] >= 0.999
    assert worst["depth"] <= 1e-4
    assert worst["uv"] <= 1e-4
    assert worst["normal"] <= 0.1


def test_demo_scene(tiny: Path, tmp_path: Path) -> None:
    _check(_compare(tiny, tmp_path))


def test_spot(shared_assets: Path, tmp_path: Path) -> None:
    run("prepare", str(shared_assets / "spot" / "spot.obj"), folder=tmp_path)
    _check(_compare(tmp_path / "spot.dnr", tmp_path))


def test_the_check_can_fail(tiny: Path, tmp_path: Path) -> None:
    """A V axis the wrong way round is far outside the tolerance."""
    blender, _ = read_exr(sorted((tiny / "passes" / "train").glob("*.exr"))[0])
    mask = blender["mask"] > 0.5
    flipped = np.abs((1 - blender["uv.V"]) - blender["uv.V"])[mask]
    assert np.quantile(flipped, 0.999) > 1e-2

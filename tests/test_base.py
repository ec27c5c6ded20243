"""Baked light and base images on scenes whose answer is known, or path-traced beside them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.corner_room import corner_room, onwards, quad, rgb

from dnrpipe.blender.bundle.ply import weld, write_ply
from dnrpipe.core.images import rgba
from dnrpipe.raytrace.auxiliary import auxiliary_integrator
from dnrpipe.raytrace.base_renderer import CENTRES, FACING, MEANS, NOISE, SHOWN, BaseRenderer
from dnrpipe.raytrace.base_worker import Worker, denoised, without_grain
from dnrpipe.raytrace.engine import Engine
from dnrpipe.raytrace.history import History
from dnrpipe.raytrace.lightmap import LightBaker
from dnrpipe.raytrace.lobes import diffuse_context
from dnrpipe.raytrace.recorded import planes_of
from dnrpipe.raytrace.second_targets import second_targets
from dnrpipe.raytrace.sensors import sensor_dict
from dnrpipe.raytrace.surface_maps import SurfaceMapper
from dnrpipe.raytrace.tasks import CHUNK, WARM_UP
from dnrpipe.raytrace.texels import grouped_meshes, seen_sides
from dnrtrain.contract import BASE_CHANNELS, FRESH_CHANNELS, View
from dnrtrain.exr import read_exr, write_exr

mi = pytest.importorskip("mitsuba")
SIZE = 48
SCENES = Path(__file__).resolve().parents[1] / "blender_scenes"
BENCHMARKS = sorted(path.stem for path in SCENES.glob("*.blend") if path.stem != "demo")


@pytest.fixture(autouse=True)
def _variant(mitsuba_variant: str) -> None:
    if mitsuba_variant.startswith("scalar"):
        pytest.skip("base images need a jit variant of Mitsuba; this machine has none")


def camera(azimuth: float = 0.3) -> View:
    """Looks at the room's middle from the front, from above."""
    at = np.array([4 * np.sin(azimuth), -4 * np.cos(azimuth), 2.0])
    back = (at - [0, 0.3, 0.4]) / np.linalg.norm(at - [0, 0.3, 0.4])
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = at
    rows = tuple(tuple(float(x) for x in row) for row in pose)
    return View(name="v", width=SIZE, height=SIZE, fl_x=70, fl_y=70, cx=SIZE / 2, cy=SIZE / 2, c2w=rows)


def traced(scene: Any, view: View, spp: int = 2048, kind: str = "path", depth: int = 8) -> np.ndarray:
    integrator = mi.load_dict({"type": kind, "max_depth": depth, "hide_emitters": True})
    sensor = mi.load_dict(sensor_dict(mi, view))
    return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=3))


def rendered(scene: Any, light: np.ndarray, view: View, samples: int = 4) -> dict[str, np.ndarray]:
    return BaseRenderer(mi, scene, light).frame(view, samples)


def colour(channels: dict[str, np.ndarray]) -> np.ndarray:
    return rgba(channels, "base.")


NAN = float("nan")


def poisoned_room(folder: Path, name: str) -> Any:
    """A glossy wall, a matt floor and two lamps, one parameter of which is not finite."""
    grey = {"type": "diffuse", "reflectance": rgb(0.5, 0.5, 0.5)}
    glossy = {"type": "roughconductor", "alpha": 0.2, "specular_reflectance": rgb(0.5, 0.5, 0.5)}
    lamps = [{"type": "point", "position": [x, 0.0, 2.0], "intensity": rgb(6, 6, 6)} for x in (-0.5, 0.5)]
    scene = corner_room(folder, grey, glossy, lamps[0], other=lamps[1])
    if name:
        parameters = mi.traverse(scene)
        parameters[name] = mi.Color3f(NAN, 1, 1)
        parameters.update()
    return scene


@pytest.mark.parametrize(
    ("name", "lost", "repaired", "masked"),
    [
        ("", False, False, False),
        ("light.intensity.value", True, True, False),
        ("wall.bsdf.specular_reflectance.value", True, True, False),
        ("floor.bsdf.reflectance.value", True, False, True),
    ],
)
def test_samples_that_are_not_finite_are_counted(
    tmp_path: Path, name: str, lost: bool, repaired: bool, masked: bool
) -> None:
    """A NaN lamp, a NaN mirror, a NaN reflectance: pictures and light stay finite, and say what they lost."""
    scene = poisoned_room(tmp_path, name)
    baker = LightBaker(mi, scene, onwards())
    light = baker.bake(16, 16, 0)
    renderer = BaseRenderer(mi, scene, light)
    channels = renderer.frame(camera(), 2)
    assert np.isfinite(light).all() and all(np.isfinite(values).all() for values in channels.values())
    assert (baker.lost > 0, renderer.repaired > 0, renderer.masked > 0) == (lost, repaired, masked)
    assert renderer.repaired + renderer.masked < SIZE * SIZE
    assert np.isfinite(BaseRenderer(mi, scene, light).frame(camera(), 1)["base.R"]).all()
    mapper = SurfaceMapper(mi, scene, None)
    assert all(np.isfinite(values).all() for values in mapper.maps(16, 4, 0).values())
    assert (mapper.lost > 0) == (name == "floor.bsdf.reflectance.value")


def test_large_pictures_in_bands_have_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is bounded by launches of few rows, all of one kernel: the last band begins within the one before."""
    from dnrpipe.raytrace import base_renderer

    scene = poisoned_room(tmp_path, "")
    light = np.ones((2, 2, 16, 16, 3), np.float32)
    whole = BaseRenderer(mi, scene, light).frame(camera(), 2)
    monkeypatch.setattr(base_renderer, "MAX_RAYS", 2 * SIZE * 11)
    renderer = BaseRenderer(mi, scene, light)
    launches: list[int] = []
    kernel = renderer.kernel
    monkeypatch.setattr(renderer, "kernel", lambda *given: launches.append(given[-2]) or kernel(*given))
    banded = renderer.frame(camera(), 2)
    assert launches == [10] * 5 and kernel.n_recordings == 1
    assert all((banded[name] == whole[name]).all() for name in whole)


def test_guides_of_large_pictures_are_means_of_several_launches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dnrpipe.raytrace import engine as module

    engine: Any = object.__new__(Engine)
    engine.mi, engine.compiled, engine.unit_scale = mi, True, 1.0
    engine.scenes = {"room": poisoned_room(tmp_path, "")}
    whole = engine.auxiliary(Path("room"), camera(), 64)
    monkeypatch.setattr(module, "MAX_AUXILIARY", 20 * SIZE * SIZE)
    parts = engine.auxiliary(Path("room"), camera(), 64)  # 20 + 20 + 20 + 4 samples
    for one, other in zip(whole[:2], parts[:2], strict=True):
        assert not np.array_equal(one, other)
        assert np.abs(one - other).mean() < 0.01
    assert parts[0].mean() == pytest.approx(whole[0].mean(), rel=0.01)


def test_guides_that_are_not_finite_are_counted(tmp_path: Path) -> None:
    """The denoiser's albedo of a floor that reflects NaN."""
    engine: Any = object.__new__(Engine)
    engine.mi, engine.compiled, engine.unit_scale = mi, True, 1.0
    for name, lost in (("", False), ("floor.bsdf.reflectance.value", True)):
        engine.scenes = {"room": poisoned_room(tmp_path, name)}
        albedo, normal, count = engine.auxiliary(Path("room"), camera(), 4)
        assert np.isfinite(albedo).all() and np.isfinite(normal).all()
        assert (count > 0) == lost


def test_light_in_a_white_furnace_is_one_on_both_sides(tmp_path: Path) -> None:
    floor = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(0.2, 0.5, 0.8)}}
    shape = quad(tmp_path / "f.ply", [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], (0.05, 0.05), floor)
    scene = mi.load_dict({"type": "scene", "floor": shape, "light": {"type": "constant"}})
    light = LightBaker(mi, scene, onwards()).bake(32, 4096, 0)
    assert light.shape == (2, 2, 32, 32, 3)
    chart = light[0, :, 4:12, 4:12]
    assert np.abs(chart - 1).max() < 0.1
    assert chart.mean() == pytest.approx(1, abs=0.01)


def test_scenes_lit_by_shining_meshes_alone_are_recorded_at_the_first_call(tmp_path: Path) -> None:
    """A textured one makes its distribution at its first use, which must not fall into the recording."""
    grey = {"type": "diffuse", "reflectance": rgb(0.5, 0.5, 0.5)}
    picture = mi.Bitmap(np.linspace(0, 1, 48, dtype=np.float32).reshape(4, 4, 3))
    shining = {"type": "area", "radiance": {"type": "bitmap", "bitmap": picture, "raw": True}}
    screen = quad(tmp_path / "s.ply", [[-1, 0, 0.2], [1, 0, 0.2], [1, 0, 1], [-1, 0, 1]], (0.05, 0.55), grey)
    bulb = quad(tmp_path / "b.ply", [[-1, 0, 2], [-1, 1, 2], [1, 1, 2], [1, 0, 2]], (0.55, 0.55), grey)
    bulb["emitter"] = {"type": "area", "radiance": rgb(3, 3, 3)}
    scene = corner_room(tmp_path, grey, grey, screen | {"emitter": shining}, bulb=bulb)
    renderer = BaseRenderer(mi, scene, np.ones((2, 2, 16, 16, 3), np.float32))
    assert colour(renderer.frame(camera(), 2)).max() > 0.5
    assert renderer.kernel.n_recordings == 1


def test_rays_that_meet_a_lamp_are_not_lost(tmp_path: Path) -> None:
    """A rough mirror sees a wide lamp: light from surfaces is 0 there, and counts in the mean of what the lobe sees."""
    grey = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(0.5, 0.5, 0.5)}}
    rough = {"type": "twosided", "b": {"type": "roughconductor", "alpha": 0.6, "specular_reflectance": rgb(1, 1, 1)}}
    lamp = quad(tmp_path / "b.ply", [[-1, 0, 1], [-1, 1, 1], [1, 1, 1], [1, 0, 1]], (0.55, 0.55), grey)
    shining = lamp | {"emitter": {"type": "dnr_area", "radiance": rgb(3, 3, 3)}}
    point = {"type": "point", "position": [0.0, -2.0, 2.0], "intensity": rgb(6, 6, 6)}
    means = []
    for ceiling in (lamp, shining):
        baker = LightBaker(mi, corner_room(tmp_path, rough, grey, point, bulb=ceiling), onwards())
        means.append(baker.bake(32, 256, 0)[1, 0, 2:12, 2:12].mean())
        assert baker.lost == 0
    assert means[1] > 0


@pytest.mark.robustness
@pytest.mark.parametrize("scene", BENCHMARKS)
def test_nothing_is_lost_on_the_benchmark_scenes(scene: str, tmp_path: Path) -> None:
    """Baked light and traced pixels of all ten are finite without repair."""
    environment = {**os.environ, "DNRPIPE_PASSES__RASTER": "cycles-direct"}
    small = ["cameras.test=0", "cameras.val=0", "passes.bake_size=512", "raytrace.spp=32", "base.light_spp=32"]
    options = [part for setting in small for part in ("--set", setting)]
    where = ["-w", str(tmp_path / "scene.dnr"), "-q"]
    source = SCENES / f"{scene}.blend"
    for command in (
        ["prepare", str(source), "--views", "2", "--resolution", "64", *options],
        ["select", "--budget", "2"],
        ["raytrace-selected"],
    ):
        line = [sys.executable, "-m", "dnrpipe.cli", *command, *where]
        done = subprocess.run(line, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert "repaired" not in done.stdout + done.stderr, done.stderr
    records = [json.loads(line) for line in (tmp_path / "scene.dnr" / "costs.jsonl").read_text().splitlines()]
    (light,) = [record for record in records if record["name"] == "light"]
    assert light["detail"]["lost"] == 0
    traced = [record for record in records if record["unit"] == "view" and record["stage"] == "raytrace"]
    assert len(traced) == 4 and not any(r["detail"]["repaired"] or r["detail"]["masked"] for r in traced)


MIDDLE, HALF = np.array([0.0, 0.2, 0.45]), 0.4


def box(path: Path, *, inside_out: bool, sides: int = 6) -> np.ndarray:
    """Triangles [T, 3, 3] of a box, written with an atlas in [0.05, 0.45] x [0.55, 0.95]. sides: the first few."""
    order = [0, 1, 2, 0, 2, 3]
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    parts, triangles = [], []
    for side in range(sides):
        axis, sign = side // 2, 1 if side % 2 else -1
        u, v = np.roll(np.eye(3), axis, axis=0)[1:]
        outwards = sign * np.roll(np.eye(3), axis, axis=0)[0]
        corners = np.array([outwards + a * u + b * v for a, b in 2 * unit - 1]) * HALF + MIDDLE
        if (np.dot(np.cross(u, v), outwards) < 0) != inside_out:
            corners = corners[::-1]
        normals = np.tile(outwards * (-1 if inside_out else 1), (6, 1)).astype(np.float32)
        place = np.array([0.05 + 0.14 * (side % 3), 0.55 + 0.2 * (side // 3)])
        atlas = np.concatenate([unit * 0.1 + place, np.zeros((4, 1))], axis=1).astype(np.float32)
        corners = corners.astype(np.float32)[order]
        parts.append(weld(corners, normals, unit[order], [("atlas", atlas[order])]))
        triangles.append(corners.reshape(2, 3, 3))
    write_ply(path, parts)
    return np.concatenate(triangles)


def test_a_closed_mesh_has_one_side_and_an_open_one_two(tmp_path: Path) -> None:
    found = {
        (inside_out, sides): seen_sides(mi, box(tmp_path / "b.ply", inside_out=inside_out, sides=sides)).tolist()
        for inside_out in (False, True)
        for sides in (5, 6)
    }
    assert found[False, 6] == [True, False] and found[True, 6] == [False, True]
    assert found[False, 5] == found[True, 5] == [True, True]


@pytest.mark.parametrize("material", [{"type": "diffuse"}, {"type": "dnr_principled", "metallic": 1.0}])
def test_an_inside_out_mesh_looks_like_any_other(tmp_path: Path, material: dict[str, Any]) -> None:
    colour_of, grey = ("base_color" if "metallic" in material else "reflectance"), rgb(0.7, 0.7, 0.7)
    solid = {"type": "twosided", "b": {**material, colour_of: grey}}
    if "metallic" in material:
        solid["b"]["roughness"] = 0.8
    light = {"type": "point", "position": [-0.9, -0.6, 2.0], "intensity": rgb(6, 6, 6)}
    plain = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(0.8, 0.5, 0.3)}}
    means = []
    for inside_out in (False, True):
        box(tmp_path / "b.ply", inside_out=inside_out)
        shape = {"type": "ply", "filename": str(tmp_path / "b.ply"), "bsdf": solid}
        scene = corner_room(tmp_path, plain, plain, light, box=shape)
        channels = rendered(scene, LightBaker(mi, scene, onwards()).bake(128, 64, 0), camera(), 8)
        on_box = (channels["uv.V"] > 0.5) & (channels["mask"] > 0.5)
        assert on_box.sum() > 150
        means.append(colour(channels)[on_box, :3].mean())
    assert means[1] == pytest.approx(means[0], rel=0.05) and means[0] > 0.02


def test_what_is_buried_in_a_closed_mesh_takes_the_light_beside_it(tmp_path: Path) -> None:
    """A box stands in the floor: no light is within it, neither on the floor nor on its own inside; unless it is of
    glass."""
    box(tmp_path / "b.ply", inside_out=False)
    plain = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(0.8, 0.5, 0.3)}}
    sunk = mi.ScalarTransform4f().translate([0, 0, -0.2])
    shape = {"type": "ply", "filename": str(tmp_path / "b.ply"), "bsdf": plain, "to_world": sunk}
    baker = LightBaker(mi, corner_room(tmp_path, plain, plain, {"type": "constant"}, box=shape), onwards())
    size = 64
    texels, _, _, _, closed, buried = baker._texels(size)
    row, column = texels // size, texels % size
    x, y = ((np.stack([column, row]) + 0.5) / size - 0.05) / 0.4 * 2 - 1  # on the floor
    floor = (column < 0.47 * size) & (row < 0.47 * size)
    rim = 2 * 2 / (0.4 * size)
    inside = floor & (np.abs(x) < HALF - rim) & (np.abs(y - 0.2) < HALF - rim)
    outside = floor & ((np.abs(x) > HALF + rim) | (np.abs(y - 0.2) > HALF + rim))
    assert inside.sum() > 20 and buried[inside, 0].all() and not buried[outside, 0].any()
    light = baker.bake(size, 64, 0)[0].mean(axis=-1).reshape(2, -1)
    shown = light[0, texels[outside]]
    assert shown.min() > 0.1
    assert light[0, texels[inside]].min() > 0.5 * shown.min() and light[0, texels[inside]].max() < 1.5 * shown.max()
    assert closed[:, 1].sum() > 50 and not closed[:, 0].any() and not light[1, texels[closed[:, 1]]].any()
    glass = {**shape, "bsdf": {"type": "dielectric"}}
    clear = LightBaker(mi, corner_room(tmp_path, plain, plain, {"type": "constant"}, box=glass), onwards())
    assert not clear._texels(size)[-1].any() and not clear._texels(size)[-2].any()


@pytest.mark.parametrize("kind", ["diffuse", "dnr_principled"])
def test_base_is_the_path_traced_picture_where_all_is_diffuse(tmp_path: Path, kind: str) -> None:
    name = "reflectance" if kind == "diffuse" else "base_color"
    extra = {} if kind == "diffuse" else {"roughness": 0.8}
    red, white = ({"type": kind, name: rgb(*value), **extra} for value in ((0.8, 0.2, 0.1), (0.7, 0.7, 0.7)))
    light = {"type": "point", "position": [-0.5, 0.0, 2.0], "intensity": rgb(6, 6, 6)}
    scene = corner_room(tmp_path, {"type": "twosided", "b": white}, {"type": "twosided", "b": red}, light)
    baked = LightBaker(mi, scene, onwards()).bake(128, 128, 0)
    ours, truth = colour(rendered(scene, baked, camera())), traced(scene, camera())
    assert np.abs(ours[..., 3] - truth[..., 3]).mean() < 0.01
    inside = (truth[..., 3] > 0.99) & (ours[..., 3] > 0.99)
    assert ours[inside, :3].mean() == pytest.approx(truth[inside, :3].mean(), rel=0.015)
    assert np.sqrt(np.mean((ours - truth)[inside] ** 2)) < 0.04 * truth[inside, :3].mean()


def test_cutouts_of_translucent_sheets_are_lit_and_light_what_is_behind(tmp_path: Path) -> None:
    sides = {"a": {"type": "twosided", "b": {"type": "diffuse"}}, "b": {"type": "dnr_translucent"}}
    leaf = {"type": "mask", "opacity": 0.6, "b": {"type": "blendbsdf", "weight": 0.5, **sides}}
    floor = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(0.9, 0.5, 0.1)}}
    light = {"type": "point", "position": [0.0, 3.0, 2.0], "intensity": rgb(40, 40, 40)}  # behind the sheet
    scene = corner_room(tmp_path, floor, leaf, light)
    baked = LightBaker(mi, scene, onwards(kind="volpath")).bake(128, 256, 0)
    ours, truth = colour(rendered(scene, baked, camera(), 16)), traced(scene, camera(), kind="volpath")
    assert ours.mean(axis=(0, 1)) == pytest.approx(truth.mean(axis=(0, 1)), rel=0.03)
    # Not premultiplied, colours stay what surfaces have: holes are counted in colour and alpha alike.
    straight = ours[..., :3] / np.maximum(ours[..., 3:], 1e-6)
    assert straight.max() < 3 * truth[..., :3].max()
    wall = np.array(rendered(scene, baked, camera())["uv.U"]) > 0.5  # red light that the floor throws onto the sheet
    assert ours[wall, 0].mean() == pytest.approx(truth[wall, 0].mean(), rel=0.04)


def test_water_takes_its_share_of_the_light_on_the_way(tmp_path: Path) -> None:
    water = {"type": "homogeneous", "albedo": 0.0, "sigma_t": rgb(1.0, 0.2, 0.07), "scale": 1.5}
    place = mi.ScalarTransform4f().translate([0, 0, 0.4]).scale([0.9, 0.9, 0.3])
    basin = {"type": "cube", "to_world": place, "b": {"type": "dielectric", "int_ior": 1.33}, "interior": water}
    others = second_targets(mi)  # as in every worker: media that the scene does not hold
    matte = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(0.8, 0.8, 0.8)}}
    scene = corner_room(tmp_path, matte, matte, {"type": "constant"}, basin=basin)
    baked = LightBaker(mi, scene, onwards(23, kind="volpath")).bake(64, 512, 0)
    ours, truth = colour(rendered(scene, baked, camera(), 32)), traced(scene, camera(), kind="volpath", depth=24)
    middle = (slice(20, 30), slice(18, 30))  # through the water
    ours, truth = ours[middle].mean(axis=(0, 1)), truth[middle].mean(axis=(0, 1))
    assert truth[0] < 0.75 * truth[2] and others
    assert ours == pytest.approx(truth, rel=0.06)


def test_instances_share_the_light_of_the_first(tmp_path: Path) -> None:
    matte = {"type": "twosided", "b": {"type": "diffuse"}}
    shape = quad(tmp_path / "q.ply", [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], (0.05, 0.05), matte)
    moved = np.eye(4)
    moved[:3, 3] = (0.0, 0.0, 0.25)
    group, reference = {"type": "shapegroup", "quad": shape}, {"type": "ref", "id": "group"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "group": group,
            "a": {"type": "instance", "to_world": mi.ScalarTransform4f(moved.tolist()), "g": reference},
            "light": {"type": "constant"},
        }
    )
    light = LightBaker(mi, scene, onwards(), [(tmp_path / "q.ply", moved)]).bake(32, 1024, 0)
    assert light[0, 0, 4:12, 4:12].mean() == pytest.approx(1, abs=0.02)
    numbers = " ".join(map(str, moved.ravel()))
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><shape type="shapegroup" id="g"><shape type="ply">'
        '<string name="filename" value="q.ply"/></shape></shape><shape type="instance"><ref id="g"/>'
        f'<transform name="to_world"><matrix value="{numbers}"/></transform></shape></scene>'
    )
    ((path, matrix),) = grouped_meshes(tmp_path / "scene.xml")
    assert path == tmp_path / "q.ply" and np.array_equal(matrix, moved)


def test_copies_that_share_a_place_share_the_mean_of_their_light(tmp_path: Path) -> None:
    matte = {"type": "twosided", "b": {"type": "diffuse"}}
    up = quad(tmp_path / "u.ply", [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], (0.05, 0.05), matte)
    down = quad(tmp_path / "d.ply", [[3, -1, 0], [3, 1, 0], [5, 1, 0], [5, -1, 0]], (0.05, 0.05), matte)
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": rgb(np.pi, np.pi, np.pi)}
    alone = mi.load_dict({"type": "scene", "up": up, "sun": sun})
    both = mi.load_dict({"type": "scene", "up": up, "down": down, "sun": sun})
    means = [LightBaker(mi, scene, None).bake(32, 512, 0)[0, 0, 4:12, 4:12].mean() for scene in (alone, both)]
    assert means == pytest.approx([1.0, 0.5], abs=0.03)


def test_rough_metal_shows_what_its_lobe_sees_of_the_wall_without_grain(tmp_path: Path) -> None:
    metal = {"type": "dnr_principled", "base_color": rgb(0.9, 0.9, 0.9), "metallic": 1.0, "roughness": 0.8}
    wall = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(0.1, 0.8, 0.2)}}
    light = {"type": "point", "position": [0.0, 0.0, 1.5], "intensity": rgb(6, 6, 6)}
    scene = corner_room(tmp_path, {"type": "twosided", "b": metal}, wall, light)
    baked = LightBaker(mi, scene, onwards()).bake(64, 256, 0)
    channels, truth = rendered(scene, baked, camera(0.0), 8), traced(scene, camera(0.0))
    ours, floor = colour(channels), (channels["uv.U"] < 0.5) & (truth[..., 3] > 0.99)
    near = floor & (np.arange(SIZE)[:, None] < SIZE // 2 + 4)  # where the floor shows the wall
    assert near.sum() > 50
    # At this view the lobe sees more of the wall than in the mean over views.
    assert 0.75 * truth[near, 1].mean() < ours[near, 1].mean() < truth[near, 1].mean()
    assert baked[1, 0, 4:12, 4:12, 1].mean() > 3 * baked[1, 0, 4:12, 4:12, 0].mean()  # it is green
    rough = np.abs(np.diff(ours[..., 1], axis=1))[near[:, 1:] & near[:, :-1]].mean()
    assert rough < 0.06 * ours[near, 1].mean()


def test_a_lamp_behind_the_wall_shows_in_no_glossy_floor(tmp_path: Path) -> None:
    """Whether something is in between is asked for what counts alone: here all light comes from the lamp."""
    metal = {"type": "twosided", "b": {"type": "roughconductor", "alpha": 0.4}}
    wall = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(0.0, 0.0, 0.0)}}
    dark = np.zeros((2, 2, 4, 4, 3), np.float32)
    for where, shines in ((0.5, True), (1.5, False)):  # the wall stands at 1
        lamp = {"type": "point", "position": [0.0, where, 0.7], "intensity": rgb(3, 3, 3)}
        scene = corner_room(tmp_path, metal, wall, lamp)
        channels, truth = BaseRenderer(mi, scene, dark, gloss=False).frame(camera(0.0), 16), traced(scene, camera(0.0))
        floor = (channels["uv.U"] < 0.5) & (truth[..., 3] > 0.99)
        assert (truth[floor, 0].mean() > 0.1) == shines
        np.testing.assert_allclose(colour(channels)[floor, 0].mean(), truth[floor, 0].mean(), rtol=0.05, atol=1e-6)


@pytest.mark.parametrize("samples", [1, 2, 5, 8])
def test_a_faint_coat_is_followed_by_few_samples_and_as_bright(
    samples: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dnrpipe.raytrace import specular_paths  # imports Mitsuba

    floor = {"type": "plastic", "diffuse_reflectance": rgb(0.2, 0.2, 0.2)}
    wall = {"type": "diffuse", "reflectance": rgb(0.8, 0.8, 0.8)}
    floor, wall = ({"type": "twosided", "b": bsdf} for bsdf in (floor, wall))
    scene = corner_room(tmp_path, floor, wall, {"type": "constant"})
    light = np.ones((2, 2, 4, 4, 3), np.float32)

    def coat() -> np.ndarray:
        renderer, found = BaseRenderer(mi, scene, light), []
        for number in range(16):  # frames, whose samples complement one another
            channels = renderer.frame(camera(), samples, number, tiles=False, thin=True)
            found.append(channels["base.R"] - channels["diffuse.R"])
        return np.array(found)

    few = coat()
    monkeypatch.setattr(specular_paths, "FAINT", 0.0)
    every = coat()
    assert every.mean() > 0.01
    assert few.mean() == pytest.approx(every.mean(), rel=0.003)
    assert (samples > 1) == bool(np.abs(few - every).max() > 0.01)


@pytest.mark.parametrize(("opacity", "within"), [(1.0, 0.03), (0.4, 0.05)])
def test_brushed_metal_shows_coated_walls_as_bright_as_they_are(tmp_path: Path, opacity: float, within: float) -> None:
    """Behind its wide lobe the wall's coat counts as diffuse; where the wall lets light through, paths go on."""
    metal = {"type": "dnr_principled", "base_color": rgb(0.9, 0.9, 0.9), "metallic": 1.0, "roughness": 0.35}
    wall = {"type": "twosided", "b": {"type": "dnr_principled", "base_color": rgb(0.4, 0.1, 0.1), "roughness": 0.3}}
    if opacity < 1:
        wall = {"type": "mask", "opacity": opacity, "b": wall}
    sky = {"type": "constant", "radiance": rgb(1, 1, 1)}
    scene = corner_room(tmp_path, {"type": "twosided", "b": metal}, wall, sky)
    baked = LightBaker(mi, scene, onwards()).bake(64, 256, 0)
    renderer = BaseRenderer(mi, scene, baked, gloss=False)
    channels, truth = renderer.frame(camera(0.0), 32), traced(scene, camera(0.0))
    near = (channels["uv.V"] > 0.3) & (channels["uv.U"] < 0.5) & (truth[..., 3] > 0.99)
    assert near.sum() > 50
    ours, theirs = colour(channels)[near, :3].mean(axis=0), truth[near, :3].mean(axis=0)
    np.testing.assert_allclose(ours, theirs, rtol=within)
    assert theirs[0] > 1.1 * theirs[1]  # the red wall is what is seen


def test_planes_are_memory_that_may_be_written_to() -> None:
    """Two names of one array get a plane each."""
    first, second = mi.Float(np.arange(6, dtype=np.float32)), mi.Float(np.ones(6, np.float32))
    planes = planes_of([first, second, first], (2, 3))
    planes[0] += 1
    planes[1] *= 3
    np.testing.assert_array_equal(planes[2], [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(planes[0] - planes[2], np.ones((2, 3)))
    np.testing.assert_array_equal(planes[1], np.full((2, 3), 3))


def test_mirror_shows_the_baked_wall_and_says_where_its_path_ends(tmp_path: Path) -> None:
    mirror = {"type": "twosided", "b": {"type": "conductor", "material": "none"}}
    wall = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(0.1, 0.6, 0.2)}}
    light = {"type": "point", "position": [0.0, -0.5, 1.5], "intensity": rgb(6, 6, 6)}
    scene = corner_room(tmp_path, mirror, wall, light)
    baked = LightBaker(mi, scene, onwards()).bake(64, 128, 0)
    channels, truth = rendered(scene, baked, camera(0.0)), traced(scene, camera(0.0))
    inside = (truth[..., 3] > 0.99) & (truth[..., 1] > 0.02)
    error = colour(channels)[inside, :3] - truth[inside, :3]
    assert np.sqrt(np.mean(error**2)) < 0.1 * truth[inside, :3].mean()
    on_floor = (channels["chain.mask"] > 0) & (channels["base.A"] > 0.99)
    assert on_floor.sum() > 50
    # The mirrored wall's chart, at full throughput.
    assert (channels["chain.U"][on_floor] > 0.5).all() and (channels["chain.V"][on_floor] < 0.5).all()
    assert channels["chain.weight"][on_floor] == pytest.approx(1, abs=1e-3)
    assert np.abs(channels["diffuse.G"][on_floor]).max() < 0.05 * channels["base.G"][on_floor].max()


def test_what_guides_the_denoiser_lies_behind_mirrors_glass_and_holes(tmp_path: Path) -> None:
    mirror = {"type": "twosided", "b": {"type": "conductor", "specular_reflectance": rgb(0.9, 0.7, 0.5)}}
    checks = {"type": "checkerboard", "color0": rgb(0.1, 0.6, 0.2), "color1": rgb(0.8, 0.2, 0.7)}
    wall = {"type": "twosided", "b": {"type": "diffuse", "reflectance": checks}}
    metal = {"type": "twosided", "b": {"type": "roughconductor", "alpha": 0.4}}
    things = {
        "pane": quad(
            tmp_path / "p.ply",
            [[-0.9, -0.6, 0.4], [0.1, -0.6, 0.4], [0.1, -0.6, 1.2], [-0.9, -0.6, 1.2]],
            (0.8, 0.8),
            {"type": "thindielectric"},
        ),
        "block": {"type": "sphere", "center": [0.5, 0.4, 0.4], "radius": 0.3, "bsdf": metal},
        "hole": {"type": "sphere", "radius": 0.2, "bsdf": {"type": "mask", "opacity": 0.5, "bsdf": wall["b"]}},
    }
    scene = corner_room(tmp_path, mirror, wall, {"type": "constant"}, **things)
    found = rendered(scene, np.ones((2, 2, 8, 8, 3), np.float32), camera(0.2), 256)
    sensor = mi.load_dict(sensor_dict(mi, camera(0.2)))
    image = np.array(mi.render(scene, sensor=sensor, integrator=auxiliary_integrator(mi, scene), spp=512, seed=1))
    for i, name in enumerate((*SHOWN, *FACING)):
        truth = image[..., i - 6]
        assert truth.std() > 0.1
        assert np.abs(found[name] - truth).mean() < 0.02, name


def test_frames_repeat_bit_for_bit_and_views_share_one_kernel(tmp_path: Path) -> None:
    glossy = {"type": "twosided", "b": {"type": "roughconductor", "alpha": 0.2}}
    wall = {"type": "twosided", "b": {"type": "diffuse"}}
    scene = corner_room(tmp_path, glossy, wall, {"type": "constant"})
    renderer = BaseRenderer(mi, scene, np.ones((2, 2, 8, 8, 3), np.float32))
    first = renderer.frame(camera(0.3), 2)
    other = renderer.frame(camera(0.5), 2)
    recorded = renderer.kernel.n_recordings
    again = renderer.frame(camera(0.3), 2)
    renderer.frame(camera(0.7), 2)
    assert {*BASE_CHANNELS, "coverage"} <= set(first) == {*MEANS, *CENTRES, NOISE, "coverage", "rays"}
    assert all(np.isfinite(values).all() for values in first.values())
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert not np.array_equal(first["base.R"], other["base.R"])
    assert renderer.kernel.n_recordings == recorded <= 2


@pytest.mark.parametrize("kind", ["direct", "path"])
def test_base_images_of_few_samples_are_path_traced_and_denoised(
    tmp_path: Path, mitsuba_variant: str, kind: str
) -> None:
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><emitter type="constant"/><shape type="sphere"><bsdf type="diffuse"/></shape></scene>'
    )
    common = {"bundle": str(tmp_path / "scene.xml"), "variant": mitsuba_variant, "kind": kind, "samples": 2}
    worker = Worker(common | {"integrator": "path", "max_depth": 2, "spp": 16, "seed": 0})
    task = {"view": camera().model_dump(mode="json"), "output": str(tmp_path / "v.exr"), "fingerprint": "f"}
    answer = worker(task)
    channels, header = read_exr(tmp_path / "v.exr")
    assert (answer["kind"], answer["masked"]) == (header["kind"], header["masked"]) == (kind, 0)
    inside = channels["base.A"] > 0.99  # under an even sky, the ball is as bright as it reflects
    assert channels["base.G"][inside].mean() == pytest.approx(0.5, rel=0.03)
    assert channels["base.G"][inside].std() < 0.04
    with pytest.raises(ValueError, match="fingerprint"):
        worker({name: task[name] for name in ("view", "output")})


def test_a_denoised_base_image_has_less_error_and_keeps_its_own_beside_it(tmp_path: Path) -> None:
    metal = {"type": "twosided", "b": {"type": "roughconductor", "alpha": 0.5}}
    wall = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(0.1, 0.8, 0.2)}}
    light = {"type": "point", "position": [0.0, 0.0, 1.5], "intensity": rgb(6, 6, 6)}
    scene = corner_room(tmp_path, metal, wall, light)
    baked = LightBaker(mi, scene, onwards(), gloss=False).bake(64, 256, 0)
    renderer = BaseRenderer(mi, scene, baked, gloss=False)
    few, many = (renderer.frame(camera(0.0), samples) for samples in (2, 64))
    raw, clean = dict(few), without_grain({name: plane.copy() for name, plane in few.items()}, renderer)
    full = (few["coverage"] > 0.99) & (few["base.A"] > 0.99)
    assert full.sum() > 200

    def error(planes: dict[str, np.ndarray], name: str) -> float:
        return float(np.abs(planes[name] - many["base.G"])[full].mean())

    assert error(clean, "base.G") < 0.7 * error(raw, "base.G")
    np.testing.assert_allclose(clean["fresh.G"][full], raw["base.G"][full], rtol=0.02)
    # Baked light has no grain on the wall, so the denoiser leaves it alone.
    lit = full & (few["diffuse.G"] > 0.99 * few["base.G"]) & (few["albedo.G"] > 0.5)
    assert lit.sum() > 50 and not renderer.lets_through
    changed = {
        way: np.median(np.abs(planes["base.G"][lit] / few["base.G"][lit] - 1))
        for way, planes in (("the rest", clean), ("all", denoised(few)))
    }
    assert changed["the rest"] < 1e-4 < 1e-3 < changed["all"], changed
    assert (clean["fresh.rays"] == 2).all() and (clean["base.A"] == raw["coverage"]).all()
    write_exr(tmp_path / "base.exr", clean, {})
    assert set(FRESH_CHANNELS) <= set(read_exr(tmp_path / "base.exr")[0])


def test_frames_that_remember_are_the_same_when_a_sequence_is_taken_up_again(
    tmp_path: Path, mitsuba_variant: str
) -> None:
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><emitter type="constant"/><shape type="sphere"><bsdf type="roughconductor"/></shape>'
        "</scene>"
    )
    np.savez(tmp_path / "light.npz", light=np.zeros((2, 2, 8, 8, 3), np.float32), fingerprint="f")
    common = {"bundle": str(tmp_path / "scene.xml"), "variant": mitsuba_variant, "kind": "baked", "samples": 2}
    common |= {"light": str(tmp_path / "light.npz"), "denoise": False}
    ways = [camera(0.3 + 0.02 * number).model_dump(mode="json") for number in range(4)]

    def rendered_by(worker: Worker, number: int, earlier: bool = True, filtered: bool = False) -> dict[str, np.ndarray]:
        task = {"view": ways[number], "output": str(tmp_path / "v.exr"), "fingerprint": "f", "filtered": filtered}
        after = (ways[number + 1 :] or [None])[0]
        worker(task | {"earlier": ways[:number] if earlier else None, "after": after})
        return read_exr(tmp_path / "v.exr")[0]

    steady, resumed = Worker(common), Worker(common)
    frames = [rendered_by(steady, number) for number in range(4)]
    again = rendered_by(resumed, 3)
    assert all((frames[3][name] == again[name]).all() for name in again)
    inside = frames[3]["mask"] > 0.5
    assert (frames[0]["rays"][inside] == 2).all() and np.median(frames[3]["rays"][inside]) == 8
    alone = rendered_by(resumed, 3, earlier=False)
    assert (alone["rays"][inside] == 2).all() and not (alone["base.R"] == again["base.R"]).all()

    # Where the next chunk begins, no frame is rendered again, and it is as if it had been.
    way = [camera(0.3 + 0.02 * number) for number in range(CHUNK - WARM_UP - 2, CHUNK + 2)]
    rendered: list[View] = []
    steady, resumed = Worker(common), Worker(common)
    frame = steady.renderer.frame
    steady.renderer.frame = lambda view, *given, **more: (rendered.append(view), frame(view, *given, **more))[1]  # type: ignore[method-assign]
    for i in range(1, len(way)):
        first = 0 if i + CHUNK - WARM_UP - 2 < CHUNK else 2
        last = steady.remembered(way[i], way[first:i], CHUNK - WARM_UP - 2 + first)
    assert rendered == way
    again = resumed.remembered(way[-1], way[2:-1], CHUNK - WARM_UP)
    assert all((last[name] == again[name]).all() for name in again)

    steady, resumed = Worker(common), Worker(common)
    mean = [rendered_by(steady, number, filtered=True) for number in range(4)]
    again = rendered_by(resumed, 2, filtered=True)
    assert all((mean[2][name] == again[name]).all() for name in again)
    assert steady.renderer.kernel.n_recordings == 1 and set(again) == set(frames[2])
    changed = {name for name in again if not (again[name] == frames[2][name]).all()}
    assert changed == {"base.R", "base.G", "base.B"}, "between the frames next to it"
    deep = inside & np.roll(inside, 6, 0) & np.roll(inside, -6, 0) & np.roll(inside, 6, 1) & np.roll(inside, -6, 1)
    apart, before = (np.abs(way[2]["base.G"] - way[1]["base.G"])[deep].mean() for way in (mean, frames))
    assert apart < 0.7 * before


def test_scenes_without_emitters_are_dark(tmp_path: Path) -> None:
    metal = {"type": "roughconductor", "alpha": 0.2}
    scene = corner_room(tmp_path, {"type": "diffuse"}, metal, {"type": "sphere", "radius": 0.1})
    channels = rendered(scene, np.zeros((2, 2, 8, 8, 3), np.float32), camera())
    assert channels["base.G"].max() == 0 and channels["mask"].max() == 1


def test_lobes_of_the_principled_plugin_add_up() -> None:
    import drjit as dr

    bsdf = mi.load_dict({"type": "dnr_principled", "base_color": rgb(0.3, 0.5, 0.7), "roughness": 0.4, "metallic": 0.2})
    si = dr.zeros(mi.SurfaceInteraction3f, 64)
    si.wi = dr.normalize(mi.Vector3f(0.3, 0.1, 0.9)) + dr.zeros(mi.Vector3f, 64)
    u = mi.PCG32(64)
    wo = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u.next_float32(), u.next_float32()))
    glossy = mi.BSDFContext()
    glossy.type_mask = mi.BSDFFlags.Glossy
    both, parts = mi.BSDFContext(), [diffuse_context(mi), glossy]
    whole = np.array(bsdf.eval(both, si, wo))
    assert sum(np.array(bsdf.eval(part, si, wo)) for part in parts) == pytest.approx(whole, rel=1e-4)
    for part in parts:
        found, weight = bsdf.sample(part, si, u.next_float32(), mi.Point2f(u.next_float32(), u.next_float32()))
        value, density = bsdf.eval_pdf(part, si, found.wo)
        good = np.array(found.pdf) > 0
        assert np.array(density)[good] == pytest.approx(np.array(found.pdf)[good], rel=1e-3)
        ratio = np.array(value)[:, good] / np.array(density)[good]
        assert np.array(weight)[:, good] == pytest.approx(ratio, rel=1e-3)
    assert (np.array(found.sampled_type) == int(mi.BSDFFlags.GlossyReflection)).all()


def test_samples_lie_in_tiles_or_scattered() -> None:
    """On an even floor tiles repeat the same error every three pixels; scattered it does not come again."""
    metal = {"type": "twosided", "b": {"type": "roughconductor", "alpha": 0.5}}
    plain = mi.ScalarTransform4f().scale(50)
    moon = {"type": "sphere", "center": [0.0, 0.0, 60.0], "radius": 25.0}
    moon["emitter"] = {"type": "area", "radiance": rgb(3, 3, 3)}
    floor = {"type": "rectangle", "to_world": plain, "bsdf": metal}
    scene = mi.load_dict({"type": "scene", "floor": floor, "moon": moon})
    renderer = BaseRenderer(mi, scene, np.zeros((2, 2, 8, 8, 3), np.float32))
    truth, *few = (
        renderer.frame(camera(0.3), samples, tiles=tiles) for samples, tiles in ((512, True), (2, True), (2, False))
    )
    assert renderer.kernel.n_recordings == 2, "one for each number of rays"
    seen = truth["normal.Z"] > 0.99
    seen[:, 3:] &= seen[:, :-3]
    seen[:, :3] = False
    repeats, means = [], []
    for channels in few:
        error = channels["base.G"] - truth["base.G"]
        repeats.append(np.corrcoef(error[seen], np.roll(error, 3, axis=1)[seen])[0, 1])
        means.append(error[seen].mean() / truth["base.G"][seen].mean())
    assert repeats[0] > 0.9 and abs(repeats[1]) < 0.2, repeats
    assert np.abs(means).max() < 0.02, means


def remembering(renderer: BaseRenderer, views: list[View], samples: int, number: int = 0) -> dict[str, np.ndarray]:
    """Channels of the last of the frames, with what those before it saw. number: of the first."""
    history = History(mi)
    history.begin(number)
    for view in views:
        channels = history.take(view, renderer.frame(view, samples, history.number))
    return channels


def test_highlights_that_wander_and_mirrors_leave_no_ghosts(tmp_path: Path) -> None:
    """Frame 24 of an orbit around a glossy floor, a curved and a flat mirror: error by region against many rays."""
    glossy = {"type": "twosided", "b": {"type": "roughconductor", "alpha": 0.25}}
    mirror = {"type": "twosided", "b": {"type": "conductor", "material": "none"}}
    ball = {"type": "sphere", "center": [0.3, -0.2, 0.35], "radius": 0.35, "bsdf": dict(mirror)}
    lamp = {"type": "sphere", "center": [-0.6, -0.6, 1.6], "radius": 0.15}
    lamp["emitter"] = {"type": "area", "radiance": rgb(30, 24, 18)}  # type: ignore[assignment]
    scene = corner_room(tmp_path, glossy, mirror, {"type": "constant", "radiance": rgb(0.2, 0.3, 0.4)}, b=ball, l=lamp)
    dark = np.zeros((2, 2, 8, 8, 3), np.float32)
    way = [camera(0.3 + 0.02 * number) for number in range(24)]
    renderer = BaseRenderer(mi, scene, dark)
    truth, fresh, kept = renderer.frame(way[-1], 512), renderer.frame(way[-1], 2), remembering(renderer, way, 2)

    def error(channels: dict[str, np.ndarray]) -> np.ndarray:
        shown = [np.clip(colour(c), 0, 1) ** (1 / 2.2) for c in (channels, truth)]
        return ((shown[0] - shown[1])[..., :3] ** 2).mean(axis=-1)

    floor = (truth["normal.Z"] > 0.99) & (truth["mask"] > 0.5)
    wall = (truth["normal.Y"] < -0.99) & (truth["mask"] > 0.5)
    curved = (truth["mask"] > 0.5) & ~floor & ~wall
    for region in (floor, wall, curved, np.ones_like(floor)):
        assert region.sum() > 60
        lost = 10 * np.log10(error(kept)[region].mean() / error(fresh)[region].mean())
        assert lost < 0.2, "dB that remembering costs"
    assert np.median(kept["rays"][wall]) > 4, "a flat mirror is followed"


def test_a_chunk_of_a_sequence_begins_without_a_seam(tmp_path: Path) -> None:
    """From the last frame of a chunk to the first of the next the picture changes as from any frame to the next."""
    glossy = {"type": "twosided", "b": {"type": "roughconductor", "alpha": 0.25}}
    matt = {"type": "twosided", "b": {"type": "diffuse"}}
    lamp = {"type": "point", "position": [0.0, -0.5, 1.5], "intensity": rgb(6, 6, 6)}
    scene = corner_room(tmp_path, glossy, matt, lamp)
    renderer = BaseRenderer(mi, scene, np.ones((2, 2, 8, 8, 3), np.float32))
    way = [camera(0.3 + 0.01 * number) for number in range(2 * WARM_UP + 1)]
    before, onwards = (colour(remembering(renderer, frames, 4)) for frames in (way[:-1], way))
    begun = colour(remembering(renderer, way[WARM_UP:], 4, WARM_UP))
    within, across, alone = (
        np.abs(frame - before).mean() for frame in (onwards, begun, colour(renderer.frame(way[-1], 4)))
    )
    assert across < 1.05 * within < 0.9 * alone, "what a frame that remembers nothing changes by"
    assert np.abs(begun - onwards).mean() < 0.2 * within

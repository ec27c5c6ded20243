"""G-buffers, coverage and rasterised colour, against Mitsuba and against the contract."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dnrpipe.blender.passes import choice
from dnrpipe.errors import UserError
from dnrpipe.executors import Retry, TaskResult, run_tasks
from dnrtrain.contract import GBUFFER_CHANNELS, RASTER_CHANNELS, View
from dnrtrain.exr import read_exr

pytest.importorskip("bpy")
FOLDER = Path(__file__).parent
SIZE = 96


def look_at(target: np.ndarray, distance: float, azimuth: float, elevation: float, **changes: Any) -> View:
    """A camera on a sphere about ``target``; angles in degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    z = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    x = np.cross([0, 0, 1], z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    matrix[:3, 3] = target + distance * z
    intrinsics: dict[str, Any] = {
        "width": SIZE,
        "height": SIZE,
        "fl_x": 1.1 * SIZE,
        "fl_y": 1.1 * SIZE,
        "cx": SIZE / 2,
        "cy": SIZE / 2,
    }
    return View(name="view", c2w=tuple(map(tuple, matrix.tolist())), **(intrinsics | changes))


def render(scene_dir: Path, folder: Path, views: list[View], raster: str | None = None, **common: Any) -> list[Any]:
    """Results of the worker for each view; pictures at ``folder``/<i>.exr."""
    settings = {"scene_dir": str(scene_dir), "raster_engine": raster or "cycles-direct", "raster_samples": 4}
    settings |= {"coverage_samples": 16} | common
    tasks = [
        {"view": v.model_dump(mode="json"), "output": str(folder / f"{i}.exr"), "raster": bool(raster)}
        | {"fingerprint": f"f{i}"}
        for i, v in enumerate(views)
    ]
    module, log = "dnrpipe.blender.passes.worker", folder / "log.txt"
    results = []
    for outcome in run_tasks(module, settings, tasks, workers=1, log=log, timeout=200):
        assert not isinstance(outcome, Retry), (outcome.reason, log.read_text()[-2000:])
        assert outcome.error is None, outcome.error
        results.append(outcome.result)
    return results


def prepared(source: Path, folder: Path) -> Path:
    command = [sys.executable, str(FOLDER / "blender_scene.py"), "freeze", str(source), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def scene_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("passes")
    command = [sys.executable, str(FOLDER / "blender_scene.py"), "build", str(folder / "test.blend")]
    subprocess.run(command, capture_output=True, timeout=300, check=True)
    return prepared(folder / "test.blend", folder)


def vector(channels: dict[str, np.ndarray], prefix: str, axes: str) -> np.ndarray:
    return np.stack([channels[f"{prefix}.{axis}"] for axis in axes], axis=-1)


def compare_with_mitsuba(scene_dir: Path, folder: Path, view: View) -> dict[str, np.ndarray]:
    """Assert pixel-exact agreement at pixel centres; return the channels."""
    pytest.importorskip("mitsuba")
    render(scene_dir, folder, [view])
    channels, _ = read_exr(folder / "0.exr")
    (folder / "view.json").write_text(view.model_dump_json())
    script = str(FOLDER / "mitsuba_gbuffer.py")
    paths = [str(scene_dir / "geometry.npz"), str(folder / "view.json"), str(folder / "mitsuba.npz")]
    subprocess.run([sys.executable, script, *paths], check=True, timeout=300)
    theirs = dict(np.load(folder / "mitsuba.npz"))
    ours, other = channels["mask"] > 0, theirs["mask"] > 0
    assert (ours & other).sum() / (ours | other).sum() >= 0.999
    both = ours & other
    # At depth edges a centre may fall on either side of an edge in float32; nowhere else.
    depth = np.abs(channels["depth.Z"] - theirs["depth"]) / theirs["depth"].max()
    same = both & (depth <= 1e-4)
    assert same.sum() >= 0.999 * both.sum()
    assert np.abs(vector(channels, "uv", "UV") - theirs["uv"])[same].max(-1).max() <= 1e-4
    assert np.abs(vector(channels, "position", "XYZ") - theirs["position"])[same].max() <= 1e-3
    # Cycles' normal faces the camera with the geometric one; Mitsuba's keeps the mesh's side.
    towards = -view.ray_directions()
    facing = np.sign((theirs["geometric"] * towards).sum(-1, keepdims=True))
    cosine = (vector(channels, "normal", "XYZ") * theirs["normal"] * facing).sum(-1)[same]
    assert np.degrees(np.arccos(np.clip(np.quantile(cosine, 0.01), -1, 1))) < 0.1
    assert cosine.min() > 0.99
    return channels


@pytest.mark.slow
@pytest.mark.parametrize(("azimuth", "elevation"), [(20, 30), (200, -25)])
def test_gbuffer_agrees_with_mitsuba(scene_dir: Path, tmp_path: Path, azimuth: float, elevation: float) -> None:
    view = look_at(np.array([0, 0, 0.5]), 6, azimuth, elevation, cx=0.45 * SIZE, cy=0.6 * SIZE)
    channels = compare_with_mitsuba(scene_dir, tmp_path, view)
    assert len(np.unique(channels["object.Id"])) >= 5


@pytest.mark.slow
def test_gbuffer_of_an_imported_mesh_agrees_with_mitsuba(shared_assets: Path, tmp_path: Path) -> None:
    folder = prepared(shared_assets / "spot" / "spot.obj", tmp_path)
    compare_with_mitsuba(folder, tmp_path, look_at(np.zeros(3), 3.5, 40, 20))


@pytest.mark.slow
def test_channels_keep_the_contract(scene_dir: Path, tmp_path: Path) -> None:
    """Every intrinsic in one view: off-centre, wide, non-square pixels. Positions project to pixel centres."""
    wide = {"width": 80, "height": 60, "fl_x": 50.0, "fl_y": 65.0, "cx": 30.0, "cy": 33.0}
    tele = {"width": 50, "height": 70, "fl_x": 120.0, "fl_y": 90.0, "cx": 27.0, "cy": 31.5}
    ultra = {"width": 64, "height": 64, "fl_x": 1.2, "fl_y": 1.2, "cx": 32.0, "cy": 32.0}
    target = np.array([0, 0, 0.5])
    views = [look_at(target, 5, 30, 35, **wide), look_at(target, 7, 120, 10, **tele)]
    views.append(look_at(target, 3, 250, 50, **ultra))
    results = render(scene_dir, tmp_path, views)
    for i, view in enumerate(views):
        channels, metadata = read_exr(tmp_path / f"{i}.exr")
        assert set(channels) == set(GBUFFER_CHANNELS)
        assert metadata["fingerprint"] == f"f{i}"
        assert metadata["repaired"] == results[i]["repaired"] == 0
        mask = channels["mask"] > 0
        assert mask.any()
        world = vector(channels, "position", "XYZ")[mask].astype(np.float64)
        camera = (world - view.position) @ view.matrix[:3, :3]
        assert np.abs(camera[:, 2] + channels["depth.Z"][mask]).max() < 1e-4
        x = view.cx + view.fl_x * camera[:, 0] / -camera[:, 2]
        y = view.cy - view.fl_y * camera[:, 1] / -camera[:, 2]
        rows, columns = np.nonzero(mask)
        assert np.abs(x - columns - 0.5).max() < 5e-3, i
        assert np.abs(y - rows - 0.5).max() < 5e-3, i
        assert np.allclose(np.linalg.norm(vector(channels, "normal", "XYZ")[mask], axis=-1), 1, atol=1e-5)
        for name in GBUFFER_CHANNELS:
            if name != "coverage":
                assert (channels[name][~mask] == 0).all(), name
        assert channels["uv.U"].max() < 1
        assert (channels["object.Id"] == channels["object.Id"].round()).all()


@pytest.mark.slow
def test_coverage_is_box_filtered(scene_dir: Path, tmp_path: Path) -> None:
    fine = 8
    view = look_at(np.array([0, 0, 0.5]), 6, 70, 25)
    big = look_at(np.array([0, 0, 0.5]), 6, 70, 25, width=SIZE * fine, height=SIZE * fine, cx=SIZE * fine / 2)
    big = big.model_copy(update={"cy": SIZE * fine / 2, "fl_x": view.fl_x * fine, "fl_y": view.fl_y * fine})
    render(scene_dir, tmp_path, [view, big], coverage_samples=64)
    coverage = read_exr(tmp_path / "0.exr")[0]["coverage"]
    mask = read_exr(tmp_path / "1.exr")[0]["mask"].reshape(SIZE, fine, SIZE, fine).mean((1, 3))
    edge = (mask > 0) & (mask < 1)
    assert edge.sum() > 50
    assert np.sqrt(((coverage - mask)[edge] ** 2).mean()) < 1.5 / 64 + 1 / 64
    assert np.abs(coverage - mask).max() < 0.12
    assert abs((coverage - mask).mean()) < 1e-3
    assert (coverage[~edge] == mask[~edge]).mean() > 0.999


@pytest.mark.slow
def test_views_from_inside_and_of_nothing(scene_dir: Path, tmp_path: Path) -> None:
    nothing = look_at(np.array([0, 0, 0.5]), 6, 0, 0)
    away = np.diag([1.0, -1.0, -1.0, 1.0])
    turned = nothing.model_copy(update={"c2w": tuple(map(tuple, (nothing.matrix @ away).tolist()))})
    inside = look_at(np.array([0.6, -0.4, 0.6]), 0.05, 0, 10)  # within the closed cube
    render(scene_dir, tmp_path, [turned, inside], raster="cycles-direct")
    channels, _ = read_exr(tmp_path / "0.exr")
    assert set(channels) == {*GBUFFER_CHANNELS, *RASTER_CHANNELS}
    assert all((values == 0).all() for values in channels.values())
    channels, _ = read_exr(tmp_path / "1.exr")
    assert (channels["mask"] == 1).all()
    towards = -inside.ray_directions()
    assert ((vector(channels, "normal", "XYZ") * towards).sum(-1) > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["eevee", "workbench", "cycles-direct"])
def test_raster_colour_lies_on_the_gbuffer(scene_dir: Path, tmp_path: Path, engine: str) -> None:
    if engine != "cycles-direct":
        trial = choice.try_engine(engine)
        if not trial["ok"]:
            pytest.skip(f"{engine} does not run here: {trial['reason']}")
    view = look_at(np.array([0, 0, 0.5]), 6, -60, 35)
    (result,) = render(scene_dir, tmp_path, [view], raster=engine, raster_samples=8)
    channels, metadata = read_exr(tmp_path / "0.exr")
    assert metadata["raster_engine"] == engine
    assert result["raster_seconds"] > 0
    # The border, stamp and marker camera of the file would all break this.
    mask = channels["mask"] > 0
    alpha = channels["A"] > 0.5
    assert (mask & alpha).sum() / (mask | alpha).sum() > 0.98
    colour = vector({f"c.{k}": channels[k] for k in "RGB"}, "c", "RGB")
    assert colour[mask].mean() > 0.01
    assert (colour[~mask & (channels["coverage"] == 0) & (channels["A"] == 0)] == 0).all()
    lit = mask & (channels["A"] > 0.99)
    names = {m.object_name: m.object_id for m in _meshes(scene_dir)}
    sphere = lit & (channels["object.Id"] == names["sphere"])
    red, green, _ = colour[sphere].mean(0)
    assert red > 2 * green  # its material is red


def _meshes(scene_dir: Path) -> list[Any]:
    from dnrpipe.blender.geometry.frozen import load_geometry

    return load_geometry(scene_dir / "geometry.npz")


@pytest.mark.slow
def test_workspace_is_portable(scene_dir: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    moved.mkdir()
    shutil.copy(scene_dir / "source.blend", moved)
    render(moved, tmp_path, [look_at(np.zeros(3), 6, 0, 30)])
    assert (read_exr(tmp_path / "0.exr")[0]["mask"] > 0).any()


def test_choice_falls_back_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    dead = {"ok": False, "reason": "its trial was killed by SIGABRT"}
    monkeypatch.setattr(choice, "try_engine", lambda engine: dead)
    engine, reason = choice.choose_raster("auto")
    assert engine == "cycles-direct"
    assert "SIGABRT" in reason
    with pytest.raises(UserError, match=r"eevee.*SIGABRT"):
        choice.choose_raster("eevee")
    slow = {"ok": True, "seconds_first": 20.0, "seconds_next": 9.0}
    monkeypatch.setattr(choice, "try_engine", lambda engine: slow)
    assert choice.choose_raster("auto") == ("cycles-direct", "EEVEE takes 9.0 s per 256x256 frame here")
    assert choice.choose_raster("eevee") == ("eevee", "requested")
    with pytest.raises(UserError, match="unknown raster engine"):
        choice.choose_raster("renderman")


def test_a_dead_trial_is_survived(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without EGL Blender aborts the trial process, not this one."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", "/nonexistent")
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")
    trial = choice.try_engine.__wrapped__("workbench")
    assert not trial["ok"]
    assert json.dumps(trial["reason"])


@pytest.mark.slow
def test_a_renderer_that_dies_is_named(scene_dir: Path, tmp_path: Path) -> None:
    settings = {"scene_dir": str(scene_dir), "raster_engine": "eevee", "raster_samples": 1, "coverage_samples": 1}
    view = look_at(np.zeros(3), 6, 0, 30).model_dump(mode="json")
    task = {"view": view, "output": str(tmp_path / "0.exr"), "raster": True, "fingerprint": "f"}
    no_egl = {"__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent", "__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"}
    module, log = "dnrpipe.blender.passes.worker", tmp_path / "log.txt"
    outcomes = list(run_tasks(module, settings, [task], workers=1, log=log, timeout=200, environment=no_egl))
    last = outcomes[-1]
    assert isinstance(last, TaskResult)
    assert last.error == "the raster renderer was killed by SIGABRT"
    assert not (tmp_path / "0.exr").exists()

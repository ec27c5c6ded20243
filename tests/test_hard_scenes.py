"""The six hard scenes go through conversion, ray tracing and G-buffers, and look as Cycles renders them."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from dnrpipe.blender.reading.opening import open_scene  # noqa: E402
from dnrpipe.core.cameras import make_cameras  # noqa: E402
from dnrpipe.core.images import read_rgba  # noqa: E402
from dnrpipe.core.scene_files import read_census, read_summary  # noqa: E402
from dnrpipe.core.settings import CameraSettings  # noqa: E402
from dnrpipe.raytrace.variants import choose_variant  # noqa: E402
from dnrpipe.workers.task_list import TaskResult, run_tasks  # noqa: E402
from dnrtrain.contract import GBUFFER_CHANNELS, View  # noqa: E402
from dnrtrain.exr import read_exr  # noqa: E402

FOLDER = Path(__file__).resolve().parent.parent / "blender_scenes"
HARD = FOLDER / "hard"
SIZE, SPP, CYCLES_SPP, DEPTH = 64, 128, 64, 24
SCALES = {"tiny_scale": 1e-4, "huge_scale": 2e4}
# Relative difference of the mean radiance (cut at 4, where a bulb's own pixels would decide) from Cycles'.
TOLERANCES = {
    "all_glass": 0.03,
    "all_mirror": 0.02,
    "emissive_only": 0.05,
    "volume": 0.08,
    "tiny_scale": 0.06,
    "huge_scale": 0.06,
}


@dataclass
class Traced:
    """One scene after `prepare` and one ray-traced view of its own camera."""

    folder: Path
    view: View
    image: np.ndarray
    numbers: dict[str, Any]


def outcomes(module: str, common: dict[str, Any], tasks: list[dict[str, Any]], log: Path, **options: Any) -> list[Any]:
    """Results of a worker's tasks; any failure fails the test."""
    done = [o for o in run_tasks(module, common, tasks, workers=1, log=log, **options) if isinstance(o, TaskResult)]
    assert all(o.result for o in done), [o.error for o in done]
    return [o.result for o in done]


@pytest.fixture(scope="module")
def traced(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Traced]:
    """All hard scenes, and the still life in units of 1."""
    root = tmp_path_factory.mktemp("hard")
    unit, log = root / "unit.blend", root / "log.txt"
    command = [sys.executable, str(FOLDER / "build_hard.py"), "--still-life", "1", str(unit)]
    subprocess.run(command, check=True, timeout=120, capture_output=True)
    sources = {name: HARD / f"{name}.blend" for name in TOLERANCES} | {"unit": unit}
    tasks = [{"source": str(path), "scene_dir": str(root / name)} for name, path in sources.items()]
    outcomes("dnrpipe.blender.prepare", {}, tasks, log)
    choice = choose_variant()
    found = {}
    for name in sources:
        folder = root / name
        settings = CameraSettings(source="scene", train=1, val=0, test=0, width=SIZE, height=SIZE)
        (view,) = make_cameras(read_summary(folder), settings)["train"]
        task = {"view": view.model_dump(mode="json"), "output": str(folder / "traced.exr"), "fingerprint": "f"}
        task |= {"spp": SPP, "max_depth": DEPTH, "seed": 5, "integrator": "volpath" if name == "volume" else "path"}
        common = {"bundle": str(folder / "scene.xml"), "variant": choice.variant, "threads": 1}
        (numbers,) = outcomes("dnrpipe.raytrace.tracer", common, [task], log, environment=choice.environment)
        found[name] = Traced(folder, view, read_rgba(folder / "traced.exr"), numbers)
    return found


def cycles_picture(source: Path, folder: Path) -> np.ndarray:
    """The file's own camera rendered by Cycles, linear premultiplied RGBA [SIZE, SIZE, 4], top row first."""
    open_scene(source)
    scene = bpy.context.scene
    render, cycles = scene.render, scene.cycles
    render.resolution_x = render.resolution_y = SIZE
    render.threads_mode, render.threads = "FIXED", 1
    cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = CYCLES_SPP, False, False
    cycles.pixel_filter_type, cycles.blur_glossy, cycles.sample_clamp_indirect = "BOX", 0.0, 0.0
    for limit in ("max", "diffuse", "glossy", "transmission", "volume", "transparent_max"):
        setattr(cycles, f"{limit}_bounces", DEPTH)
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    render.filepath = str(folder / "cycles.exr")
    bpy.ops.render.render(write_still=True)
    picture = bpy.data.images.load(render.filepath)
    return np.array(picture.pixels[:], np.float32).reshape(SIZE, SIZE, 4)[::-1]


def test_files_are_small_self_contained_and_complete() -> None:
    assert {path.stem for path in HARD.glob("*.blend")} == set(TOLERANCES)
    for name in TOLERANCES:
        path = HARD / f"{name}.blend"
        assert path.stat().st_size < 100_000
        assert open_scene(path) == []
        assert all(image.packed_file for image in bpy.data.images if image.users)
        assert bpy.context.scene.camera is not None
        assert all(mesh.uv_layers for mesh in bpy.data.meshes if mesh.users)


@pytest.mark.parametrize("name", TOLERANCES)
def test_the_ray_traced_view_is_sound(name: str, traced: dict[str, Traced]) -> None:
    """Finite without repairs, as much of it covered, and as bright, as Cycles says."""
    ours = traced[name]
    assert np.isfinite(ours.image).all()
    assert ours.numbers["repaired"] == ours.numbers["masked"] == 0
    reference = cycles_picture(HARD / f"{name}.blend", ours.folder)
    assert np.abs(ours.image[..., 3] - reference[..., 3]).mean() < 0.01
    level, wanted = (np.minimum(picture[..., :3], 4.0).mean() for picture in (ours.image, reference))
    assert wanted > 0.02
    assert level == pytest.approx(wanted, rel=TOLERANCES[name])


def test_volumes_change_the_picture_and_need_volpath(traced: dict[str, Traced]) -> None:
    """Tea is brown because light is absorbed on its way, not at its surface."""
    assert traced["volume"].numbers["integrator"] == "volpath"
    bundle = (traced["volume"].folder / "scene.xml").read_text()
    assert bundle.count('<medium type="homogeneous"') == 3
    reference = cycles_picture(HARD / "volume.blend", traced["volume"].folder)
    for picture in (reference, traced["volume"].image):
        tea = picture[30:38, 19:24, :3].mean(axis=(0, 1))
        assert tea[0] > 1.5 * tea[2]


@pytest.mark.parametrize("name", SCALES)
def test_scale_does_not_matter(name: str, traced: dict[str, Traced]) -> None:
    """The still life at 1e-4 and 2e4 units is the one at 1 unit, sample for sample but for rare rounding."""
    ours, unit = traced[name].image, traced["unit"].image
    difference = np.abs(ours - unit).max(axis=-1)
    assert np.median(difference) < 1e-4
    assert np.quantile(difference, 0.99) < 0.02
    assert ours[..., :3].mean() == pytest.approx(unit[..., :3].mean(), rel=2e-3)


def test_gbuffers_are_finite_and_scale_with_the_scene(traced: dict[str, Traced]) -> None:
    pictures = {}
    for name in ("unit", "tiny_scale", "huge_scale", "volume"):
        ours = traced[name]
        common = {"scene_dir": str(ours.folder), "raster_engine": "cycles-direct", "raster_samples": 1}
        common |= {"coverage_samples": 4, "threads": 1}
        task = {"view": ours.view.model_dump(mode="json"), "output": str(ours.folder / "passes.exr")}
        task |= {"raster": False, "fingerprint": "f"}
        (numbers,) = outcomes("dnrpipe.blender.passes.worker", common, [task], ours.folder / "log.txt")
        assert numbers["repaired"] == 0
        channels, _ = read_exr(ours.folder / "passes.exr")
        assert set(GBUFFER_CHANNELS) <= set(channels)
        assert all(np.isfinite(values).all() for values in channels.values())
        assert 0.2 < channels["mask"].mean() < 0.6
        assert np.abs(channels["coverage"] - ours.image[..., 3]).mean() < 0.02 or name == "volume"
        pictures[name] = channels
    for name, scale in SCALES.items():
        both = (pictures[name]["mask"] > 0) & (pictures["unit"]["mask"] > 0)
        assert both.sum() >= pictures["unit"]["mask"].sum() - 3
        for channel, factor in (("depth.Z", scale), ("position.Z", scale), ("normal.Z", 1.0), ("object.Id", 1.0)):
            ours, unit = pictures[name][channel][both] / factor, pictures["unit"][channel][both]
            # Pixels at an edge may fall on either side of it.
            assert np.quantile(np.abs(ours - unit), 0.99) < 1e-3, (name, channel)


def test_builder_makes_the_committed_files(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, str(FOLDER / "build_hard.py"), str(tmp_path)], check=True, timeout=120, capture_output=True
    )

    def contents(path: Path) -> dict[str, Any]:
        open_scene(path)
        return {o.name: (o.type, [tuple(round(x, 9) for x in row) for row in o.matrix_world]) for o in bpy.data.objects}

    for name in TOLERANCES:
        assert contents(tmp_path / f"{name}.blend") == contents(HARD / f"{name}.blend")


def test_census_of_a_hard_scene_names_what_it_holds(traced: dict[str, Traced]) -> None:
    assert read_census(traced["all_glass"].folder).transmission
    findings = read_census(traced["all_mirror"].folder).findings
    assert not [f for f in findings if f.kind in ("ignored", "missing")]

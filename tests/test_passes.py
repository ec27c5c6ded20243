"""Passes of samples by the Mitsuba worker: the same picture as frames, unbiased noise, resumable to the bit."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.scene_records import sphere_summary

from dnrpipe.core.cameras import make_cameras
from dnrpipe.core.images import read_rgba
from dnrpipe.core.settings import CameraSettings
from dnrpipe.raytrace.grouped import launch_sizes
from dnrpipe.raytrace.pictures import repair
from dnrpipe.raytrace.samples import read_samples
from dnrpipe.raytrace.variants import choose_variant
from dnrpipe.workers.task_list import TaskResult, run_tasks
from dnrtrain.exr import read_exr

SUMMARY = sphere_summary((0.0, 0.0, 0.0), 1.2)
BUNDLE = """<scene version="3.0.0">
  <integrator type="path"/>
  <emitter type="constant"/>
  <shape type="sphere">
    <transform name="to_world"><scale value="0.7"/><translate z="0.3"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.2, 0.1"/></bsdf>
  </shape>
  <shape type="rectangle"><bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
</scene>"""
SIDE = 24


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scene.xml").write_text(BUNDLE)
    return tmp_path


def _task(folder: Path, name: str, **changes) -> dict:
    settings = CameraSettings(train=1, val=0, test=0, width=SIDE, height=SIDE)
    view = make_cameras(SUMMARY, settings)["train"][0]
    task = {
        "view": view.model_dump(mode="json"),
        "output": str(folder / f"{name}.exr"),
        "samples": str(folder / "samples" / f"{name}.npz"),
        "samples_fingerprint": "s",
        "max_depth": 4,
        "seed": 3,
        "fingerprint": "f",
        "goal": {"noise_target": 0.02, "ended_by": "target"},
        "add": 24,
    }
    return task | changes


def _run(folder: Path, tasks: list[dict], module: str = "pass_worker") -> list[dict]:
    choice = choose_variant()
    common = {"bundle": str(folder / "scene.xml"), "variant": choice.variant, "threads": 1}
    outcomes = run_tasks(
        f"dnrpipe.raytrace.{module}", common, tasks, workers=1, log=folder / "log", environment=choice.environment
    )
    results = [o for o in outcomes if isinstance(o, TaskResult)]
    assert all(o.result for o in results), [o.error for o in results]
    return [o.result for o in results if o.result]


def test_passes_cut_by_a_restart_equal_passes_in_one_go(folder: Path) -> None:
    """The same bits; seconds and passes add up; the file says what it is."""
    _run(folder, [_task(folder, "a"), _task(folder, "a", add=40), _task(folder, "a", add=0)])
    _run(folder, [_task(folder, "b")])
    first, last = _run(folder, [_task(folder, "b", add=40), _task(folder, "b", add=0)])
    assert np.array_equal(read_rgba(folder / "a.exr"), read_rgba(folder / "b.exr"))
    assert first["spp"] == last["spp"] == 64
    _, metadata = read_exr(folder / "b.exr")
    assert (metadata["spp"], metadata["passes"], metadata["ended_by"]) == (64, 2, "target")
    assert metadata["noise"] == metadata["raw_noise"] == pytest.approx(first["noise"])
    assert 0 < metadata["noise_error"] < metadata["noise"]
    assert metadata["seconds"] >= last["seconds"] > 0
    (again,) = _run(folder, [_task(folder, "b", add=0)])
    assert again["earlier_seconds"] == pytest.approx(last["seconds"])  # the ledger gets every second once


def test_a_lost_sample_file_is_said(folder: Path) -> None:
    choice = choose_variant()
    common = {"bundle": str(folder / "scene.xml"), "variant": choice.variant, "threads": 1}
    outcomes = run_tasks(
        "dnrpipe.raytrace.pass_worker",
        common,
        [_task(folder, "a", add=0)],
        workers=1,
        log=folder / "log",
        environment=choice.environment,
    )
    (result,) = [o for o in outcomes if isinstance(o, TaskResult)]
    assert "gone or damaged; run the same command" in (result.error or "")
    assert not (folder / "a.exr").exists()


def test_the_noise_of_a_rendered_view_is_estimated_without_bias(folder: Path) -> None:
    """t-test over seeds: mean squares estimated from the passes against those measured with a long reference.

    Off-centre, with pixels that are not square, and with a lens as well: the pictures agree with frames.
    """
    plain = [_task(folder, f"{seed}", seed=seed, add=40) for seed in range(16)]
    shifted = _task(folder, "shifted", add=1200)
    shifted["view"] = {**shifted["view"], "fl_y": 30.0, "cx": 8.0, "cy": 13.5}
    lens = {"aperture_radius": 0.08, "focus_distance": 3.0}
    pictures = {"0": {}, "shifted": {"view": shifted["view"]}, "lens": {"view": shifted["view"], "lens": lens}}
    added = [shifted, {**shifted, **_named(folder, "lens"), "lens": lens}]
    written = [{**task, "add": 0} for task in [*plain, *added]]
    results = _run(folder, [*plain, *added, *written])
    references = [
        {**_task(folder, f"long-{name}", seed=999, spp=8192), **changes} for name, changes in pictures.items()
    ]
    _run(folder, references, "tracer")
    from dnrpipe.raytrace.statistics import display

    truth = display(read_rgba(folder / "long-0.exr"))
    level = np.sqrt(np.mean(truth**2))
    estimated = np.array([result["noise"] ** 2 for result in results[:16]])
    squares = [np.mean((display(read_rgba(folder / f"{seed}.exr")) - truth) ** 2) for seed in range(16)]
    true = np.array(squares) / level**2
    difference = estimated - true
    assert abs(difference.mean()) < 3.5 * difference.std(ddof=1) / 4
    assert estimated.mean() == pytest.approx(true.mean(), rel=0.08)
    for name in ("shifted", "lens"):
        error = display(read_rgba(folder / f"{name}.exr")) - display(read_rgba(folder / f"long-{name}.exr"))
        noise = read_exr(folder / f"{name}.exr")[1]["noise_rmse"]
        assert np.sqrt(np.mean(error**2)) < 1.3 * noise


def _named(folder: Path, name: str) -> dict[str, str]:
    return {"output": str(folder / f"{name}.exr"), "samples": str(folder / "samples" / f"{name}.npz")}


def test_denoised_views_say_both_noises(folder: Path) -> None:
    smooth = _task(folder, "a", add=72, denoise=True, rehearse=True)
    first, last = _run(folder, [smooth, {**smooth, "add": 0}])
    assert first["finish_seconds"] > 0
    assert last["noise"] < last["raw_noise"] == pytest.approx(first["noise"])
    assert {"denoised_error", "denoiser_bias"} <= last.keys()
    assert "raw.R" in read_exr(folder / "a.exr")[0]
    assert read_samples(Path(smooth["samples"]), "s", SIDE, SIDE).facts.booked_seconds > 0


def test_non_finite_pixels_are_traced_again_and_what_stays_is_zero() -> None:
    images = [np.ones((4, 4, 3)), np.ones((4, 4, 3))]
    images[0][1, 1, 0], images[1][2, 2], images[1][3, 3] = np.nan, np.inf, np.nan
    asked = []

    def again(attempt: int, index: int) -> np.ndarray:
        asked.append((attempt, index))
        other = np.full((4, 4, 3), 5.0)
        other[3, 3] = np.nan
        return other

    assert repair(images, again) == (2, 1)
    assert images[0][1, 1].tolist() == images[1][2, 2].tolist() == [5.0] * 3
    assert images[1][3, 3].tolist() == [0.0] * 3
    assert images[0][0, 0, 0] == 1
    assert asked == [(0, 0), (0, 1), (1, 1), (2, 1)]


@pytest.mark.parametrize(("samples", "largest"), [(1, 1), (5, 5), (7, 3), (64, 30), (100, 1)])
def test_launches_are_few_and_even(samples: int, largest: int) -> None:
    sizes = launch_sizes(samples, largest)
    assert sum(sizes) == samples
    assert max(sizes) <= largest
    assert max(sizes) - min(sizes) <= 1
    assert len(sizes) == -(-samples // largest)


def test_planning_a_target_needs_no_mitsuba() -> None:
    code = "import sys, dnrpipe.stages.raytrace; sys.exit('mitsuba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

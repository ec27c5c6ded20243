"""The frame benchmark's arithmetic: the rival's frontier and crossover, reprojection by known motion, flicker."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.scene_records import sphere_summary
from tools.bench_frames import moving_tables
from tools.bench_frames.equal_time import at_equal_time, break_even, lines, upfront
from tools.bench_frames.motion import Surface, changes, flicker, project, reproject
from tools.bench_frames.standing import classes, standing

from dnrpipe.core.cameras import orbit_views
from dnrpipe.core.ledger import CostRecord
from dnrpipe.core.settings import CameraSettings
from dnrpipe.studies.frames.pareto_front import crossover, frontier, quality_at
from dnrtrain.contract import View

LADDER = {"1": (10.0, 20.0), "1 dear": (30.0, 19.0), "4": (40.0, 26.0), "16": (160.0, 30.0), "dull": (200.0, 30.0)}
LINE = [(10.0, 20.0), (40.0, 26.0), (160.0, 30.0)]
SUMMARY = sphere_summary((0.0, 0.0, 0.0), 1.0)


def test_the_frontier_leaves_out_what_is_dearer_and_no_better() -> None:
    assert frontier(LADDER) == ["1", "4", "16"]
    assert frontier({}) == []
    assert frontier({"a": (5.0, 20.0), "b": (5.0, 21.0)}) == ["b"]


def test_quality_is_linear_in_log_time_between_points() -> None:
    assert quality_at(LINE, 20.0) == pytest.approx(23.0)  # half way between 10 and 40 ms
    assert quality_at(LINE, 40.0) == pytest.approx(26.0)
    assert quality_at(LINE, 9.9) is None
    assert quality_at(LINE, 1000.0) == 30.0


def test_the_crossover_is_where_the_rival_draws_level() -> None:
    assert crossover(LINE, 23.0) == pytest.approx(20.0)
    assert crossover(LINE, 12.0) == 10.0
    assert crossover(LINE, 30.1) is None
    assert crossover([], 1.0) is None


@given(st.floats(20.0, 30.0))
def test_the_crossover_inverts_the_interpolation(quality: float) -> None:
    at = crossover(LINE, quality)
    assert at is not None
    assert quality_at(LINE, at) == pytest.approx(quality, abs=1e-6)


def test_standing_says_how_far_ahead_and_until_when() -> None:
    found = standing(LADDER, (20.0, 28.0))
    assert found["lead_db"] == pytest.approx(5.0)
    assert not found["cheapest"]
    assert found["crossover_ms"] == pytest.approx(80.0)
    faster = standing(LADDER, (2.0, 25.0))  # nothing of the rival's is so fast: its cheapest counts
    assert faster["cheapest"]
    assert faster["lead_db"] == pytest.approx(5.0)
    assert standing(LADDER, (20.0, 33.0))["crossover_ms"] is None


def test_classes_hold_what_is_fast_enough() -> None:
    rows = classes(LADDER, (35.0, 28.0), (5.0, 30.0, 100.0))
    assert [row["rival"] for row in rows] == [None, "1", "4"]
    assert [row["ours_db"] for row in rows] == [None, None, 28.0]


def _view(**changes: object) -> View:
    camera = CameraSettings(train=1, val=0, test=0, width=64, height=48)
    return orbit_views(SUMMARY, camera, 8)[0].model_copy(update=changes)


def _plane(view: View) -> Surface:
    """What the view sees of the plane through the origin that faces the first camera."""
    normal = _view().position / np.linalg.norm(_view().position)
    rays = view.ray_directions().astype(np.float64)
    distance = -(view.position @ normal) / (rays @ normal)
    position = view.position + rays * distance[..., None]
    depth = project(view, position)[2]
    return Surface(view, position, depth, np.ones(depth.shape, bool))


def _pattern(position: np.ndarray) -> np.ndarray:
    """A smooth texture that lies in space."""
    return 0.5 + 0.4 * np.stack([np.sin(2 * position[..., i] + i) for i in range(3)], axis=-1)


def _moved(view: View, across: float, pixels: bool = False) -> View:
    """The camera, ``across`` to its right (in pixels of the plane at the origin's depth)."""
    depth = float(np.linalg.norm(view.position))
    step = across * depth / view.fl_x if pixels else across
    c2w = view.matrix.copy()
    c2w[:3, 3] += step * c2w[:3, 0]
    return view.model_copy(update={"c2w": tuple(tuple(float(x) for x in row) for row in c2w)})


def test_a_point_on_the_axis_projects_to_the_principal_point() -> None:
    view = _view(cx=20.0, cy=11.0)
    x, y, depth = project(view, np.zeros((1, 3)))
    assert (x[0], y[0]) == pytest.approx((20.0, 11.0))
    assert depth[0] == pytest.approx(np.linalg.norm(view.position))
    assert project(view, 2 * view.position[None])[2][0] < 0


def test_standing_still_changes_nothing() -> None:
    surface = _plane(_view())
    image = np.random.default_rng(0).random((48, 64, 3))
    picture, valid = reproject(image, surface, surface)
    assert valid[1:-1, 1:-1].all()
    assert np.abs(picture - image)[valid].max() < 1e-4
    assert flicker([image] * 3, [image] * 3, [surface] * 3)["change"] < 1e-5


@settings(max_examples=20, deadline=None)
@given(st.integers(-20, 20))
def test_a_shift_by_whole_pixels_moves_the_picture_by_them(pixels: int) -> None:
    """The camera goes right, so the picture goes left; what was outside before takes no part."""
    view = _view()
    before, after = _plane(view), _plane(_moved(view, pixels, pixels=True))
    image = np.random.default_rng(1).random((48, 64, 3))
    picture, valid = reproject(image, before, after)
    expected = np.roll(image, -pixels, axis=1)
    assert np.abs(picture - expected)[valid].max() < 1e-4
    inside = valid[2:-2].mean(axis=0) > 0.99
    assert inside.sum() >= 64 - abs(pixels) - 2
    assert not valid[:, 64 - pixels :].any() if pixels > 0 else True


def test_a_texture_in_space_stays_put_and_noise_does_not() -> None:
    view = _view()
    surfaces = [_plane(_moved(view, 0.01 * step)) for step in range(4)]
    still = [_pattern(surface.position) for surface in surfaces]
    rng = np.random.default_rng(2)
    noisy = [image + rng.normal(0, 0.05, image.shape) for image in still]
    halves = tuple([image + rng.normal(0, 0.1, image.shape) for image in still] for _ in range(2))
    calm, shaky = flicker(still, still, surfaces, halves), flicker(noisy, still, surfaces, halves)
    assert calm["flicker"] == 0 and calm["flicker_rms"] < 0.01, "the halves' noise is in neither"
    assert 0.05 < shaky["flicker_rms"] < 0.05 * math.sqrt(2)
    assert calm["change"] < 2e-3
    # Difference of two independent draws, one of them bilinearly averaged: between one and sqrt 2 times the noise.
    single = 0.05 * math.sqrt(2 / math.pi)
    assert single < shaky["flicker"] < math.sqrt(2) * single * 1.02
    assert shaky["valid"] > 0.9


def test_light_that_moves_is_no_flicker() -> None:
    surface = _plane(_view())
    frames = [np.full((48, 64, 3), level) for level in (0.2, 0.3, 0.5)]
    found = flicker(frames, frames, [surface] * 3)
    assert found["change"] == pytest.approx(0.15)
    assert found["reference"] == pytest.approx(0.15)
    assert found["flicker"] == 0


def test_what_was_hidden_before_takes_no_part() -> None:
    view = _view()
    after = _plane(view)
    depth = after.depth.copy()
    depth[:, :32] *= 0.8  # something stood in front of the left half
    before = Surface(view, after.position, depth, after.mask)
    _, valid = reproject(np.zeros((48, 64, 3)), before, after)
    assert not valid[:, :31].any()
    assert valid[1:-1, 33:-1].all()
    nothing = Surface(view, after.position, after.depth, np.zeros_like(after.mask))
    assert not changes([np.zeros((48, 64, 3))] * 2, [nothing, after])[0][1].any()
    with pytest.raises(ValueError, match="too far apart"):
        flicker([np.zeros((48, 64, 3))] * 2, [np.zeros((48, 64, 3))] * 2, [nothing, after])


def _record(stage: str, unit: str, name: str, cpu: float, **more: object) -> CostRecord:
    fields = {"time": 1.0, "run": "r", "purpose": "training", "seconds": cpu, **more}
    return CostRecord.model_validate({"stage": stage, "unit": unit, "name": name, "cpu_seconds": cpu, **fields})


def test_what_comes_before_the_first_frame_is_counted_once_and_without_the_conversion() -> None:
    records = [
        _record("prepare", "scene", "convert", 50.0),
        _record("prepare", "view", "train/0000", 4.0),
        _record("raytrace", "view", "train/0000", 100.0),  # traced again below: its last cost counts
        _record("raytrace", "view", "train/0000", 6.0),
        _record("raytrace", "scene", "light", 10.0),
        _record("raytrace", "view", "test/0000", 70.0, purpose="evaluation"),
        *(_record("finetune", "epoch", f"epoch {n}", cpu) for n, cpu in enumerate([6.0, 6.0, 6.0, 9.0, 12.0])),
    ]
    found = upfront(records, threads=2)
    assert found == {"passes": 2.0, "tracing": 8.0, "training": 30.0, "total": 40.0}


def test_frames_at_equal_time_and_the_frames_from_which_ours_is_cheaper() -> None:
    rows = {name: {"ms": ms, "psnr": psnr} for name, (ms, psnr) in LADDER.items()}
    rows |= {"neural, 1 rays": {"ms": 20.0, "psnr": 28.0}, "neural, 8 rays": {"ms": 60.0, "psnr": 33.0}}
    scene = {
        "scene": "box",
        "rows": rows,
        "frontier": ["1", "4", "16"],
        "standing": {n: standing(LADDER, (r["ms"], r["psnr"])) for n, r in rows.items() if n.startswith("neural")},
        "upfront": {"training": 5.0, "total": 6.0},
    }
    one = at_equal_time(scene, 200)
    assert (one["name"], one["ms"]) == ("neural, 8 rays", pytest.approx(90.0))  # 6 s over 200 frames: 30 ms each
    assert one["rival"] == pytest.approx(quality_at(LINE, 90.0))
    # 28 dB take the rival 80 ms: 6 s / (80 - 20) ms. 33 dB it never reaches: at most 6 s / (160 - 60) ms.
    assert break_even(scene) == ("neural, 8 rays", 60, True)
    assert break_even({**scene, "standing": {"neural, 1 rays": scene["standing"]["neural, 1 rays"]}}) == (
        "neural, 1 rays",
        100,
        False,
    )
    assert "at most 60 frames (8 rays)" in "\n".join(lines([scene])) and "LPIPS" not in "\n".join(lines([scene]))
    for name, row in rows.items():  # where less is better
        row["lpips_alex"] = 0.5 if name == "neural, 1 rays" else 10 ** (-row["psnr"] / 20)
    assert break_even(scene, "lpips_alex") == ("neural, 8 rays", 60, True)
    rows["neural, 8 rays"]["lpips_alex"] = 0.5  # worse than the cheapest that the rival has, which takes less than ours
    assert break_even(scene, "lpips_alex") is None and "| never |" in "\n".join(lines([scene]))
    assert lines([{"scene": "without a ledger"}]) == []


def test_moving_cameras_are_judged_by_both_moves_and_against_the_better_rival() -> None:
    def rows(worse: float) -> dict[str, dict[str, float]]:
        found = {
            "neural, 1 rays": (90.0, 30.0, 0.004),
            "neural, 1 rays, remembers": (100.0, 33.0, 0.002),
            "base image alone, 2 rays, remembers": (150.0, 35.0, 0.004),
            "4 spp clean16-fast": (110.0, 29.0, 0.008),
            "4 spp clean16-fast, gathered x1": (118.0, 31.0, 0.005),
            "16 spp clean16": (200.0, 34.0, 0.004),
        }
        return {
            name: {"ms": ms, "psnr": psnr - worse, "lpips_alex": 0.1, "flicker": flicker, "flicker_rms": flicker / 4}
            for name, (ms, psnr, flicker) in found.items()
        }

    moves = {move: {"frames": 24, "reference_spp": 512, "rows": rows(i)} for i, move in enumerate(("orbit", "walk"))}
    scene = {"scene": "box", "size": [256, 256], "moving": moves, "upfront": {"training": 0.0, "total": 10.0}}
    table = moving_tables.lines([scene, {"scene": "not measured"}])
    fast, slow = (line for line in table if line.startswith("| box | ") and " rays, remembers, " in line)
    assert "1 rays, remembers, 100 ms | 32.50" in fast and "gathered x1, 118 ms | 30.50" in fast
    assert fast.endswith("| +2.00 | 40% | 40% |") and slow.endswith("| +1.00 | 100% | 100% |")
    assert "base, 2 rays, remembers, 150 ms | 34.50" in slow  # the base image alone is a renderer of ours, too
    assert any("cheaper at equal PSNR" in line for line in table)
    assert moving_tables.lines([{"scene": "not measured"}]) == []

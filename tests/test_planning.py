"""dnrpipe plan: lines through the pilot, the PSNR model, the choice, whether to train; and the whole of it, small."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.plan_record import plan_record

from dnrpipe.core.workspace import Source, Workspace
from dnrpipe.studies.planning.carry_out import steps_that_fit, steps_within
from dnrpipe.studies.planning.choose import NEAR, Predictor, best_within, budgets, cheapest_reaching
from dnrpipe.studies.planning.pilot import pilot_path, read_pilot
from dnrpipe.studies.planning.pilot_worker import without_reference
from dnrpipe.studies.planning.plan_text import break_even_line
from dnrpipe.studies.planning.quality import (
    Gain,
    Measured,
    Quality,
    load_prior,
    scene_gain,
    share,
    views_error,
    with_noise,
    without_noise,
)
from dnrpipe.studies.planning.records import (
    BasePart,
    FramePart,
    FramePoint,
    LightPart,
    LightPoint,
    Pilot,
    Plan,
    Prediction,
    Route,
    Traced,
    TracePart,
    TrainingPart,
)
from dnrpipe.studies.planning.routes import (
    PATH_TRACING,
    TRAINED,
    UNTRAINED,
    as_reported,
    baseline_front,
    break_even,
    routes,
    seconds_for,
)
from dnrpipe.studies.planning.seconds import RULE_SECONDS, Costs, Work, noise_at, view_line

PRIOR = load_prior()
POSITIVE = st.floats(1e-8, 1e-5)


def trace_part(per_sample: float, per_pixel: float, noise: float = 0.2, power: float = 0.5) -> TracePart:
    points = []
    for spp, side in ((16, 128), (16, 128), (128, 128), (128, 128)):
        pixels = side * side
        seconds = pixels * (per_sample * spp + per_pixel)
        rmse = noise * spp**-power
        points.append(Traced(spp=spp, pixels=pixels, seconds=seconds, cpu_seconds=seconds, noise_rmse=rmse))
    return TracePart(points=points, workers=2, startup=3.0)


BASELINES = (
    ("1 spp raw", 10.0, 20.0),
    ("4 spp clean16", 60.0, 30.0),
    ("64 spp clean16", 400.0, 35.0),
    ("poor", 90.0, 25.0),
)


def pilot() -> Pilot:
    return Pilot(
        fingerprint="x",
        size=(128, 128),
        trace=trace_part(5e-7, 5e-6),
        light=LightPart(
            bake=LightPoint(size=256, spp=32, seconds=1.5, cpu_seconds=2.5),
            kept=False,
            startup=4.0,
        ),
        base=BasePart(pixels=128 * 128, seconds=0.05, cpu_seconds=0.1, startup=3.0),
        training=TrainingPart(
            views=6,
            spp=16,
            steps=[100, 300],
            pixels=128 * 128,
            seconds=0.05,
            cpu_seconds=0.07,
            between=0.04,
            cpu_between=0.05,
            startup=1.0,
            threads=2,
        ),
        frames=FramePart(
            base=FramePoint(name="base", ms=40, psnr=28.0),
            neural=[FramePoint(name="neural", ms=55, psnr=29.0), FramePoint(name="neural", ms=55, psnr=29.8)],
            rival=[FramePoint(name=name, ms=ms, psnr=psnr) for name, ms, psnr in BASELINES],
            views=3,
            deviation=2.0,
        ),
    )


def predictor() -> Predictor:
    one = pilot()
    work = Work(pixels=128 * 128, trained=128 * 128, light=(512, 128), step1=0, tests=12, evaluation_spp=512)
    gain = scene_gain(PRIOR, [Measured(6, 100, 1.0), Measured(6, 300, 1.8)])
    wall, processor = Costs(one, work, "seconds"), Costs(one, work, "cpu_seconds")
    return Predictor(one, wall, processor, Quality(PRIOR, 28.0, gain), batch=1)


@functools.cache
def grid_of_forty() -> list[Prediction]:
    return list(predictor().grid(40))


@given(POSITIVE, POSITIVE)
def test_the_line_of_a_view_is_found_again(per_sample: float, per_pixel: float) -> None:
    line = view_line(trace_part(per_sample, per_pixel), "seconds")
    assert line.at(64, 20_000) == pytest.approx(20_000 * (per_sample * 64 + per_pixel), rel=1e-6)


@given(st.lists(st.floats(0.01, 10.0), min_size=4, max_size=4))
def test_no_part_of_a_line_is_below_zero_whatever_was_measured(times: list[float]) -> None:
    part = trace_part(1e-7, 1e-6)
    points = [p.model_copy(update={"seconds": t}) for p, t in zip(part.points, times, strict=True)]
    line = view_line(part.model_copy(update={"points": points}), "seconds")
    assert min(line.per_sample, line.per_pixel) >= 0
    assert line.at(8, 100) <= line.at(16, 100) <= line.at(16, 400)
    assert line.at(256, 16384) > 0


@given(st.floats(0.1, 0.5))
def test_noise_falls_with_the_power_that_was_measured(power: float) -> None:
    assert noise_at(trace_part(1e-7, 0, 0.3, power), 512) == pytest.approx(0.3 * 512**-power, rel=1e-6)


def test_light_is_extrapolated_by_texels_and_paths() -> None:
    costs = predictor().wall
    slope = 1.5 / (256**2 * 32)  # of the bake above
    assert costs.light() == pytest.approx(4.0 + 512**2 * 128 * slope)
    done = Costs(costs.pilot, Work(1, 1, None, 0, 0, 1), "seconds")
    assert done.light() == 0.0


def test_step_1_takes_as_long_as_its_steps_on_whole_pictures() -> None:
    """The pilot's step of 0.05 s (0.07 of the processor) is of 128²; four times the pixels take four times as long."""
    costs = predictor().wall
    assert costs.select() == RULE_SECONDS  # a rule trains nothing
    work = dataclasses.replace(costs.work, pixels=256 * 256, step1=100)
    assert Costs(costs.pilot, work, "seconds").select() == pytest.approx(100 * 0.05 * 4)
    assert Costs(costs.pilot, work, "cpu_seconds").select() == pytest.approx(100 * 0.07 * 4)


def test_why_there_is_no_break_even_is_said() -> None:
    def plan(traced: bool, neural: bool, frames: int | None = None) -> Plan:
        kinds = ((PATH_TRACING, traced), (TRAINED, neural))
        found = [Route(name=n, what="", upfront=1, frame=1, total=1, psnr=30, reaches=reaches) for n, reaches in kinds]
        return Plan.model_construct(routes=found, break_even=frames)

    assert "Path tracing is not expected" in break_even_line(plan(traced=False, neural=True))
    assert "neural renderer is not expected" in break_even_line(plan(traced=True, neural=False))
    assert "never pays" in break_even_line(plan(traced=True, neural=True))
    assert "120 frames" in break_even_line(plan(traced=True, neural=True, frames=120))


def test_processor_seconds_count_no_waiting_and_no_cores() -> None:
    one = predictor()
    each = view_line(one.pilot.trace, "cpu_seconds").at(16, 128 * 128)  # type: ignore[arg-type]
    assert one.processor.raytrace(6, 16) - one.processor.light() == pytest.approx(6 * each + 6 * 0.1)
    assert one.wall.raytrace(6, 16) - one.wall.light() == pytest.approx(3.0 + 3 * each + 3.0 + 6 * 0.05)


@given(st.integers(4, 200), st.integers(50, 10_000), st.floats(0.001, 0.2))
def test_more_views_and_samples_never_hurt_nor_steps_without_noise(views: int, steps: int, noise: float) -> None:
    gain = scene_gain(PRIOR, [Measured(6, 100, 1.0)])
    here = Quality(PRIOR, 28.0, gain).predict(views, steps, noise).expected
    assert Quality(PRIOR, 28.0, gain).predict(views + 1, steps, noise).expected >= here
    assert (
        Quality(PRIOR, 28.0, gain).predict(views, steps + 50, 0.0).expected
        >= Quality(PRIOR, 28.0, gain).predict(views, steps, 0.0).expected
    )
    assert Quality(PRIOR, 28.0, gain).predict(views, steps, noise / 2).expected >= here
    sure, unsure = (Quality(PRIOR, 28.0, gain, judged=judged).predict(views, steps, noise) for judged in (0.0, 2.0))
    assert sure.expected == unsure.expected and unsure.high - unsure.low > sure.high - sure.low


def test_few_of_many_views_judged_widen_the_interval() -> None:
    assert views_error(5.0, 6, 6) == 0.0 and views_error(5.0, 6, 4) == 0.0
    assert views_error(5.0, 6, 20) == pytest.approx(5.0 * (1 / 6 - 1 / 20) ** 0.5)


@given(st.floats(0.0, 6.0))
def test_the_gain_is_drawn_to_what_the_pilot_measured_and_is_surer_there(measured: float) -> None:
    blind, sees = scene_gain(PRIOR, []), scene_gain(PRIOR, [Measured(6, 300, measured)])
    before, unsure = blind.at(PRIOR, 6, 300)
    after, sure = sees.at(PRIOR, 6, 300)
    assert abs(after - measured) <= abs(before - measured) + 0.1
    assert sure < unsure
    assert sees.weight.sum() == pytest.approx(1.0)
    assert (sees.total[sees.weight > 0] > 0).all()


@given(st.floats(1.0, 4.0), st.floats(0.3, 0.9), st.floats(0.3, 0.9))
def test_what_still_grows_is_expected_to_go_on(last: float, one: float, other: float) -> None:
    def expected(first: float) -> float:
        gain = scene_gain(PRIOR, [Measured(6, 100, first * last), Measured(6, 300, last)])
        return gain.at(PRIOR, 6, 1000)[0] - gain.at(PRIOR, 6, 300)[0]

    slow, fast = sorted((one, other))
    assert expected(slow) >= expected(fast) - 1e-9


def test_a_sure_gain_is_itself() -> None:
    gain = Gain(np.array([4.0]), np.array([0.1]), np.array([1.0]))
    expected = 4.0 * float(share(PRIOR, 0.1, 25, 500))
    assert gain.at(PRIOR, 25, 500) == pytest.approx((expected, 0.0))
    assert gain.most == 4.0
    assert float(share(PRIOR, 2.0, 25, 5)) == 0.0  # a network that has hardly begun


@given(st.floats(15.0, 40.0), st.floats(0.0, 0.008))
def test_noise_is_taken_out_again(psnr: float, noise: float) -> None:
    assert without_noise(with_noise(psnr, noise), noise) == pytest.approx(psnr, abs=1e-6)
    assert with_noise(psnr, noise) <= psnr + 1e-9


def test_what_a_report_measures_counts_its_references_noise() -> None:
    part = pilot().frames
    assert part is not None
    shown = as_reported(part, 10 ** (-30 / 20))
    assert shown.base.psnr == pytest.approx(28.0 - 2.124, abs=0.01)
    assert max(point.psnr for point in shown.rival) < 30.0
    gain = scene_gain(PRIOR, [])
    clean, noisy = (Quality(PRIOR, 28.0, gain, reference=r).predict(25, 500, 0.0).expected for r in (0.0, 0.02))
    assert noisy == pytest.approx(with_noise(clean, 0.02))


def test_noise_of_the_references_does_not_count() -> None:
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(1, 3, 64, 64, generator=generator)
    picture = truth + 0.02 * torch.randn(truth.shape, generator=generator)
    first, second = (truth + 0.1 * torch.randn(truth.shape, generator=generator) for _ in range(2))
    known = torch.ones(64, 64, dtype=torch.bool)
    mean, error = without_reference(picture, first, second, known)
    assert mean == pytest.approx(0.02**2, abs=4 * error)  # against the mean of both it would be 0.0054
    assert error < 0.0002
    first[..., 5, 7], known[5, 7] = 1e6, False  # a pixel that is not known
    assert without_reference(picture, first, second, known)[0] == pytest.approx(mean, rel=0.05)


@settings(deadline=None, max_examples=10)
@given(st.floats(20, 2000), st.floats(1.0, 3.0))
def test_a_budget_is_kept_and_more_time_is_never_worse(seconds: float, more: float) -> None:
    grid = grid_of_forty()
    one, two = best_within(grid, seconds), best_within(grid, seconds * more)
    if one is None:
        assert seconds < min(p.seconds.total.expected for p in grid)
        return
    assert one.seconds.total.expected <= seconds
    assert two is not None
    assert two.psnr.expected >= one.psnr.expected - 0.02
    assert one.choice.views <= 40


def test_a_target_is_reached_by_the_cheapest_choice_that_does() -> None:
    grid = grid_of_forty()
    found = cheapest_reaching(grid, 29.5)
    assert found is not None
    assert found.psnr.expected >= 29.5
    cheaper = [p for p in grid if p.seconds.total.expected < found.seconds.total.expected]
    assert all(p.psnr.expected < 29.5 for p in cheaper)
    assert cheapest_reaching(grid, 60.0) is None


def test_a_table_of_budgets_rises_in_both() -> None:
    rows = budgets(grid_of_forty())
    assert len(rows) > 2
    assert [r.seconds.total.expected for r in rows] == sorted(r.seconds.total.expected for r in rows)
    assert [r.psnr.expected for r in rows] == sorted(r.psnr.expected for r in rows)


@given(st.sampled_from([(6, 16), (25, 4), (40, 128)]), st.floats(-10, 200))
def test_training_takes_the_time_left_or_what_is_best(views_and_samples: tuple[int, int], left: float) -> None:
    one = predictor()
    chosen = one.choice(*views_and_samples, 300)
    found = steps_within(one, chosen, left)
    assert (found.choice.views, found.choice.spp) == views_and_samples
    per_epoch = found.choice.steps // found.choice.epochs
    assert found.choice.epochs == 1 or found.seconds.finetune <= left + 1e-6
    longer = one.predict(one.choice(*views_and_samples, found.choice.steps + per_epoch))
    assert longer.seconds.finetune > left or longer.psnr.expected <= found.psnr.expected + NEAR


def workspace_with_pilot(folder: Path) -> Workspace:
    workspace = Workspace.create(folder / "demo.dnr", Source(path="demo.blend", sha256="0" * 64))
    pilot_path(workspace).parent.mkdir()
    pilot_path(workspace).write_text(pilot().model_dump_json())
    return workspace


def test_a_wanted_psnr_keeps_its_steps(tmp_path: Path) -> None:
    workspace = workspace_with_pilot(tmp_path)
    session = SimpleNamespace(workspace=workspace, answers={"raytrace": {"ran": True, "seconds": 1.0}})
    plan = Plan.model_validate(plan_record(wanted={"seconds": 3600.0, "psnr": 29.0, "frames": None}))
    assert steps_that_fit(session, plan, PRIOR) is plan  # type: ignore[arg-type]


def test_a_truncated_pilot_counts_as_none(tmp_path: Path) -> None:
    workspace = workspace_with_pilot(tmp_path)
    assert read_pilot(workspace) == pilot()
    pilot_path(workspace).write_text(pilot().model_dump_json()[:-100])
    assert read_pilot(workspace) is None


def test_the_baselines_are_followed_beyond_their_end_and_the_route_says_so() -> None:
    line = baseline_front(pilot().frames)  # type: ignore[arg-type]
    assert [name for name, _, _ in line] == ["1 spp raw", "4 spp clean16", "64 spp clean16"]
    assert seconds_for(line, 30.0) == pytest.approx((0.06, False))
    beyond = seconds_for(line, 37.0)
    assert beyond is not None
    assert beyond[1]
    assert beyond[0] > 0.4
    assert seconds_for(line, 80.0) is None


def test_few_frames_are_not_worth_training_and_many_are() -> None:
    one = predictor()
    grid = grid_of_forty()
    at = 30.0
    neural = cheapest_reaching(grid, at)
    assert one.pilot.frames is not None
    few = routes(one.pilot.frames, neural, one.wall.light(), one.wall.untrained(), 1.0, at, 5)
    assert few[0].name == "path tracing + denoiser"
    dear = 33.0  # the rival needs 0.2 s a frame there
    at_dear = cheapest_reaching(grid, one.quality.base + 0.7 * one.quality.gain.most)
    many = routes(one.pilot.frames, at_dear, one.wall.light(), one.wall.untrained(), 1.0, dear, 1_000_000)
    assert many[0].name == "neural renderer"
    even = break_even(many)
    assert even is not None
    before, after = (
        {r.name: r.total for r in routes(one.pilot.frames, at_dear, one.wall.light(), 0.0, 1.0, dear, n)}
        for n in (even - 1, even)
    )
    assert after["neural renderer"] <= after["path tracing + denoiser"]
    assert before["neural renderer"] > before["path tracing + denoiser"]


def test_the_base_image_alone_is_enough_where_it_is_enough() -> None:
    one = predictor()
    assert one.pilot.frames is not None
    slow = [rung.model_copy(update={"ms": 10 * rung.ms}) for rung in one.pilot.frames.rival]
    part = one.pilot.frames.model_copy(update={"rival": slow})
    found = routes(part, cheapest_reaching(grid_of_forty(), 27.0), 0.0, 1.0, 1.0, 27.0, 10_000)
    assert found[0].name == "base image alone"


def test_the_shipped_corrector_is_a_route_where_it_was_judged() -> None:
    one = predictor()
    assert one.pilot.frames is not None
    shipped = FramePoint(name="shipped", ms=55, psnr=29.5)
    part = one.pilot.frames.model_copy(update={"shipped": shipped})
    neural = cheapest_reaching(grid_of_forty(), 29.0)
    assert neural is not None

    def found(frames: int) -> list[Route]:
        return routes(part, neural, one.wall.light(), one.wall.untrained(), 1.0, 29.0, frames)

    assert one.wall.light() < one.wall.untrained() < neural.seconds.total.expected
    assert [r.psnr for r in found(1) if r.name == UNTRAINED] == [29.5]
    even = break_even(found(1))
    without = break_even(routes(one.pilot.frames, neural, one.wall.light(), 0.0, 1.0, 29.0, 1))
    assert even is None or without is None or even <= without


SMALL: dict[str, Any] = {
    "cameras": {"train": 8, "val": 0, "test": 2, "width": 48, "height": 48},
    "passes": {"raster": "cycles-direct", "coverage_samples": 16, "bake_size": 64},
    "raytrace": {"evaluation_spp": 16, "evaluation_baseline": False, "max_depth": 4},
    "base": {"light_size": 32, "light_spp": 8, "samples": 1},
    "model": {"texture_size": 32, "width": 8, "depth": 2},
    "finetune.step2": {"start": "fresh"},
}


def test_a_scene_is_planned_and_the_plan_carried_out(
    tmp_path: Path, demo_blend: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from dnrpipe.cli import _main
    from dnrpipe.studies.planning import carry_out, choose, pilot

    monkeypatch.chdir(tmp_path)
    for module, name, value in (
        (pilot, "VIEWS", 3),
        (pilot, "HELD_OUT", 1),
        (pilot, "REFERENCE_SPP", 16),
        (pilot, "SPP", 4),
        (pilot, "STEPS", (6, 12)),
        (pilot, "SAMPLE_COUNTS", (1, 4)),
        (pilot, "METHODS", ("raw", "clean16-fast")),
        (choose, "STEPS", (12, 24)),
        (choose, "SAMPLES", (4, 8)),
        (choose, "VIEWS", (3, 4)),
        (carry_out, "FILLED", 0.003),  # of the hour below: 11 s of training
    ):
        monkeypatch.setattr(module, name, value)
    (tmp_path / "dnrpipe.toml").write_text(_toml(SMALL))
    assert _main(["plan", str(demo_blend), "--frames", "3", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    root = tmp_path / "demo.dnr"
    assert json.loads((root / "plan" / "plan.json").read_text()) == {
        k: v for k, v in record.items() if k != "workspace"
    }
    assert not {"carried_out", "actual"} & record.keys()
    assert record["chosen"] is None
    assert not (root / "plan" / "pilot").exists()
    names = {route["name"] for route in record["routes"]}
    assert names == {"path tracing + denoiser", "base image alone", UNTRAINED, "neural renderer"}
    stages = {json.loads(line)["stage"] for line in (root / "costs.jsonl").read_text().splitlines()}
    assert "plan" in stages
    stamp = (root / "plan" / "pilot.json").stat().st_mtime_ns
    assert _main(["plan", "--time", "1h", "--apply", "-q"]) == 0
    assert (root / "plan" / "pilot.json").stat().st_mtime_ns == stamp  # the pilot is not run twice
    done = json.loads((root / "plan" / "plan.json").read_text())
    assert "routes" not in done  # nobody asked
    choice, carried_out = done["chosen"]["choice"], done["carried_out"]["choice"]
    assert {key: choice[key] for key in ("views", "spp")} == {key: carried_out[key] for key in ("views", "spp")}
    remembered = json.loads((root / "manifest.json").read_text())["overrides"]
    assert remembered["finetune"]["step2"]["epochs"] == carried_out["epochs"]
    assert len(json.loads((root / "selection.json").read_text())["views"]) == choice["views"]
    assert done["actual"]["psnr"] > 10
    assert done["actual"]["seconds"]["total"] > 0
    assert all(done["actual"]["ran"].values())
    assert _main(["plan", "--time", "1h", "--apply", "-q"]) == 0  # the same plan again: nothing is due
    again = json.loads((root / "plan" / "plan.json").read_text())
    assert not any(again["actual"]["ran"].values())
    assert again["carried_out"]["choice"] == carried_out
    assert _main(["plan", "--time", "0.01s"]) == 2
    assert "not enough" in capsys.readouterr().err
    assert _main(["report", "-q"]) == 0
    assert "predicted" in (root / "report" / "report.html").read_text()


def _toml(values: dict[str, Any]) -> str:
    return "\n".join(
        line
        for table, content in values.items()
        for line in (f"[{table}]", *(f"{key} = {json.dumps(value)}" for key, value in content.items()))
    )


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--apply"], "--time or --target-psnr"),
        (["--frames", "0"], "at least 1"),
        (["--time", "soon"], "--time soon: expected a time"),
    ],
)
def test_bad_requests_are_refused_in_one_line(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from dnrpipe.cli import _main

    assert _main(["plan", *arguments]) == 2
    assert said in capsys.readouterr().err

"""Which way a shot is made, and what its frames remember: rules without a renderer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from dnrpipe.core.cameras import look_at_view
from dnrpipe.core.errors import UserError
from dnrpipe.core.settings import CameraSettings, resolve
from dnrpipe.core.shot_records import told_frames
from dnrpipe.raytrace.tasks import CHUNK, WARM_UP
from dnrpipe.raytrace.temporal_filter import Finished, Latest
from dnrpipe.stages.shots import render_frames
from dnrpipe.stages.shots.check import held_out
from dnrpipe.stages.shots.frame_tasks import FrameCommon, FrameTask, Way
from dnrpipe.stages.shots.frame_worker import Worker
from dnrpipe.stages.shots.open_shot import parse_size, resized
from dnrpipe.stages.shots.options import Option, Wanted, choose
from dnrpipe.stages.shots.pilot import Measured, Pilot, _Window, best_mix, kind_of, reckoned
from dnrpipe.stages.shots.plan_shot import (
    Shape,
    _more_rays,
    _no_baked_light,
    _planned,
    baked_option,
    moving_way,
    path_option,
    require_baked_light,
    wants_training,
)
from dnrpipe.stages.shots.records import ShotFrame
from dnrpipe.stages.shots.references import Truth
from dnrpipe.stages.shots.render_frames import frame_tasks, in_succession
from dnrpipe.stages.shots.renderers import Renderer
from dnrpipe.stages.shots.request import carry_out
from dnrpipe.workers.task_list import TaskResult
from dnrtrain.contract import SceneFrame
from dnrtrain.exr import write_exr


def option(name: str, seconds: float, psnr: float | None, lpips: float | None = None, spp: int = 0) -> Option:
    way = Way.model_validate({"name": name, "spp": spp})
    return Option(way=way, before=0, frame=1, seconds=seconds, psnr=psnr, lpips=lpips)


CHEAP, BASE = option("path", 50, 26.0, 0.15, spp=1), option("base", 80, 29.0, 0.10)
OURS, FINE = option("neural", 100, 31.0, 0.05), option("path", 300, 34.0, 0.02, spp=64)
ALL = [CHEAP, BASE, OURS, FINE]


@pytest.mark.parametrize(
    ("wanted", "chosen"),
    [
        (Wanted(), OURS),
        (Wanted(seconds=90), BASE),
        (Wanted(seconds=1000), FINE),
        (Wanted(seconds=10), CHEAP),
        (Wanted(psnr=28.5), BASE),
        (Wanted(psnr=30, lpips=0.04), FINE),
        (Wanted(psnr=50), FINE),
        (Wanted(way="base"), BASE),
    ],
)
def test_the_cheapest_that_is_good_enough(wanted: Wanted, chosen: Option) -> None:
    assert choose(ALL, wanted)[0] is chosen


def test_path_tracing_that_is_as_good_and_cheaper_wins() -> None:
    quick = option("path", 60, 31.5, 0.04, spp=16)
    assert choose([*ALL, quick], Wanted())[0] is quick
    blurred = option("path", 60, 31.5, 0.20, spp=16)  # PSNR alone is not enough
    assert choose([*ALL, blurred], Wanted())[0] is OURS


def test_training_is_tried_where_nothing_cheaper_is_good_enough() -> None:
    shipped = [CHEAP, FINE, BASE, OURS]  # the last one is what training starts from
    assert wants_training(shipped, Wanted(psnr=33)), "path tracing that has it takes three times as long"
    assert not wants_training(shipped, Wanted(psnr=30)) and not wants_training(shipped, Wanted())
    quick = option("path", 90, 33.5, 0.03, spp=16)
    assert not wants_training([quick, *shipped], Wanted(psnr=33))
    assert wants_training([quick, *shipped], Wanted(psnr=33, way="neural")), "path tracing is not wanted"
    assert not wants_training(shipped, Wanted(psnr=33, way="base"))


def test_an_lpips_that_nobody_measured_is_not_the_one_that_is_wanted() -> None:
    blind = [found.model_copy(update={"lpips": None}) for found in ALL]
    assert choose(blind, Wanted(lpips=0.05)) == (blind[-1], "the best; none is expected to reach what is wanted")
    assert choose(blind, Wanted(psnr=28.5))[0] is blind[1], "PSNR alone is wanted"
    trained = option("neural", 150, 33.0).model_copy(update={"views": 4})
    assert choose([CHEAP, trained], Wanted(lpips=0.01))[0] is trained, "tried, for nothing else has it"


def test_an_lpips_that_cannot_be_measured_is_refused_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("DNRPIPE_CACHE", str(tmp_path))
    asked: Any = SimpleNamespace(wanted=Wanted(lpips=0.05))
    nothing: Any = None
    with pytest.raises(UserError, match="dnrpipe weights"):
        carry_out(nothing, asked)


@pytest.mark.parametrize("way", ["base", "neural"])
def test_baked_light_that_is_asked_for(way: str) -> None:
    wanted, run = Wanted(way=way), cast(Any, None)
    require_baked_light(resolve(None, {}, environment={}), wanted)
    settings = resolve(None, {"model": {"base": "path"}, "select": {"budget": 0}}, environment={})
    require_baked_light(settings, Wanted(way="path"))
    with pytest.raises(UserError, match=f"--way {way}: needs baked light, and model.base = path"):
        require_baked_light(settings, wanted)
    assert _no_baked_light(run, [], Shape(still=1, moving=1, pixels=1, convert=0.0), [], wanted) == ""
    assert _no_baked_light(run, [], Shape(still=0, moving=2, pixels=1, convert=0.0), [], wanted)


def test_as_few_rays_as_cost_next_to_nothing() -> None:
    few, some, most = (option("neural", 10.0 * n, 30 + n / 10, 0.1, spp=n) for n in (2, 6, 8))
    assert choose([few, some, most], Wanted())[0] is some, "0.2 dB below the best"
    smeared = some.model_copy(update={"lpips": 0.12})
    assert choose([few, smeared, most], Wanted())[0] is most, "PSNR alone is not enough"


def test_of_ways_whose_price_is_the_same_the_best_is_taken() -> None:
    corrected, plain = option("neural", 75.0, 32.6, 0.03, spp=6), option("base", 76.0, 32.7, 0.04, spp=8)
    best = option("neural", 91.0, 33.05, 0.05, spp=8)
    assert choose([corrected, plain, best], Wanted())[0] is plain
    dearer = plain.model_copy(update={"seconds": 80.0})
    assert choose([corrected, dearer, best], Wanted())[0] is corrected


def test_smoothed_frames_are_as_clean_as_denoised_ones() -> None:
    """Or not taken, where nothing is wanted: windows tell grain poorly."""
    clean = option("base", 40, 33.0, 0.107, spp=4)
    smooth = clean.model_copy(update={"way": Way(name="base", spp=4, smooth=True), "seconds": 30.0})
    assert choose([clean, smooth], Wanted())[0] is smooth
    grainy = smooth.model_copy(update={"psnr": 32.8, "lpips": 0.112})
    assert choose([clean, grainy], Wanted())[0] is clean
    assert choose([clean, grainy], Wanted(lpips=0.12))[0] is grainy, "asked for"
    soft = grainy.model_copy(update={"psnr": 33.1})
    assert choose([clean, soft], Wanted())[0] is soft, "grain would take decibels away"
    assert choose([clean, soft.model_copy(update={"lpips": 0.13})], Wanted())[0] is clean


def test_baked_light_that_is_worse_than_good_path_tracing_is_not_taken() -> None:
    """Where it was baked to save time."""
    steady, baked = option("path", 100, 35.0, 0.02, spp=4), option("base", 30, 31.0, 0.06, spp=8)
    assert choose([steady, baked], Wanted()) == (steady, "baked light is worse here")
    as_good = baked.model_copy(update={"psnr": 34.6, "lpips": 0.021})
    assert choose([steady, as_good], Wanted())[0] is as_good
    more = baked.model_copy(update={"way": Way(name="base", spp=16, smooth=True), "psnr": 34.6, "lpips": 0.021})
    assert choose([steady, baked, more], Wanted())[0] is more, "as good, and cheaper still"
    assert choose([steady, baked, more.model_copy(update={"seconds": 101})], Wanted())[0] is steady
    assert choose([steady, baked.model_copy(update={"psnr": 34.5, "lpips": 0.02}), more], Wanted())[0] is not more
    fewer = option("path", 70, 33.0, 0.028, spp=2)
    assert choose([fewer, steady, baked], Wanted())[0] is fewer, "good, too"
    assert choose([fewer, steady, baked.model_copy(update={"psnr": 32.6, "lpips": 0.03})], Wanted())[0].seconds == 30
    poor = steady.model_copy(update={"psnr": 30.0, "lpips": 0.05})
    assert choose([poor, baked.model_copy(update={"psnr": 29.0})], Wanted())[0].way.name == "base", "not good itself"


def test_rungs_between_and_beyond_those_measured() -> None:
    low = Measured(Way(name="path", spp=4), pixel=1.0, start=2.0, psnr=30.0, lpips=0.1)
    high = Measured(Way(name="path", spp=16), pixel=4.0, start=1.0, psnr=34.0, lpips=0.025)
    rungs = reckoned([high, low], [4, 8, 16, 32, 64])
    assert [rung.way.spp for rung in rungs] == [4, 8, 16, 32, 64]
    assert [rung.psnr for rung in rungs] == pytest.approx([30, 32, 34, 36, 38])
    assert [rung.pixel for rung in rungs] == pytest.approx([1, 2, 4, 8, 16])
    assert [rung.lpips for rung in rungs] == pytest.approx([0.1, 0.05, 0.025, 0.0125, 0.00625])
    blind = reckoned([low, Measured(Way(name="path", spp=16), pixel=4.0, start=1.0, psnr=34.0, lpips=None)], [4, 8, 16])
    assert [rung.lpips for rung in blind] == [0.1, None, None]


def test_a_picture_that_had_to_wait_makes_no_samples_cheap() -> None:
    """As measured on `foliage` when something held up its four samples: by these and eight, 64 cost less than none."""
    waited = [
        Measured(Way(name="path", spp=spp), pixel=pixel, start=0.0, psnr=36.0 + spp / 2, lpips=0.01)
        for spp, pixel in ((1, 0.527), (4, 0.972), (8, 0.676))
    ]
    rungs = reckoned(waited, [1, 2, 4, 8, 16, 32, 64], [(32, 1.169)])
    prices = [rung.pixel for rung in rungs]
    assert prices == sorted(prices) and 0.5 < prices[0] < 0.8 and 1.5 < prices[-1] < 2.4
    falling = reckoned(waited[1:], [4, 8, 16, 32, 64])
    assert [rung.pixel for rung in falling] == [0.972] * 5


def test_base_images_are_weighed_with_rays_between_those_measured() -> None:
    """Else the fewest that cost half a decibel at most are found in steps of half as many."""
    found = [
        Measured(Way(name="base", spp=spp, smooth=True), pixel=spp / 4, start=1.0, psnr=psnr, lpips=0.01)
        for spp, psnr in ((8, 39.4), (4, 38.8), (16, 40.0))
    ]
    rays = _more_rays(found)
    assert [each.way.spp for each in rays] == [4, 5, 6, 7, 8, 10, 12, 16]
    assert all(each.way.smooth for each in rays)
    assert [each.psnr for each in rays] == sorted(each.psnr for each in rays)
    assert _more_rays(found[:1]) == found[:1] and _more_rays([]) == []
    odd = replace(found[0], way=Way(name="base", spp=9, smooth=True))
    assert [each.way.spp for each in _more_rays([found[1], odd])] == [4, 5, 6, 7, 8, 9]
    shape = Shape(still=100, moving=0, pixels=1, convert=0.0)
    for weighed, chosen in ((found, 8), (rays, 5)):
        assert choose([baked_option(each, [], shape) for each in weighed], Wanted())[0].way.spp == chosen


def test_without_baked_light_what_it_usually_has_is_enough() -> None:
    def path(spp: int, psnr: float, lpips: float) -> Option:
        way = Way(name="path", spp=spp)
        return Option(way=way, before=1.0, frame=float(spp), seconds=float(spp), psnr=psnr, lpips=lpips)

    flickers, some, more = path(1, 32.0, 0.02), path(4, 33.0, 0.02), path(16, 36.0, 0.01)
    assert choose([flickers, some, more], Wanted())[0] is some
    assert choose([flickers, some.model_copy(update={"lpips": 0.05}), more], Wanted(way="path"))[0] is more
    poor = path(8, 29.0, 0.05)
    assert choose([path(1, 22.0, 0.2), poor, path(64, 33.0, 0.04)], Wanted()) == (poor, "the best of up to 8 samples")


def test_light_is_to_be_paid_by_all_frames_that_are_planned() -> None:
    """Also by those that are rendered another day; never by fewer than those of today."""
    shape = Shape(still=40, moving=8, pixels=1, convert=0.0)
    assert [_planned(shape, Wanted(frames=frames)) for frames in (None, 240, 10)] == [40, 200, 40]
    assert Wanted(frames=240).aimless


def test_ways_are_told_apart() -> None:
    ways = [Way(name="base", spp=8, smooth=smooth) for smooth in (False, True)]
    assert [way.told for way in ways] == ["base images, denoised, 8 rays", "base images, smoothed, 8 rays"]
    assert len({way.model_dump_json() for way in ways}) == 2


def test_a_shot_without_aim_wants_no_time_no_quality_and_no_baked_light() -> None:
    assert Wanted().aimless and Wanted(way="path").aimless
    others = Wanted(seconds=60.0), Wanted(psnr=30.0), Wanted(lpips=0.1), Wanted(way="base"), Wanted(way="neural")
    assert not any(wanted.aimless for wanted in others)


def test_seconds_of_a_shot_add_up() -> None:
    shape = Shape(still=10, moving=2, pixels=1000, convert=5.0)
    rung = Measured(Way(name="path", spp=4), pixel=0.001, start=3.0, psnr=30.0, lpips=0.1)
    more = Measured(Way(name="path", spp=16), pixel=0.004, start=3.0, psnr=34.0, lpips=0.05)
    assert path_option(rung, shape).seconds == pytest.approx(3 + 10 + 2 * (1 + 3 + 5))
    ours = Measured(Way(name="neural", spp=8), pixel=0.002, start=4.0, psnr=33.0, lpips=0.06)
    paths = [path_option(rung, shape), path_option(more, shape)]
    found = baked_option(ours, paths, shape)
    assert found.seconds == pytest.approx(4 + 20 + 2 * (4 + 3 + 5))  # moving frames by the rung that is as good
    options = [*paths, found]
    assert moving_way(options, found) == more.way
    assert moving_way(options, options[0]) == rung.way


def frames(count: int, cut: int, moving: tuple[int, ...] = ()) -> list[ShotFrame]:
    """A camera's way with a cut to another camera."""
    settings = CameraSettings(width=32, height=18)
    return [
        ShotFrame(
            number=place + 1,
            camera="near" if place < cut else "far",
            view=look_at_view(f"frame{place + 1:05d}", np.array([5.0, place / 10, 2]), np.zeros(3), 40.0, settings),
            moving=("ball",) if place in moving else (),
        )
        for place in range(count)
    ]


def test_frames_remember_back_to_the_cut_and_no_further_than_a_chunk(tmp_path) -> None:  # type: ignore[no-untyped-def]
    shot = frames(CHUNK + 20, cut=10)
    tasks = frame_tasks(shot, tmp_path, Way(name="neural", spp=8), "inputs")
    remembered = [len(task.earlier or ()) for task in tasks]
    assert remembered[:12] == [*range(10), 0, 1]
    assert remembered[CHUNK - 1] == CHUNK - 11
    assert remembered[CHUNK] == WARM_UP and remembered[CHUNK + 5] == WARM_UP + 5
    assert tasks[CHUNK].earlier == tuple(frame.view for frame in shot[CHUNK - WARM_UP : CHUNK])
    assert tasks[CHUNK].number == CHUNK - WARM_UP
    assert all(task.earlier is None for task in frame_tasks(shot, tmp_path, Way(name="path", spp=4), "inputs"))
    again = frame_tasks(shot, tmp_path, Way(name="neural", spp=8), "other inputs")
    assert {task.fingerprint for task in tasks}.isdisjoint(task.fingerprint for task in again)


def test_a_frames_number_in_its_way_decides_its_rays(tmp_path) -> None:  # type: ignore[no-untyped-def]
    """The same frame after a cut, further on in the shot."""
    shot = frames(12, cut=10)
    (after,) = frame_tasks(shot, tmp_path, Way(name="base", spp=8), "inputs", [10])
    (alone,) = frame_tasks(shot[10:], tmp_path, Way(name="base", spp=8), "inputs", [0])
    assert (after.view, after.earlier, alone.earlier) == (alone.view, (), ())
    assert (after.number, alone.number) == (10, 0) and after.fingerprint != alone.fingerprint
    (after,) = frame_tasks(shot, tmp_path, Way(name="path", spp=8), "inputs", [10])
    (alone,) = frame_tasks(shot[10:], tmp_path, Way(name="path", spp=8), "inputs", [0])
    assert after.fingerprint == alone.fingerprint, "path tracing goes by the timeline's number"


def test_folders_as_they_were_typed_decide_nothing() -> None:
    def decided(folder: str, **other: Any) -> Any:
        place = Path(folder)
        base = {"bundle": f"{folder}/scene.xml", "light": f"{folder}/light.npz", "samples": 8}
        common = {"bundle": place, "scene": place, "checkpoint": place, "base": base, "variant": "llvm"} | other
        frame = SceneFrame(near=1, far=2, center=(0, 0, 0), radius=1)
        facts: Any = {"integrator": "path", "max_depth": 5, "frame": frame} | common
        run: Any = SimpleNamespace(effect_plan=SimpleNamespace(left_out=()))
        return Renderer(FrameCommon(**facts), {}).decides(run)

    assert decided("scene.dnr") == decided("/home/me/scene.dnr")
    assert decided("scene.dnr") != decided("scene.dnr", variant="cuda")
    assert decided("scene.dnr") != decided("scene.dnr", base=None)


def test_frames_of_a_trained_renderer_remember_nothing(tmp_path) -> None:  # type: ignore[no-untyped-def]
    """As the frames that it was trained on."""
    way = Way(name="neural", spp=8)
    trained = frame_tasks(frames(6, cut=6), tmp_path, way, "inputs", alone=True)
    assert all(task.earlier is None and task.number == 0 for task in trained)
    shipped = frame_tasks(frames(6, cut=6), tmp_path, way, "inputs")
    assert all(a.fingerprint != b.fingerprint for a, b in zip(trained, shipped, strict=True))


def test_what_is_rendered_does_not_depend_on_where_a_run_begins(tmp_path) -> None:  # type: ignore[no-untyped-def]
    shot = frames(30, cut=30)
    whole = frame_tasks(shot, tmp_path, Way(name="neural", spp=8), "inputs")
    assert frame_tasks(shot, tmp_path, Way(name="neural", spp=8), "inputs", [17]) == [whole[17]]


def test_a_frame_is_whole_with_both_of_its_files(tmp_path) -> None:  # type: ignore[no-untyped-def]
    (task,) = frame_tasks(frames(1, cut=1), tmp_path, Way(name="path", spp=4), "inputs")
    task.output.parent.mkdir()
    write_exr(task.output, {"R": np.zeros((2, 2), np.float32)}, {"fingerprint": task.fingerprint})
    assert not render_frames.is_whole(task), "an interruption between the two files"
    task.picture.parent.mkdir()
    task.picture.touch()
    assert render_frames.is_whole(task)


def test_outcomes_come_in_the_order_of_their_tasks(tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """A task that is tried again is answered last."""
    tasks = frame_tasks(frames(4, cut=4), tmp_path, Way(name="path", spp=4), "inputs")
    answers = [TaskResult(tasks[i].data(), {"seconds": float(i)}) for i in (0, 2, 3, 1)]
    monkeypatch.setattr(render_frames, "run_tasks", lambda *_, **__: (answer for answer in answers))
    run: Any = SimpleNamespace(log=tmp_path / "log", console=None, kept=None)
    renderer: Any = SimpleNamespace(common=SimpleNamespace(data=dict), environment={})
    found = render_frames.frame_outcomes(run, renderer, tasks, "frames")
    assert [outcome.result for outcome in found] == [{"seconds": float(i)} for i in range(4)]


def test_a_frame_is_rendered_while_the_one_before_is_written(tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    tasks = in_succession(frame_tasks(frames(3, cut=3), tmp_path, Way(name="path", spp=4), "inputs"))
    assert [None if task.following is None else task.following.output for task in tasks] == [
        *(task.output for task in tasks[1:]),
        None,
    ]
    assert in_succession([]) == []
    worker: Any = object.__new__(Worker)
    worker.latest = Latest()
    rendered, filtered, written, broken = [], [], [], [2]

    def render(task: FrameTask, _ms: dict[str, float]) -> tuple[list[Any], int]:
        assert task == task.alone
        rendered.append(int(task.output.stem) - 1)
        if rendered[-1] in broken:
            broken.clear()
            raise ValueError("broken once")
        return [{"number": rendered[-1]}], 0

    def mix(frame: Finished, before: Finished | None, after: Finished | None) -> dict[str, Any]:
        filtered.append([each and each.layers["number"] for each in (before, frame, after)])
        return {"number": "filtered"}

    def write(found: Any) -> None:
        written.append((found.task.output, found.task.fingerprint, found.layers))

    monkeypatch.setattr(worker, "render", render, raising=False)
    monkeypatch.setattr(worker, "filter", mix, raising=False)
    monkeypatch.setattr(worker, "_write", write, raising=False)
    for number, task in enumerate(tasks):
        answer = worker(task.data())
        assert written[number] == (task.output, task.fingerprint, [{"number": "filtered"}])
        assert answer["write_seconds"] >= 0 and "temporal filter" in answer["ms"]
    assert rendered == [0, 1, 2, 2], "the one that failed beside the first is rendered again"
    assert filtered == [[None, 0, 1], [0, 1, 2], [1, 2, None]], "with the others as they were rendered"


def test_frames_are_filtered_with_those_next_to_them(tmp_path) -> None:  # type: ignore[no-untyped-def]
    """Not across a cut, not where things move, not with a lens, not if three of them are too large."""

    def others(shot: list[ShotFrame]) -> list[tuple[str | None, str | None]]:
        tasks = frame_tasks(shot, tmp_path, Way(name="path", spp=4), "inputs")
        return [(task.before and task.before.view.name, task.after and task.after.view.name) for task in tasks]

    shot = frames(5, cut=3)
    names = [frame.view.name for frame in shot]
    assert others(shot) == [
        *((None, names[1]), (names[0], names[2]), (names[1], None)),
        *((None, names[4]), (names[3], None)),
    ]
    moving = [*shot[:2], shot[2].model_copy(update={"moving": ("ball",)})]
    assert others(moving) == [(None, names[1]), (names[0], None), (None, None)]
    lens = {"focus_distance": 1.0, "aperture_radius": 0.1}
    assert others([frame.model_copy(update={"lens": lens}) for frame in shot]) == [(None, None)] * 5
    large = [
        frame.model_copy(update={"view": frame.view.model_copy(update={"width": 3840, "height": 2160})})
        for frame in shot
    ]
    assert others(large) == [(None, None)] * 5
    tasks, again = (frame_tasks(frames(count, cut=9), tmp_path, Way(name="path", spp=4), "inputs") for count in (3, 4))
    same = [a.fingerprint == b.fingerprint for a, b in zip(tasks, again, strict=False)]
    assert same == [True, True, False], "the last one has another after it now"


def test_windows_that_show_nothing_do_not_count() -> None:
    pilot: Any = object.__new__(Pilot)
    black, white = torch.zeros(1, 3, 8, 8), torch.ones(1, 3, 8, 8)
    pilot.references = {0: Truth(white, 0.0), 1: Truth(black, 0.0)}
    pilot.lpips, pilot.windows = None, [(0, (0.5, 0.5))]
    pilot.frames = frames(1, cut=1)
    way = Way(name="path", spp=4)
    pilot.starts, pilot.wholes = {True: 2.0}, {kind_of(way): 0.5}
    rows = [_Window(0, white, 1.0), _Window(1, black + 0.1, 3.0)]
    found = pilot._measured(way, rows)
    assert found.psnr == pytest.approx(20, abs=0.01) and found.start == 2.0
    view = pilot.frames[0].view  # smaller than a window
    assert found.pixel == pytest.approx(0.5 * 2.0 / (view.width * view.height)), "a whole frame takes half as long"
    assert found.shows
    nothing = pilot._measured(way, rows[:1])
    assert nothing.psnr == pytest.approx(80, abs=0.01) and not nothing.shows


def test_each_kind_of_way_is_priced_by_a_whole_frame_of_its_own() -> None:
    """The network's frame says nothing of what smoothed rays take where windows show more sky than the frame."""
    pilot: Any = object.__new__(Pilot)
    pilot.frames, pilot.wholes = frames(2, cut=2), {}
    pilot.windows = [(0, (0.2, 0.7)), (0, (0.7, 0.4)), (1, (0.2, 0.7))]
    view = pilot._view(*pilot.windows[0])
    pixels = view.width * view.height
    network, smoothed = Way(name="neural", spp=6), Way(name="base", spp=8, smooth=True)
    black = torch.zeros(1, 3, 8, 8)
    rows = [_Window(0, black, 1.0), _Window(1, black, 3.0), _Window(2, black, 50.0)]
    pilot._set_whole(network, rows, 1.0 / pixels)
    pilot._set_whole(smoothed, rows, 3.0 / pixels)
    assert pilot._pixel([4.0], network.model_copy(update={"spp": 4})) == pytest.approx(4.0 * 0.5 / pixels)
    assert pilot._pixel([4.0, 8.0], smoothed.model_copy(update={"spp": 16})) == pytest.approx(6.0 * 1.5 / pixels)


def test_a_frame_in_which_things_move_is_not_remembered(tmp_path) -> None:  # type: ignore[no-untyped-def]
    shot = frames(8, cut=8, moving=(3,))
    tasks = frame_tasks(shot, tmp_path, Way(name="neural", spp=8), "inputs", [2, 4, 5])
    assert [len(task.earlier or ()) for task in tasks] == [2, 0, 1]


def test_frames_that_are_checked() -> None:
    assert held_out(frames(10, 10), 2) == [2, 7]
    chosen = held_out(frames(10, 10, moving=(4, 5)), 2)
    assert len(chosen) == 2 and len(set(chosen) & {4, 5}) == 1


def test_sizes_and_frames_as_written() -> None:
    assert parse_size("1280x720") == (1280, 720) == parse_size(" 1280 × 720 ")
    for text in ("1280", "1280x", "0x720", "1280x99999", "axb"):
        with pytest.raises(UserError, match="--size"):
            parse_size(text)
    assert told_frames([3]) == "frame 3"
    assert told_frames([1, 2, 3, 7, 9, 10]) == "frames 1-3, 7, 9-10"
    view = frames(1, 1)[0].view
    half = resized(view, 16, 9)
    assert (half.fl_x, half.cx, half.cy) == (view.fl_x / 2, view.cx / 2, view.cy / 2)
    assert resized(view, 32, 32).cy == 16 and resized(view, 32, 32).fl_y == view.fl_y


def test_as_much_of_the_correction_as_comes_closest() -> None:
    plain = [torch.rand(1, 3, 4, 4, generator=torch.Generator().manual_seed(seed)) for seed in range(3)]
    better = [picture + 0.1 for picture in plain]
    assert best_mix([(a, b, a + 0.07) for a, b in zip(plain, better, strict=True)]) == 0.7
    assert best_mix([(a, b, a - 0.07) for a, b in zip(plain, better, strict=True)]) == 0
    # One window gains all of it, two gain nothing.
    truth = [better[0], plain[1], plain[2]]
    assert best_mix(list(zip(plain, better, truth, strict=True))) == 0.3

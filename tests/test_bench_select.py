"""`dnrpipe bench-select`: pools are what they say, intervals are Student's, runs resume, policies share work."""

from __future__ import annotations

import itertools
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from tests.scene_records import scene_summary

from dnrpipe.blender.geometry.frozen import FrozenMesh
from dnrpipe.core.cameras import make_cameras
from dnrpipe.core.errors import UserError
from dnrpipe.core.settings import CameraSettings, resolve
from dnrpipe.studies.cells.intervals import difference, half_width, summarise, t_distribution, t_quantile
from dnrpipe.studies.cells.request import epochs_of
from dnrpipe.studies.selectbench.active.batches import KINDS
from dnrpipe.studies.selectbench.bench_select import choose_budgets
from dnrpipe.studies.selectbench.bench_tables import markdown, together
from dnrpipe.studies.selectbench.figures import Figures
from dnrpipe.studies.selectbench.policies import CONTENDERS, GROUPS, SIMPLE, choose_policies, settings_of
from dnrpipe.studies.selectbench.pools import POOLS, choose_pools, write_rig
from dnrpipe.studies.selectbench.rigs import inside, surface_points, walk, winding
from dnrtrain.contract import View
from dnrtrain.selector.names import TRAINED_NAMES, UNTRAINED_NAMES

SUMMARY = scene_summary(
    bounds={"center": [1.0, -2.0, 0.5], "radius": 1.5, "min": [0, -3, 0], "max": [2, -1, 1]},
)


# -- intervals ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("freedom", "quantile"), [(1, 12.7062), (2, 4.3027), (3, 3.1824), (7, 2.3646), (10, 2.2281), (30, 2.0423)]
)
def test_students_quantiles_are_the_tables(freedom: int, quantile: float) -> None:
    assert t_quantile(0.975, freedom) == pytest.approx(quantile, abs=5e-5)


@given(st.integers(1, 40), st.floats(0, 20))
def test_students_distribution_is_the_integral_of_its_density(freedom: int, t: float) -> None:
    x = np.linspace(0, t, 4001)
    scale = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(freedom * math.pi)
    area = 0.5 + np.trapz(scale * (1 + x**2 / freedom) ** (-(freedom + 1) / 2), x)
    assert t_distribution(t, freedom) == pytest.approx(area, abs=1e-5)


def test_the_interval_covers_the_truth_as_often_as_it_says() -> None:
    random = np.random.default_rng(0)
    samples = random.normal(0.3, 1.0, (4000, 6))
    covered = [abs(np.mean(s) - 0.3) <= (half_width(list(s)) or 0.0) for s in samples]
    assert np.mean(covered) == pytest.approx(0.95, abs=0.015)


def test_scenes_are_the_units_and_seeds_only_where_there_is_one_scene() -> None:
    both = summarise({("a", 0): 1.0, ("a", 1): 3.0, ("b", 0): 5.0, ("b", 1): 5.0})
    assert both is not None
    assert (both.mean, both.scenes) == (3.5, {"a": 2.0, "b": 5.0})
    assert both.half == pytest.approx(12.7062 * np.std([2, 5], ddof=1) / math.sqrt(2), rel=1e-5)
    one = summarise({("a", 0): 1.0, ("a", 1): 3.0, ("a", 2): 2.0})
    assert one is not None and one.mean == 2.0 and one.half == pytest.approx(4.3027 / math.sqrt(3), rel=1e-4)
    lone = summarise({("a", 0): 1.0})
    assert lone is not None and lone.half is None and not lone.clear
    assert summarise({}) is None


# -- what is asked for -------------------------------------------------------------------------------------


def test_budgets() -> None:
    assert choose_budgets("25,10, 10", 100) == [10, 25]
    assert choose_budgets("full", 57) == [5, 10, 15, 20, 25, 30, 40, 50, 57]
    assert choose_budgets("full", 8) == [5, 8]
    for bad in ("0", "101", "ten", "", "-3"):
        with pytest.raises(UserError, match="--budgets"):
            choose_budgets(bad, 100)


def test_pools_and_policies_by_name() -> None:
    assert choose_pools("path,dome") == ["dome", "path"] and choose_pools("all") == list(POOLS)
    with pytest.raises(UserError, match="--pools ball"):
        choose_pools("ball")
    assert [c.name for c in choose_policies("kmedoids,random")] == ["random", "kmedoids"]
    assert {c.name for c in choose_policies("all")} == set(CONTENDERS)
    with pytest.raises(UserError, match="did you mean 'kmedoids'"):
        choose_policies("kmedoid")


def test_every_policy_of_the_trainer_competes() -> None:
    kinds = {kind: {c.policy for c in CONTENDERS.values() if c.kind == kind} for kind in ("rule", "active", "step1")}
    assert kinds["rule"] | {"auto"} == set(UNTRAINED_NAMES)  # auto is coverage
    assert kinds["step1"] == set(TRAINED_NAMES) and kinds["active"] == set(KINDS)
    assert set(SIMPLE) <= set(GROUPS["core"]) and all(CONTENDERS[name].kind == "rule" for name in GROUPS["core"])
    assert set(TRAINED_NAMES) <= set(GROUPS["all"]) and not set(TRAINED_NAMES) & set(GROUPS["core"])
    rewards = {
        settings_of(CONTENDERS[name], resolve("draft", {}, environment={}), 7).select.step1.reward
        for name in GROUPS["rewards"]
    }
    assert len(rewards) == len(GROUPS["rewards"])


# -- pools -------------------------------------------------------------------------------------------------


def looks_at(view: View, point: list[float]) -> bool:
    ahead = np.linalg.inv(view.matrix) @ np.append(point, 1.0)
    return bool(ahead[2] < 0)


@given(st.integers(10, 200), st.integers(0, 5))
@hypothesis_settings(deadline=None, max_examples=20)
def test_a_walk_has_near_duplicates_and_views_that_see_nothing(count: int, seed: int) -> None:
    views = walk(SUMMARY, CameraSettings(train=count, test=9, seed=seed))
    train, test = views["train"], views["test"]
    assert [len(train), len(test)] == [count, 9]
    assert len({view.name for view in [*train, *test]}) == count + 9
    center = SUMMARY.bounds.center
    blind = [view for view in train if not looks_at(view, center)]
    assert len(blind) == round(0.1 * count) and all(looks_at(view, center) for view in test)
    places = np.array([view.position for view in train])
    nearest = np.linalg.norm(places[:, None] - places[None], axis=-1) + np.eye(count) * 1e9
    radius = np.linalg.norm(places - np.array(center), axis=1).mean()
    close = nearest.min(axis=1) < 0.05 * radius
    assert count < 40 or close.mean() > 0.5  # those at the stops
    assert (np.array([view.position for view in test]) - np.array(center))[:, 2].min() > 0
    assert walk(SUMMARY, CameraSettings(train=count, test=9, seed=seed)) == views


def test_a_long_walk_holds_exact_duplicates_of_another_name() -> None:
    train = walk(SUMMARY, CameraSettings(train=100, test=4))["train"]
    assert 2 <= len(train) - len({view.c2w for view in train}) <= 20


def box(low: Any, high: Any, name: str = "box") -> FrozenMesh:
    """A closed box, counter-clockwise from outside."""
    corners = np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)], np.float32)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    index = np.array([[(a, b, c), (a, c, d)] for a, b, c, d in quads]).reshape(-1)
    positions = corners[index]
    return FrozenMesh(name, name, 1, positions, np.zeros_like(positions), np.zeros(12, np.int32), [None])


def test_winding_numbers_tell_inside_from_outside() -> None:
    triangles = box([0, 0, 0], [1, 2, 1]).positions.reshape(-1, 3, 3).astype(float)
    found = winding(np.array([[0.5, 1.0, 0.5], [0.1, 1.9, 0.9], [1.5, 1.0, 0.5], [0.5, 1.0, -3.0]]), triangles)
    assert found == pytest.approx([1, 1, 0, 0], abs=1e-9)


def test_points_are_drawn_evenly_by_area_and_on_copies() -> None:
    mesh = box([0, 0, 0], [1, 1, 1])
    mesh.copies = np.eye(4)[None].copy()
    mesh.copies[0, 0, 3] = 10.0
    points = surface_points([mesh], 6000, np.random.default_rng(0))
    assert np.mean(points[:, 0] > 5) == pytest.approx(0.5, abs=0.03)
    assert np.mean(points[points[:, 0] < 5][:, 2] == 1.0) == pytest.approx(1 / 6, abs=0.03)


def test_cameras_indoors_stand_in_free_air_and_look_at_surfaces() -> None:
    room, block = box([-2, -2, 0], [2, 2, 2], "room"), box([-1, -1, 0], [1, 1, 1.2], "block")
    summary = scene_summary(bounds={"center": [0, 0, 1], "radius": 3.0, "min": [-2, -2, 0], "max": [2, 2, 2]})
    views = inside(summary, CameraSettings(train=60, test=8), [room, block], "room")
    places = np.array([view.position for members in views.values() for view in members])
    assert len(places) == 68 and (np.abs(places[:, :2]) < 2).all()
    assert not ((np.abs(places[:, :2]) < 1).all(axis=1) & (places[:, 2] < 1.2)).any()  # in the block
    with pytest.raises(UserError, match="pool indoor: cell has room for 0 of 5 cameras"):
        inside(summary, CameraSettings(train=4, test=1), [room, box([-1.9, -1.9, 0], [1.9, 1.9, 2])], "cell")


def test_a_rig_keeps_its_splits(tmp_path: Path) -> None:
    settings = CameraSettings(train=12, test=3, val=2, width=64, height=48)
    views = walk(SUMMARY, settings)
    path = tmp_path / "rig.json"
    write_rig(path, views)
    chosen = settings.model_copy(update={"source": str(path)})
    assert make_cameras(SUMMARY, chosen) == {"train": views["train"], "val": [], "test": views["test"]}
    data = json.loads(path.read_text())
    del data["frames"][5]["split"]
    path.write_text(json.dumps(data))
    with pytest.raises(UserError, match="view 0005 has no split of train, val, test"):
        make_cameras(SUMMARY, chosen)
    for frame in data["frames"]:
        frame.pop("split", None)
    path.write_text(json.dumps(data))
    assert len(make_cameras(SUMMARY, chosen)["test"]) == 3  # dealt out, as before


# -- tables ------------------------------------------------------------------------------------------------


def results(values: dict[tuple[str, str, int, str, int], float]) -> dict[str, Any]:
    """Results whose PSNR is given per (scene, pool, budget, policy, seed)."""
    cells = [
        {
            "scene": scene, "pool": pool, "budget": budget, "policy": policy, "seed": seed, "key": f"{psnr}",
            "psnr": psnr, "psnr_mask": psnr - 5, "ssim": 0.9, "ssim_mask": 0.8, "lpips_vgg": None, "lpips_alex": None,
            "flip": 0.1, "ceiling": 40.0, "views": [], "select_seconds": 1.5, "view_seconds": 20.0,
            "train_seconds": 10.0, "total_seconds": 31.5, "select_peak_mb": 300, "epochs": 5, "steps": 50,
            "commit": "abc",
        }
        for (scene, pool, budget, policy, seed), psnr in values.items()
    ]  # fmt: skip
    return {
        "schema": 1, "command": "dnrpipe bench-select", "commit": "abc", "dirty": False,
        "date": "2026-01-02T03:04:05+00:00", "machine": {"processor": "p", "cores": 2}, "versions": {"torch": "2"},
        "preset": "draft", "resolution": "128x128", "candidates": 100, "seconds": 15.0, "cells": cells,
        "scenes": list(dict.fromkeys(place[0] for place in values)),
    }  # fmt: skip


def test_every_pool_has_its_own_rival_and_differences_are_paired() -> None:
    values = {}
    for scene, offset in (("a", 20.0), ("b", 30.0)):
        for seed in range(2):
            for policy, dome, path in (("random", 0, 0), ("farthest", 1, 2), ("kmedoids", 3, 1), ("exchange", 4, 4)):
                extra = 0.5 if (policy, scene, seed) == ("exchange", "b", 1) else 0.0
                values[scene, "dome", 10, policy, seed] = offset + dome + extra
                values[scene, "path", 10, policy, seed] = offset + path + extra
    figures = Figures(results(values))
    assert figures.best_simple("dome", 10) == "kmedoids" and figures.best_simple("path", 10) == "farthest"
    found = figures.against("exchange", "simple", ["dome", "path"], 10)
    assert found is not None and found.scenes == {"a": 1.5, "b": 1.75} and found.mean == 1.625
    own = figures.against("kmedoids", "simple", ["dome", "path"], 10)
    assert own is not None and own.mean == -0.5  # 0 where it is itself the best
    assert figures.against("kmedoids", "simple", ["dome"], 10) is None
    assert figures.means("dome", 10, "exchange", "psnr") == [29.0, 29.25]
    text = markdown(results(values))
    line = next(line for line in text.split("### `dome`, 10 views")[1].splitlines() if "`exchange`" in line)
    # Scenes differ by 0.25 / 2 from the mean: 12.706 · 0.125.
    assert "| 29.12 ± 0.18 |" in line and "| **+4.12 [+2.54, +5.71]** |" in line and "| +1.00 (a) |" in line
    assert "| 1.50 | 32 |" in line  # selection and total seconds
    assert "bench-select" in text and "commit abc" in text and "Student's t over scenes" in text


def test_the_best_simple_rule_is_best_over_scenes_not_over_cells() -> None:
    """Scene a has three seeds and likes `farthest` by 0.3 dB, b and c have one and like `kmedoids` by 0.2."""
    values = {
        (scene, "dome", 10, policy, seed): 20.0 + (gain if policy == liked else 0.0)
        for scene, seeds, liked, gain in (
            ("a", 3, "farthest", 0.3),
            ("b", 1, "kmedoids", 0.2),
            ("c", 1, "kmedoids", 0.2),
        )
        for policy in ("farthest", "kmedoids")
        for seed in range(seeds)
    }
    figures = Figures(results(values))
    assert figures.best_simple("dome", 10) == "kmedoids"  # by cells 0.08 against 0.18, by scenes 0.133 against 0.1
    found = figures.against("farthest", "simple", ["dome"], 10)
    assert found is not None and found.mean == pytest.approx(-0.1 / 3)


def test_steps_are_whole_passes_over_the_views() -> None:
    assert epochs_of(2500, 10, 1) == 250 and epochs_of(2500, 10, 4) == 833 and epochs_of(2500, 25, 4) == 357
    assert epochs_of(3, 100, 1) == 1


def test_quality_against_the_number_of_views_has_pairs_and_the_price_of_choosing() -> None:
    gains = {"random": 0.0, "rl-paper": 1.0}
    values = {
        (scene, "dome", budget, policy, seed): 20.0 + budget / 10 + gain * (1 + 0.1 * seed)
        for scene in ("a", "b")
        for budget in (5, 10, 25)
        for policy, gain in gains.items()
        for seed in range(2)
    }
    text = markdown(results(values))
    assert "| 10 | 21.00 ± 0.00 | 22.05 ± 0.07 |" in text
    # Four pairs of 1.0 and 1.1, 3.182 · 0.0577 / 2; 1.5 s of choosing where ten views take 20 s.
    assert "| 10 | **+1.05 [+0.96, +1.14]** | – | 0.8 |" in text
    two = {place: value for place, value in values.items() if place[2] != 5}
    assert "against the number of traced views" not in markdown(results(two))
    for (scene, seed), psnr in zip(itertools.product("ab", range(2)), (22.0, 22.2, 22.4, 22.6), strict=True):
        two[scene, "dome", 100, "random", seed] = psnr  # of all candidates
    # 25 views are 22.5 dB: +0.5, +0.3, +0.1, -0.1; 3.182 · 0.2582 / 2.
    assert "| 25 | `random` | +0.20 [-0.21, +0.61] | – |" in markdown(results(two))


def test_seconds_of_several_devices_are_the_processors() -> None:
    values = {
        (scene, "dome", budget, policy, 0): 20.0 + budget / 10
        for scene, budget, policy in itertools.product("ab", (5, 10, 25), ("random", "rl-paper"))
    }
    mixed = results(values)
    for cell in mixed["cells"]:
        cell["device"] = "cuda" if cell["scene"] == "a" else "cpu"
        if cell["scene"] == "a":
            cell["select_seconds"] = 1e6
    text = markdown(mixed)
    assert "Trained: a on cuda; b on cpu" in text
    assert "| 10 | +0.00 [+0.00, +0.00] | – | 0.8 |" in text  # 1.5 s where ten views take 20 s
    for cell in mixed["cells"]:
        if cell["device"] == "cpu":
            del cell["device"]  # it is the results' own then
    assert markdown({**mixed, "device": "cpu"}) == text
    for cell in mixed["cells"]:
        cell["device"] = "cuda"
    assert "Trained:" not in markdown(mixed) and "250000.4" in markdown(mixed)


def test_runs_on_several_scenes_make_one_table() -> None:
    def run(scene: str, gains: dict[str, float]) -> dict[str, Any]:
        pairs = ((pool, policy, gain) for pool in ("dome", "path") for policy, gain in gains.items())
        return results({(scene, pool, 10, policy, 0): 20.0 + gain for pool, policy, gain in pairs})

    runs = [run("a", {"random": 0, "farthest": 1, "exchange": 2}), run("b", {"random": 0, "farthest": 1})]
    text = together([*runs, runs[1]])  # a cell in two runs counts once
    assert "| `farthest` | **+1.00 [+1.00, +1.00]** |" in text and "`exchange`" not in text
    assert "| a | 20.00 | 21.00 |" in text and text.count("| b | 20.00 | 21.00 |") == 2


def test_one_scene_in_several_pools_is_still_one_unit_per_seed() -> None:
    values = {
        ("a", pool, 5, policy, seed): 20.0 + gain + seed
        for pool, gains in (("dome", (0, 1)), ("path", (0, 3)))
        for policy, gain in zip(("random", "farthest"), gains, strict=True)
        for seed in range(2)
    }
    found = Figures(results(values)).against("farthest", "random", ["dome", "path"], 5)
    assert found is not None and (found.mean, found.half) == (2.0, 0.0)


def test_a_difference_is_bold_only_where_its_interval_leaves_out_zero() -> None:
    assert difference(summarise({("a", 0): 1.0, ("b", 0): 1.1})) == "**+1.05 [+0.41, +1.69]**"
    assert difference(summarise({("a", 0): 1.0, ("b", 0): -1.1})) == "-0.05 [-13.39, +13.29]"
    assert difference(summarise({("a", 0): 1.0})) == "+1.00" and difference(None) == "–"


# -- the command -------------------------------------------------------------------------------------------


def bench(out: Path, *more: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dnrpipe.cli", "bench-select", "--smoke", "--seeds", "1", "--out", str(out)]
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
    return subprocess.run(
        [*command, "--json", *more],
        capture_output=True, text=True, timeout=800, env=environment, cwd=out.parent, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    pytest.importorskip("bpy")
    pytest.importorskip("mitsuba")
    out = tmp_path_factory.mktemp("bench") / "out"
    done = bench(out)
    assert done.returncode == 0, done.stderr
    return out, json.loads(done.stdout)


def work(out: Path) -> dict[str, int]:
    """Stamps of all that costs work: selections, cells, passes, ray-traced views."""
    return {
        str(p.relative_to(out)): p.stat().st_mtime_ns
        for p in out.rglob("*")
        if p.suffix == ".exr" or (p.suffix == ".json" and p.relative_to(out).parts[0] in ("selections", "cells"))
    }


@pytest.mark.slow
@pytest.mark.robustness
def test_smoke_measures_every_cell_and_says_what_it_took(smoke: tuple[Path, dict[str, Any]]) -> None:
    from PIL import Image

    out, answer = smoke
    assert answer == json.loads((out / "results.json").read_text())
    assert len(answer["cells"]) == 2 * 2 * 3 and answer["commit"] and answer["machine"]["cores"]
    report = (out / "report.md").read_text()
    for cell in answer["cells"]:
        folder = f"emissive_only-{cell['pool']}"
        details = json.loads((out / "cells" / folder / f"{cell['key']}.json").read_text())
        assert cell["psnr"] == pytest.approx(np.mean([test["psnr"] for test in details["tests"]]), abs=1e-4)
        assert sorted(cell["views"]) == details["views"] and len(cell["views"]) == cell["budget"]
        assert details["training"]["step2"]["steps"] == 4 * cell["budget"]
        parts = [cell[f"{part}_seconds"] for part in ("select", "view", "train")]
        assert cell["total_seconds"] == pytest.approx(sum(parts), abs=0.01) and min(parts[1:]) > 0
        assert f" {cell['psnr']:.2f} |" in report
    for name in ("views.png", "seconds.png"):
        assert np.asarray(Image.open(out / name)).std() > 1
    traced = {p.stem for p in (out / "scenes" / "emissive_only-path.dnr" / "raytraced" / "train").glob("*.exr")}
    assert traced == {view for cell in answer["cells"] if cell["pool"] == "path" for view in cell["views"]}


@pytest.mark.slow
@pytest.mark.robustness
def test_a_lost_cell_is_made_again_the_same_and_nothing_else(smoke: tuple[Path, dict[str, Any]]) -> None:
    out, answer = smoke
    before = work(out)
    cell = answer["cells"][-1]
    lost = out / "cells" / f"emissive_only-{cell['pool']}" / f"{cell['key']}.json"
    first = json.loads(lost.read_text())
    lost.unlink()
    done = bench(out, "--jobs", "1")  # how many at a time decides nothing
    assert done.returncode == 0, done.stderr
    after = work(out)
    assert {name for name in after if after[name] != before.get(name)} == {str(lost.relative_to(out))}
    assert json.loads(lost.read_text())["tests"] == first["tests"]  # bit for bit


@pytest.mark.slow
@pytest.mark.robustness
def test_cells_train_equally_long_and_all_views_are_one_cell(smoke: tuple[Path, dict[str, Any]]) -> None:
    """All ten views: nothing is chosen, no agent is trained, and it is one training."""
    out, _ = smoke
    before = work(out)
    request = ("--seconds", "2", "--pools", "dome")
    done = bench(out, *request, "--budgets", "3", "--policies", "random,farthest")
    assert done.returncode == 0, done.stderr
    few = json.loads(done.stdout)["cells"]
    assert len({cell["epochs"] for cell in few}) == 1 and few[0]["epochs"] > 4
    done = bench(out, *request, "--budgets", "10", "--policies", "random,farthest,rl-paper")
    assert done.returncode == 0, done.stderr
    everything = json.loads(done.stdout)["cells"]
    assert len(everything) == 3 and len({cell["key"] for cell in everything}) == 1
    assert not list(out.glob("step1/*/*"))
    assert before.items() <= work(out).items()


def test_bad_requests_are_one_line_and_leave_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from dnrpipe.cli import _main

    for arguments, words in (
        (("--policies", "kmedoid"), "did you mean 'kmedoids'"),
        (("--pools", "ball"), "--pools ball"),
        (("--budgets", "11"), "from 1 to 10"),
        (("--scenes", "none"), "--scenes none"),
        (("--seconds", "0"), "--seconds 0"),
        (("--seeds", "0"), "--seeds 0"),
        (("--preset", "drift"), "unknown preset"),
        (("--set", "cameras.source=sphere"), "use --pools"),
    ):
        out = tmp_path / "out"
        assert _main(["bench-select", "--smoke", "--out", str(out), *arguments]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1 and not out.exists()

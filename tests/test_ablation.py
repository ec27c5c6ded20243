"""`dnrpipe ablate`: rows differ in what they say, tables compute what they claim, and runs resume cell by cell."""

from __future__ import annotations

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
from hypothesis import strategies as st
from tools import paper_tables, result_tables

from dnrpipe.core.errors import UserError
from dnrpipe.core.presets import PAPER, SIZES
from dnrpipe.core.settings import Settings, resolve
from dnrpipe.studies.ablation.ablation_tables import PUBLISHED, Figures, markdown, ratio
from dnrpipe.studies.ablation.rows import GROUPS, ROWS, choose_rows, needs_coarse, settings_of
from dnrpipe.studies.cells.results import spread
from dnrpipe.studies.cells.scenes import BENCHMARK, find_scenes
from dnrpipe.studies.selectbench.bench_select import choose_budgets
from dnrpipe.studies.selectbench.policies import CONTENDERS, choose_policies
from dnrpipe.studies.selectbench.policies import settings_of as bench_settings

CLASSIC = [row for row in ROWS.values() if row.family != "dnr"]


def flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Nested settings as dotted keys."""
    if not isinstance(value, dict):
        return {prefix: value}
    return {k: v for key, part in value.items() for k, v in flat(part, f"{prefix}.{key}".lstrip(".")).items()}


def differences(a: Settings, b: Settings) -> set[str]:
    left, right = flat(a.model_dump(mode="json")), flat(b.model_dump(mode="json"))
    return {key for key in left.keys() | right.keys() if left.get(key) != right.get(key)}


@pytest.mark.parametrize("preset", SIZES)
@pytest.mark.parametrize("row", CLASSIC, ids=lambda row: row.name)
def test_classic_rows_do_not_depend_on_our_model(row: Any, preset: str) -> None:
    """Whatever the preset's own model is, vanilla and the paper stay what they are."""
    base = resolve(preset, {}, environment={})
    step2 = {"epochs": 7, "photometric": "l1", "start": "fresh"}
    ours = {"model": {"width": 40, "aggregator": "residual"}, "finetune": {"step2": step2}}
    changed = resolve(preset, ours, environment={})
    assert settings_of(row, base, {}).model == settings_of(row, changed, {}).model
    assert settings_of(row, base, {}).finetune == settings_of(row, changed, {}).finetune
    assert settings_of(row, base, {}).select == settings_of(row, changed, {}).select


@pytest.mark.parametrize("preset", ["draft", "paper-128"])
@pytest.mark.parametrize("row", [r for r in CLASSIC if r.against], ids=lambda row: row.name)
def test_a_row_differs_from_its_counterpart_in_one_thing(row: Any, preset: str) -> None:
    base = resolve(preset, {}, environment={})
    changed = differences(settings_of(row, base, {}), settings_of(ROWS[row.against], base, {}))
    assert len({key.removesuffix("." + key.rsplit(".", 1)[1]) for key in changed}) == 1, changed


SIZE = {
    *("preset", "passes.bake_size", "raytrace.spp", "raytrace.evaluation_spp"),
    *(f"cameras.{name}" for name in ("train", "val", "test", "width", "height")),
    *("model.texture_size", "model.width", "model.depth", "finetune.step2.perceptual_crop"),
}
"""What may differ between the paper's full size and that of a table."""
LENGTH = {"select.step1.epochs", "finetune.step2.epochs"}
"""The same between presets that are not of the paper's schedule."""


@pytest.mark.parametrize("name", ["paper", "vanilla"])
def test_the_preset_runs_what_the_tables_measure(name: str) -> None:
    """`dnrpipe run --preset paper` and `--preset vanilla` are the rows of these names, but for size; paper-128 and
    vanilla-128 are they."""
    told, small = (resolve(preset, {}, environment={}) for preset in (name, f"{name}-128"))
    rows = {preset: settings_of(ROWS[name], resolve(preset, {}, environment={}), {}) for preset in SIZES}
    assert differences(told, rows["paper"]) <= {"preset"}
    assert differences(small, rows["paper-128"]) <= {"preset"}
    assert differences(told, small) <= SIZE
    for preset, measured in rows.items():
        assert differences(told, measured) <= SIZE | LENGTH, preset
    table = rows["paper-128"]
    assert (table.select.step1.epochs, table.finetune.step2.epochs) == (50, 100)
    assert (table.select.most, table.cameras.train) == (25, 100)


def test_the_benchs_agent_is_the_papers() -> None:
    for preset in ("draft", "paper", "paper-128"):
        base = resolve(preset, {}, environment={})
        agent = bench_settings(CONTENDERS["rl-paper"], base, 25)
        paper = settings_of(ROWS["paper"], base, {})
        assert agent.select.step1.model_dump(exclude={"epochs"}) == paper.select.step1.model_dump(exclude={"epochs"})
        assert agent.model.coarse() == paper.model.coarse()


def test_dnr_gets_as_many_steps_as_both_of_the_papers() -> None:
    base = resolve("paper-128", {}, environment={})
    paper, alone = (settings_of(ROWS[name], base, {}) for name in ("paper", "vanilla-long"))
    assert (
        alone.finetune.step2.epochs * 25 == paper.select.step1.epochs * 100 + paper.finetune.step2.epochs * 25 == 7500
    )


@pytest.mark.parametrize("name", paper_tables.TABLES)
def test_the_commands_of_the_papers_tables_ask_for_what_there_is(name: str) -> None:
    """At 25 of 100 candidates and the whole schedule, with every row or policy that the paper's claims are about."""
    command, *words = paper_tables.TABLES[name].command
    options = dict(zip(words[::2], words[1::2], strict=True))
    assert [path.stem for path in find_scenes(options["--scenes"])] and int(options["--seeds"]) >= 3
    base = resolve(options["--preset"], {}, environment={})
    assert (base.cameras.train, base.select.most, base.cameras.width) == (100, 25, 128)
    if command == "ablate":
        rows = {row.name for row in choose_rows(options["--rows"])}
        claims = {"a": {*PUBLISHED, "vanilla-long", "paper"} - {"full"}}
        claims["c"] = {row for figure in ("fig7a", "fig7b", "fig7c") for row in GROUPS[figure]} - claims["a"]
        assert rows >= claims[name] and (name == "a" or rows.isdisjoint(claims["a"]))  # each row is of one table
    else:
        assert "rl-paper" in {contender.name for contender in choose_policies(options["--policies"])}
        assert choose_budgets(options["--budgets"], 100) == [5, 10, 15, 25, 50, 100]


def test_pieces_of_a_table_add_up_and_others_do_not() -> None:
    whole = json.loads((paper_tables.RESULTS / "paper-steps.json").read_text())
    first = {**whole, "cells": [cell for cell in whole["cells"] if cell["seed"] == 0]}
    again = [{**cell, "psnr": 0.0} for cell in first["cells"] if cell["row"] == "paper"]
    piece = {**whole, "cells": [*again, *({**cell, "seed": 7} for cell in first["cells"])], "seeds": 2}
    both = paper_tables.added(first, piece)
    assert both["seeds"] == 2 and len(both["cells"]) == 2 * len(first["cells"])
    redone = [cell for cell in both["cells"] if cell["psnr"] == 0.0]
    assert [(cell["row"], cell["seed"]) for cell in redone] == [("paper", 0)] * len(again)
    with pytest.raises(ValueError, match="resolution"):
        paper_tables.added(first, {**piece, "resolution": "256x256"})
    with pytest.raises(ValueError, match="precision"):
        paper_tables.added(first, {**piece, "precision": ["bfloat16"]})
    with pytest.raises(ValueError, match="step2_steps"):
        paper_tables.added({**first, "step2_steps": 2500}, {**piece, "step2_steps": 500})


def test_cells_of_another_device_are_told_apart() -> None:
    whole = json.loads((paper_tables.RESULTS / "paper-steps.json").read_text())
    known = [{name: value for name, value in cell.items() if name != "device"} for cell in whole["cells"]]
    cells = {row: [cell for cell in known if cell["row"] == row] for row in ("paper", "vanilla")}
    first = {**whole, "cells": cells["paper"], "device": "cuda"}
    other = {**whole, "cells": cells["vanilla"], "device": "cpu", "command": "another"}
    with pytest.raises(ValueError, match="device"):
        paper_tables.added(first, other)
    both = paper_tables.added(first, other, mixed=True)
    assert (both["device"], both["command"]) == ("cuda", f"{whole['command']}; another")
    assert {cell["device"] for cell in both["cells"] if cell["row"] == "vanilla"} == {"cpu"}
    told = [line for line in markdown(both).splitlines() if "(trained on cpu)" in line]
    assert told and all("DNR (Thies" in line for line in told)
    # The same place trained on the other device changes nothing: the results' own device counts.
    again = {**other, "cells": [{**cell, "psnr": 0.0} for cell in cells["paper"]]}
    kept = paper_tables.added(first, again, mixed=True)["cells"]
    assert len(kept) == len(cells["paper"]) and all(cell["device"] == "cuda" and cell["psnr"] > 0 for cell in kept)
    # And trained on it again, a cell of either device gives way.
    redone = {**both, "cells": [{**cell, "psnr": 0.0} for cell in known if cell["row"] in cells]}
    made = paper_tables.added(both, redone)["cells"]
    assert len(made) == len(both["cells"]) and all(cell["device"] == "cuda" and cell["psnr"] == 0 for cell in made)


def test_the_papers_numbers_are_the_papers() -> None:
    """Implementation details of the paper: weights of the six losses, reward, "RGB absolute loss"."""
    settings = settings_of(ROWS["paper"], resolve("draft", {}, environment={}), {})
    loss = settings.finetune.step2.loss
    assert (loss.photometric, loss.ssim, loss.perceptual) == (1.0, 0.1, 0.1)
    assert (loss.frequency, loss.total_variation, loss.regularisation) == (0.01, 0.001, 0.1)
    assert settings.finetune.step2.photometric == "l1"
    assert settings.model.aggregator == "concat" and settings.model.modalities == "uv+depth+normal"
    assert settings.model.base == "none" and settings.finetune.step2.start == "coarse"
    step1 = settings.select.step1
    assert (step1.reward, step1.reward_scale, step1.q_target) == ("neg-loss", "raw", "plain")
    assert settings.select.policy == "rl-paper" and step1.gamma == PAPER["select"]["step1"]["gamma"] < 1
    vanilla = settings_of(ROWS["vanilla"], resolve("draft", {}, environment={}), {})
    assert vanilla.model.modalities == "uv" and not vanilla.finetune.step2.augment
    assert not needs_coarse(ROWS["vanilla"], vanilla) and needs_coarse(ROWS["paper"], settings)


def test_overrides_hold_for_every_row() -> None:
    base = resolve("draft", {}, environment={})
    for row in CLASSIC:
        epochs = settings_of(row, base, {"finetune": {"step2": {"epochs": 3}}}).finetune.step2.epochs
        assert epochs == 3 or (row.as_long and epochs == 3 + 12 * 2)


@pytest.mark.parametrize("row", [r for r in ROWS.values() if r.family == "dnr"], ids=lambda row: row.name)
def test_our_rows_are_settings_that_can_be(row: Any) -> None:
    base = resolve("draft", {"model": {"base": "baked"}}, environment={})
    settings = settings_of(row, base, {})
    assert differences(settings, base) <= {*flat(dict(row.changes)), "select.policy"}


def test_rows_that_come_to_the_same_are_said_to_be_the_same() -> None:
    made = results({("a", "dnr", 0): 30.0, ("a", "dnr-chain", 0): 30.0, ("a", "dnr-no-chain", 0): 29.0})
    made["cells"][1]["key"] = made["cells"][0]["key"]
    lines = {
        line.split("`")[1]: line for line in markdown(made).split("### Ingredients")[1].splitlines() if "`" in line
    }
    assert "| is `dnr` |" in lines["dnr-chain"] and "| -1.00 |" in lines["dnr-no-chain"]


def test_rows_and_groups_by_name() -> None:
    assert [row.name for row in choose_rows("paper,vanilla")] == ["vanilla", "paper"]
    assert [row.name for row in choose_rows("all")] == list(ROWS)
    assert {name for names in GROUPS.values() for name in names} == set(ROWS)
    with pytest.raises(UserError, match="did you mean 'vanilla'"):
        choose_rows("vanila")
    with pytest.raises(UserError, match="names no row"):
        choose_rows(" , ")


def test_scenes_by_name_and_file(tmp_path: Path) -> None:
    assert [path.stem for path in find_scenes(None)] == list(BENCHMARK)
    (tmp_path / "materials.blend").write_bytes(b"x")
    with pytest.raises(UserError, match="two scenes are named materials"):
        find_scenes(f"materials,{tmp_path / 'materials.blend'}")
    with pytest.raises(UserError, match="--scenes nowhere"):
        find_scenes("nowhere")


def results(values: dict[tuple[str, str, int], float]) -> dict[str, Any]:
    """Results whose PSNR is given per (scene, row, seed) and whose LPIPS is a hundredth of it."""
    cells = [
        {
            "scene": scene, "row": row, "seed": seed, "key": f"{scene}{row}{seed}", "psnr": psnr, "psnr_mask": psnr - 5,
            "ssim": 0.9, "ssim_mask": 0.8, "lpips_vgg": psnr / 100, "lpips_alex": None, "flip": 0.1, "ceiling": 40.0,
            "views": 25, "epochs": 5, "steps": 125, "train_seconds": 9.0, "train_cpu_seconds": 8.0,
            "step1_cpu_seconds": None, "frame_ms": 7.0, "base_ms": None, "commit": "abc",
        }
        for (scene, row, seed), psnr in values.items()
    ]  # fmt: skip
    scenes = list(dict.fromkeys(scene for scene, _, _ in values))
    return {
        "schema": 1, "command": "dnrpipe ablate", "commit": "abc", "dirty": False, "date": "2026-01-02T03:04:05+00:00",
        "machine": {"processor": "p", "cores": 2}, "versions": {"torch": "2"}, "preset": "draft", "budget": 25,
        "resolution": "128x128", "seconds": None, "scenes": scenes, "cells": cells,
    }  # fmt: skip


def test_means_differences_and_ratios_are_paired_by_seed() -> None:
    made = results(
        {("a", "vanilla", 0): 20.0, ("b", "vanilla", 0): 30.0, ("a", "vanilla", 1): 22.0, ("b", "vanilla", 1): 32.0}
        | {("a", "dnr", 0): 25.0, ("b", "dnr", 0): 33.0, ("a", "dnr", 1): 26.0, ("b", "dnr", 1): 38.0}
    )
    figures = Figures(made)
    assert figures.mean("vanilla", "psnr", ["a", "b"]) == [25.0, 27.0]
    assert figures.paired("dnr", "vanilla", "psnr", ["a", "b"]) == [4.0, 5.0]
    assert figures.paired("dnr", "vanilla", "lpips_vgg", ["a"], ratio) == pytest.approx([1.25, 26 / 22])
    text = markdown(made)
    assert "| **mean** | +4.50 ± 0.71 | 1.18 ± 0.01 |" in text  # LPIPS: 1.175 and 1.185
    assert "| a | 21.00 ± 1.41 | 25.50 ± 0.71 | 40.0 |" in text
    assert "LPIPS VGG" in text and "LPIPS Alex" not in text  # which no cell has


def test_a_seed_that_lacks_a_scene_is_in_no_mean() -> None:
    figures = Figures(results({("a", "dnr", 0): 20.0, ("b", "dnr", 0): 30.0, ("a", "dnr", 1): 99.0}))
    assert figures.mean("dnr", "psnr", ["a", "b"]) == [25.0]
    assert figures.mean("dnr", "psnr", ["a"]) == [20.0, 99.0]


@pytest.mark.parametrize(
    ("ours", "verdict"),
    [([-1.0, -1.1, -1.2], "reproduced"), ([0.9, 1.0, 1.1], "the other way"), ([-0.1, 0.2, -0.2], "inside the noise")],
)
def test_the_papers_order_is_judged_by_the_interval_over_pairs(ours: list[float], verdict: str) -> None:
    values = {("a", "paper", seed): 25.0 for seed in range(3)}
    values |= {("a", "paper-uv", seed): 25.0 + gain for seed, gain in enumerate(ours)}
    line = next(line for line in markdown(results(values)).splitlines() if "no aggregator" in line and "-0.28" in line)
    cells = [cell.strip() for cell in line.split("|")[1:-1]]
    assert cells[2] == "3" and cells[6] == verdict
    mean, half = np.mean(ours), 4.302653 * np.std(ours, ddof=1) / np.sqrt(3)
    assert cells[4].strip("*") == f"{mean:+.2f} [{mean - half:+.2f}, {mean + half:+.2f}]"


@given(st.lists(st.floats(-50, 50), min_size=1, max_size=6))
def test_spread_is_mean_and_sample_deviation(values: list[float]) -> None:
    mean, _, deviation = spread(values, 6).partition(" ± ")
    assert math.isclose(float(mean), np.mean(values), abs_tol=1e-6)
    if len(values) > 1:
        assert math.isclose(float(deviation), np.std(values, ddof=1), abs_tol=1e-6)
    else:
        assert not deviation


def test_the_documents_tables_are_made_from_committed_results(tmp_path: Path) -> None:
    (tmp_path / "r.json").write_text(json.dumps(results({("a", "vanilla", 0): 20.0, ("a", "dnr", 0): 25.5})))
    page = tmp_path / "page.md"
    page.write_text("one\n<!-- results r.json -->\nold\n<!-- end -->\ntwo\n<!-- rows -->\n<!-- end -->\n")
    assert result_tables.main(["--check", str(page)]) == 1
    assert result_tables.main([str(page)]) == 0 and result_tables.main(["--check", str(page)]) == 0
    text = page.read_text()
    assert "+5.50" in text and "\nold\n" not in text and text.startswith("one\n") and "| `paper-uv` |" in text
    page.write_text(text.replace("25.50", "26.50"))
    assert result_tables.main(["--check", str(page)]) == 1


def ablate(out: Path, *more: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dnrpipe.cli", "ablate", "--smoke", "--seeds", "1", "--out", str(out), "--json"]
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
    return subprocess.run(
        [*command, *more], capture_output=True, text=True, timeout=800, env=environment, cwd=out.parent, check=False
    )


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    pytest.importorskip("bpy")
    pytest.importorskip("mitsuba")
    out = tmp_path_factory.mktemp("ablation") / "out"
    done = ablate(out)
    assert done.returncode == 0, done.stderr
    return out, json.loads(done.stdout)


def stamps(out: Path) -> dict[str, int]:
    return {str(p.relative_to(out)): p.stat().st_mtime_ns for p in out.rglob("*") if p.suffix in (".json", ".exr")}


def made_by_work(out: Path) -> dict[str, int]:
    """Stamps of all that costs work: cells, step 1, passes, ray-traced views."""
    return {name: at for name, at in stamps(out).items() if name.startswith(("cells/", "step1/")) or ".exr" in name}


@pytest.mark.slow
def test_smoke_measures_what_its_pictures_show(smoke: tuple[Path, dict[str, Any]]) -> None:
    from PIL import Image

    out, answer = smoke
    assert answer == json.loads((out / "results.json").read_text())
    assert [cell["row"] for cell in answer["cells"]] == ["vanilla", "paper"]
    assert answer["commit"] and answer["machine"]["cores"] and answer["versions"]["torch"]
    tables = (out / "tables.md").read_text()
    for cell in answer["cells"]:
        assert f"| `{cell['row']}` |" in tables and f" {cell['psnr']:.2f} |" in tables
        folder = out / "cells" / cell["scene"]
        details = json.loads((folder / f"{cell['key']}.json").read_text())
        assert cell["psnr"] == pytest.approx(np.mean([test["psnr"] for test in details["tests"]]), abs=1e-4)
        assert details["training"]["step2"]["steps"] == 4 * 3 and details["training"]["step2"]["skipped"] == 0
        assert cell["views"] == 3 and cell["train_psnr"] > 5 and cell["frame_ms"] > 0 and cell["train_cpu_seconds"] > 0
        assert (cell["step1_cpu_seconds"] is None) == (cell["row"] == "vanilla")
        shown = [np.asarray(Image.open(folder / f"{name}.png"), np.float64) / 255 for name in ("truth", cell["key"])]
        psnr = -10 * np.log10(np.mean((shown[0] - shown[1]) ** 2))
        middle = details["tests"][len(details["tests"]) // 2]
        assert psnr == pytest.approx(middle["psnr"], abs=0.1)
        assert 5 < middle["psnr"] < middle["ceiling"] + 1
    sheet = Image.open(out / "pictures" / "emissive_only.png")
    assert sheet.width >= 3 * 256 and np.asarray(Image.open(out / "plot.png")).std() > 1


@pytest.mark.slow
def test_a_second_run_does_nothing_and_a_lost_cell_is_made_again_the_same(smoke: tuple[Path, dict[str, Any]]) -> None:
    out, answer = smoke
    before = made_by_work(out)
    assert ablate(out).returncode == 0
    assert made_by_work(out) == before
    lost = out / "cells" / "emissive_only" / f"{answer['cells'][1]['key']}.json"
    first = json.loads(lost.read_text())
    lost.unlink()
    done = ablate(out)
    assert done.returncode == 0, done.stderr
    after = made_by_work(out)
    assert {name for name in before if after[name] != before[name]} == {str(lost.relative_to(out))}
    assert json.loads(lost.read_text())["tests"] == first["tests"]  # bit for bit


@pytest.mark.slow
@pytest.mark.robustness
def test_rows_train_about_the_seconds_asked_for(smoke: tuple[Path, dict[str, Any]]) -> None:
    out, answer = smoke
    done = ablate(out, "--rows", "vanilla,paper", "--seconds", "4")
    assert done.returncode == 0, done.stderr
    cells = {cell["row"]: cell for cell in json.loads(done.stdout)["cells"]}
    assert {cell["key"] for cell in cells.values()}.isdisjoint(cell["key"] for cell in answer["cells"])
    for cell in cells.values():
        assert cell["epochs"] > 4  # of the preset's, a fraction of a second each
        assert 1.3 < cell["train_cpu_seconds"] < 12
    assert cells["paper"]["step1_cpu_seconds"] < cells["paper"]["train_cpu_seconds"] / 2


@pytest.mark.slow
def test_bad_requests_are_one_line_and_leave_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from dnrpipe.cli import _main

    for arguments, words in (
        (("--rows", "vanila"), "did you mean 'vanilla'"),
        (("--scenes", "none"), "--scenes none"),
        (("--seconds", "0"), "--seconds 0"),
        (("--seeds", "0"), "--seeds 0"),
        (("--preset", "drift"), "unknown preset"),
        (("--set", "finetune.epoch=3"), "finetune.epoch"),
        (("--rows", "paper-uv-depth", "--set", "model.output=log"), "output = log"),
        (("--rows", "dnr", "--set", "select.policy=coverage"), "chosen by farthest, random, rl-paper"),
    ):
        out = tmp_path / "out"
        assert _main(["ablate", "--smoke", "--out", str(out), *arguments]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1 and not out.exists()

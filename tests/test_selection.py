"""Stage `select`: when it trains, what it writes, and what makes it stale."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dnrpipe.core.console import Console
from dnrpipe.core.scene_files import read_selection
from dnrpipe.core.settings import Settings, resolve
from dnrpipe.core.workspace import Source, Workspace
from dnrpipe.stages.pipeline import STAGES, fingerprint, run_stage
from dnrpipe.stages.select import progress, select_views
from dnrpipe.stages.stage import Run
from dnrtrain.contract import write_cameras
from dnrtrain.selector.coverage import CoveragePolicy
from dnrtrain.selector.names import UNTRAINED_NAMES

sys.path.insert(0, str(Path(__file__).parent / "trainer"))

import synthetic

BUDGET = 3


def told(policy: str = "kmedoids", budget: int = BUDGET, **changes: Any) -> Settings:
    return resolve(None, {"select": {"budget": budget, "policy": policy}, **changes}, environment={})


COARSE: dict[str, Any] = {"finetune": {"step2": {"start": "coarse"}}}


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    """Eight candidates with passes; of `prepare` only what a choice without training reads."""
    made = Workspace.create(tmp_path / "scene.dnr", Source(path=str(tmp_path / "scene.blend"), sha256="0"))
    views = synthetic.dome(8, 24)
    files, _ = synthetic.write_scene(tmp_path / "made", views)
    for view, file in zip(views, files, strict=True):
        target = made.passes("train", view.name)
        target.parent.mkdir(parents=True, exist_ok=True)
        file.rename(target)
    write_cameras(made.cameras("train"), views, "train")
    made.finish_stage("prepare", fingerprint="f", output="o", seconds=1.0, detail={"views": {"train": 8}})
    return made


def choose(workspace: Workspace, settings: Settings, capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], str]:
    """The stage's own work (its inputs' state is another test's) -> selection.json and what was said."""
    stamp = fingerprint(STAGES["select"], workspace, settings)
    assert stamp is not None
    outcome = select_views(Run(workspace, settings, Console(), "select", "select-0", stamp))
    workspace.finish_stage("select", fingerprint=stamp, output=outcome.output, seconds=0.0, detail=outcome.detail)
    return read_selection(workspace).model_dump(), capsys.readouterr().out


@pytest.mark.parametrize("policy", UNTRAINED_NAMES)
def test_a_choice_without_training(workspace: Workspace, capsys: pytest.CaptureFixture[str], policy: str) -> None:
    left = workspace.checkpoints("step1") / "model.json"
    left.parent.mkdir(parents=True)
    left.write_text("{}")
    found, said = choose(workspace, told(policy), capsys)
    assert f"no training; policy {policy} needs none" in said
    assert not left.parent.exists()  # another policy's model would pass for this one's
    assert found["policy"] == policy and found["budget"] == BUDGET
    assert len(set(found["views"])) == len(found["gains"]) == len(found["why"]) == BUDGET
    if policy not in ("farthest", "random"):
        assert 0 <= found["details"]["uncovered"] < 0.55
    booked = workspace.ledger.read()
    assert [(r.stage, r.name, r.unit) for r in booked] == [("select", "selection", "scene")]


def test_what_makes_a_choice_stale(workspace: Workspace, capsys: pytest.CaptureFixture[str]) -> None:
    """Without training the model does not matter; a start from the coarse model does."""
    choose(workspace, told(), capsys)

    def stamp(**changes: Any) -> str | None:
        return fingerprint(STAGES["select"], workspace, told(**changes))

    assert stamp() == stamp(model={"texture_size": 64}) == workspace.manifest.stages["select"].fingerprint
    assert stamp() != stamp(**COARSE) != stamp(model={"texture_size": 64}, **COARSE)
    assert stamp() != stamp(policy="coverage")
    assert stamp(policy="rl-paper") != stamp(policy="rl-paper", model={"texture_size": 64})


def test_when_step_1_trains() -> None:
    assert [told(p).trains_step1 for p in ("auto", "kmedoids", "random", "rl-paper")] == [False, False, False, True]
    assert all(told(p, **COARSE).trains_step1 for p in ("auto", "rl-paper"))


def test_a_selection_without_reasons_is_read(workspace: Workspace) -> None:
    old = {"policy": "rl-paper", "budget": 2, "seed": 0, "views": ["0001", "0004"], "details": {"reward": "neg-loss"}}
    workspace.selection.write_text(json.dumps(old))
    assert read_selection(workspace).views == ["0001", "0004"]
    from dnrpipe.report.collect import collect

    found = collect(workspace.root).selection
    assert found is not None and [view.name for view in found.views] == old["views"]


NO_BASE: dict[str, Any] = {"base": "none", "guides": True, "output": "display", "filter": 0, "chain": False}


def test_a_choice_beside_a_coarse_model_is_made_once(
    workspace: Workspace, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Step 1 trains beside the views that were chosen already, and its record names them."""
    workspace.scene.mkdir(parents=True)
    (workspace.scene / "frame.json").write_text(synthetic.FRAME.model_dump_json())
    validation = synthetic.dome(1, 24, seed=1)
    write_cameras(workspace.cameras("val"), validation, "val")
    (made,), _ = synthetic.write_scene(workspace.root / "made", validation)
    target = workspace.passes("val", validation[0].name)
    target.parent.mkdir(parents=True)
    made.rename(target)
    monkeypatch.setattr(Run, "effect_plan", SimpleNamespace(model=lambda settings: settings))
    asked: list[int] = []
    first_look = CoveragePolicy.choose

    def choose_auto(self: CoveragePolicy, candidates: Any, budget: int, *rest: Any) -> Any:
        asked.append(budget)
        return first_look(self, candidates, budget, *rest)

    monkeypatch.setattr(CoveragePolicy, "choose", choose_auto)
    select = {"budget": 5, "policy": "auto", "step1": {"epochs": 1}}
    small = {"texture_size": 16, "width": 4, "depth": 1, "stride": 1}
    settings = resolve(None, {"select": select, "model": NO_BASE | small, "device": "cpu", **COARSE}, environment={})
    found, said = choose(workspace, settings, capsys)
    assert "step 2 starts from the coarse model" in said and asked == [5]
    record = json.loads((workspace.checkpoints("step1") / "model.json").read_text())
    assert record["selected"] == found["views"] and record["why"] == found["why"]
    assert [r.name for r in workspace.ledger.read()] == ["selection", "epoch 1"]
    assert progress(workspace, settings) == (1, 1)


def test_too_large_a_budget_is_refused(workspace: Workspace) -> None:
    from dnrpipe.core.errors import UserError

    with pytest.raises(UserError, match="--budget 9: only 8 candidate views exist"):
        select_views(Run(workspace, told("auto", 9), Console(), "select"))


def test_an_unknown_policy_is_refused() -> None:
    from dnrpipe.core.errors import UserError

    with pytest.raises(UserError, match=r"select\.policy.*'auto', 'coverage'"):
        told("best")


def test_the_stage_asks_for_its_inputs(workspace: Workspace) -> None:
    from dnrpipe.core.errors import UserError

    with pytest.raises(UserError, match="run `dnrpipe prepare` first"):
        run_stage("select", Run(workspace, told(), Console()))

"""Stage `select`: when it trains, what it writes, and what makes it stale."""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dnrpipe.core.console import Console
from dnrpipe.core.settings import Settings, resolve
from dnrpipe.core.workspace import Source, Workspace
from dnrpipe.stages.pipeline import STAGES, fingerprint, run_stage
from dnrpipe.stages.select import epochs_of_step1, progress
from dnrpipe.stages.trainer import read_selection
from dnrtrain.contract import write_cameras
from dnrtrain.selector.names import ACTIVE_NAMES
from dnrtrain.settings import ModelSettings

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
    from dnrpipe.stages.select import run

    outcome = run(workspace, settings, Console(), "select-0")
    stamp = fingerprint(STAGES["select"], workspace, settings)
    assert stamp is not None
    workspace.finish_stage("select", fingerprint=stamp, output=outcome.output, seconds=0.0, detail=outcome.detail)
    return read_selection(workspace), capsys.readouterr().out


@pytest.mark.parametrize(
    "policy", ["auto", "coverage", "exchange", "kmedoids", "d-optimal", "dqn", "farthest", "random"]
)
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

    assert stamp() == stamp(model={"width": 8}) == workspace.manifest.stages["select"].fingerprint
    assert stamp() != stamp(**COARSE) != stamp(model={"width": 8}, **COARSE)
    assert stamp() != stamp(policy="coverage")
    assert stamp(policy="rl-paper") != stamp(policy="rl-paper", model={"width": 8})


def test_rl_is_the_alias_of_rl_paper_and_stays_what_it_was() -> None:
    settings = told("rl")
    assert settings.select.policy == "rl-paper" and settings.trains_step1
    recorded = STAGES["select"].settings(settings)
    assert recorded == STAGES["select"].settings(told("rl-paper"))
    assert recorded[1]["policy"] == "rl"  # what older workspaces recorded: their step 1 stays done
    assert set(recorded[1]) == {"budget", "policy", "seed", "step1"}


@pytest.mark.parametrize("policy", ACTIVE_NAMES)
def test_a_policy_with_models_of_its_own(
    workspace: Workspace, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, policy: str
) -> None:
    """Its epochs and its choosing are booked; no epoch goes to the training that step 2 does not start from."""
    import dnrpipe.stages.select

    class Everything:
        """A plan of effects that leaves nothing off: there is no converted scene to plan for."""

        def model(self, model: ModelSettings) -> ModelSettings:
            return model

    monkeypatch.setattr(dnrpipe.stages.select, "plan_of", lambda *_: Everything())
    workspace.scene.mkdir(parents=True)
    (workspace.scene / "frame.json").write_text(synthetic.FRAME.model_dump_json())
    held = synthetic.dome(1, 24, seed=1)
    files, _ = synthetic.write_scene(workspace.root / "made", held)
    workspace.passes("val", held[0].name).parent.mkdir(parents=True)
    files[0].rename(workspace.passes("val", held[0].name))
    write_cameras(workspace.cameras("val"), held, "val")
    small: dict[str, Any] = {"texture_size": 16, "width": 4, "depth": 1}
    active = {"members": 2, "rounds": 2, "epochs": 1}
    settings = resolve(
        None,
        {"select": {"budget": 4, "policy": policy, "active": active}, "model": small},
        environment={},
    )
    found, _ = choose(workspace, settings, capsys)
    assert found["policy"] == policy and found["details"]["start"] == 2
    assert len(set(found["views"])) == len(found["gains"]) == len(found["why"]) == 4
    assert [batch["trained_on"] for batch in found["details"]["batches"]] == [2, 3]
    epochs = {"ensemble": 4, "variance": 2}[policy]
    booked = workspace.ledger.read()
    assert [r.name for r in booked] == [*(f"epoch {n}" for n in range(1, epochs + 1)), "selection"]
    assert all(r.stage == "select" and r.seconds > 0 for r in booked) and epochs_of_step1(settings) == epochs
    again, _ = choose(workspace, settings, capsys)
    assert again == found and len(workspace.ledger.read()) == epochs + 1
    done, wanted = progress(workspace, settings)
    assert done == wanted


def test_settings_of_active_policies_make_only_these_stale() -> None:
    def recorded(policy: str, **changes: Any) -> Any:
        return STAGES["select"].settings(resolve(None, {"select": {"policy": policy, **changes}}, environment={}))

    more = {"active": {"members": 5}}
    assert recorded("ensemble") != recorded("ensemble", **more)
    assert recorded("rl-paper") == recorded("rl-paper", **more) and recorded("auto") == recorded("auto", **more)


def test_when_step_1_trains() -> None:
    assert [told(p).trains_step1 for p in ("auto", "kmedoids", "random", "rl")] == [False, False, False, True]
    assert all(told(p, **COARSE).trains_step1 for p in ("auto", "rl"))


def test_an_older_selection_is_read(workspace: Workspace) -> None:
    old = {"policy": "rl", "budget": 2, "seed": 0, "views": ["0001", "0004"], "details": {"reward": "neg-loss"}}
    workspace.selection.write_text(json.dumps(old))
    assert read_selection(workspace)["views"] == ["0001", "0004"]
    from dnrpipe.report.collect import collect

    found = collect(workspace.root).selection
    assert found is not None and [view.name for view in found.views] == old["views"]


def trace_by_hand(workspace: Workspace, traced: list[list[str]]) -> Any:
    """A stand-in for Mitsuba: the synthetic scene's own pictures of the views asked for, as ray-traced files."""

    def trace(_1: Any, _2: Any, _3: Any, _4: str, views: list[Any]) -> None:
        traced.append([view.name for view in views])
        _, files = synthetic.write_scene(workspace.root / "traced", views)
        for view, file in zip(views, files, strict=True):
            target = workspace.raytraced("train", view.name)
            target.parent.mkdir(parents=True, exist_ok=True)
            file.rename(target)

    return trace


NO_BASE = {"model": {"base": "none", "output": "display", "filter": 0, "chain": False}}


def test_rounds_trace_a_part_and_go_on(
    workspace: Workspace, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import dnrpipe.stages.select

    workspace.scene.mkdir(parents=True)
    (workspace.scene / "frame.json").write_text(synthetic.FRAME.model_dump_json())
    traced: list[list[str]] = []
    monkeypatch.setattr(dnrpipe.stages.select, "trace_round", trace_by_hand(workspace, traced))
    settings = resolve(None, {"select": {"budget": 5, "policy": "auto", "rounds": 3}, **NO_BASE}, environment={})
    found, _ = choose(workspace, settings, capsys)
    assert found["rounds"] == 3 and len(set(found["views"])) == 5
    assert traced == [found["views"][:2], found["views"][:4]]  # never more than the rounds before
    rounds = found["details"]["rounds"]
    assert [one["views"] for one in rounds] == [2, 2, 1]
    for one in rounds[1:]:
        left = one["remaining_error"]
        assert one["error_found"] > 0 and all(a >= b > 0 for a, b in itertools.pairwise(left))
        assert len(left) == one["views"] + 1
    assert [reason.startswith("round 2: ") for reason in found["why"]] == [False, False, True, True, False]
    booked = [(r.stage, r.name) for r in workspace.ledger.read()]
    assert booked == [("select", f"selection {number}") for number in (1, 2, 3)]
    again, _ = choose(workspace, settings, capsys)
    assert again == found


def test_a_choice_beside_a_coarse_model_is_made_once(
    workspace: Workspace, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Step 1 trains with the views that were chosen in rounds, and its record names them."""
    import dnrpipe.stages.select
    from dnrtrain.selector.auto import AutoPolicy

    workspace.scene.mkdir(parents=True)
    (workspace.scene / "frame.json").write_text(synthetic.FRAME.model_dump_json())
    validation = synthetic.dome(1, 24, seed=1)
    write_cameras(workspace.cameras("val"), validation, "val")
    (made,), _ = synthetic.write_scene(workspace.root / "made", validation)
    target = workspace.passes("val", validation[0].name)
    target.parent.mkdir(parents=True)
    made.rename(target)
    traced: list[list[str]] = []
    monkeypatch.setattr(dnrpipe.stages.select, "trace_round", trace_by_hand(workspace, traced))
    monkeypatch.setattr(dnrpipe.stages.select, "plan_of", lambda *_: SimpleNamespace(model=lambda settings: settings))
    asked: list[int] = []
    first_look = AutoPolicy.choose

    def choose_auto(self: AutoPolicy, candidates: Any, budget: int, *rest: Any) -> Any:
        asked.append(budget)
        return first_look(self, candidates, budget, *rest)

    monkeypatch.setattr(AutoPolicy, "choose", choose_auto)
    select = {"budget": 5, "policy": "auto", "rounds": 2, "step1": {"epochs": 1}}
    small = {"texture_size": 16, "width": 4, "depth": 1, "stride": 1}
    settings = resolve(
        None, {"select": select, "model": NO_BASE["model"] | small, "device": "cpu", **COARSE}, environment={}
    )
    found, said = choose(workspace, settings, capsys)
    assert "step 2 starts from the coarse model" in said
    assert asked == [3] and traced == [found["views"][:3]]  # and the second look is another policy's work
    record = json.loads((workspace.checkpoints("step1") / "model.json").read_text())
    assert record["selected"] == found["views"] and record["why"] == found["why"]
    assert [r.name for r in workspace.ledger.read()] == ["selection 1", "selection 2", "epoch 1"]


def test_rounds_make_ray_tracing_count() -> None:
    """What is traced decides what is chosen next; in one round it does not, and nothing is recorded that was not."""
    record = STAGES["select"].settings
    once, twice = told("auto"), told("auto", select={"budget": BUDGET, "policy": "auto", "rounds": 2})
    assert record(once) == [{"budget": BUDGET, "policy": "auto", "seed": 0}]
    assert record(once) == record(once.model_copy(update={"raytrace": once.raytrace.model_copy(update={"spp": 3})}))
    assert record(twice) != record(once)
    assert record(twice) != record(twice.model_copy(update={"raytrace": once.raytrace.model_copy(update={"spp": 3})}))


def test_impossible_rounds_are_refused() -> None:
    from dnrpipe.core.errors import UserError
    from dnrpipe.stages.rounds import check_rounds, portions

    with pytest.raises(UserError, match="--rounds 2: policy kmedoids chooses all views at once; use --policy auto"):
        check_rounds(told("kmedoids").select.model_copy(update={"rounds": 2}))
    with pytest.raises(UserError, match="--rounds 4: --budget 3 has fewer views"):
        check_rounds(told("auto").select.model_copy(update={"rounds": 4}))
    check_rounds(told("coverage").select)
    assert portions(25, 1) == [25] and portions(10, 3) == [4, 7, 10] and portions(3, 3) == [1, 2, 3]


def test_too_large_a_budget_is_refused(workspace: Workspace) -> None:
    from dnrpipe.core.errors import UserError
    from dnrpipe.stages.select import run

    with pytest.raises(UserError, match="--budget 9: only 8 candidate views exist"):
        run(workspace, told("auto", 9), Console(), "select-0")


def test_an_unknown_policy_is_refused() -> None:
    from dnrpipe.core.errors import UserError

    with pytest.raises(UserError, match=r"select\.policy.*'auto', 'coverage'"):
        told("best")


def test_the_stage_asks_for_its_inputs(workspace: Workspace) -> None:
    from dnrpipe.core.errors import UserError

    with pytest.raises(UserError, match="run `dnrpipe prepare` first"):
        run_stage("select", workspace, told(), Console())

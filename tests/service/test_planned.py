"""What a plan predicted against what was spent since."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from tests.plan_record import write_plan

from dnrpipe.core.errors import UserError
from dnrpipe.core.ledger import CostRecord
from dnrpipe.core.settings import resolve
from dnrpipe.core.workspace import Source, Workspace
from dnrpipe.service.models import PlanState
from dnrpipe.service.routes_workspaces import plan_state

MADE = 1_000_000.0


def prediction(views: int, epochs: int) -> dict[str, Any]:
    total = {"expected": 60.0, "low": 48.0, "high": 75.0}
    return {
        "choice": {"views": views, "spp": 16, "epochs": epochs, "steps": views * epochs},
        "seconds": {"select": 2.0, "raytrace": 20.0, "finetune": 38.0, "evaluate": 9.0, "total": total},
        "cpu_seconds": 100.0,
        "psnr": {"expected": 30.0, "low": 29.0, "high": 31.0},
    }


def planned(root: Path, *, chosen: dict[str, Any] | None) -> Workspace:
    workspace = Workspace.create(root, Source(path="/none.blend", sha256="0"))
    write_plan(root, made=MADE, chosen=chosen, settings_default=prediction(25, 40))
    return workspace


def book(workspace: Workspace, stage: Any, moment: float, seconds: float, workers: int = 1) -> None:
    workspace.ledger.append(
        CostRecord(
            time=moment, run="r", stage=stage, purpose="training", unit="view", name="v", seconds=seconds,
            workers=workers,
        )
    )  # fmt: skip


def finish(workspace: Workspace, stage: str, moment: float, seconds: float) -> None:
    workspace.finish_stage(stage, fingerprint="f", output="o", seconds=seconds)
    workspace.manifest.stages[stage].finished = moment


def look(workspace: Workspace, states: dict[str, str], *, views: int = 6, epochs: int = 25) -> PlanState:
    overrides = {
        "select": {"budget": views},
        "raytrace": {"spp": 16},
        "finetune": {"step2": {"epochs": epochs}},
    }
    found = plan_state(workspace, resolve(None, overrides, environment={}), states)
    assert found is not None
    return found


def test_no_plan(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path / "w.dnr", Source(path="/none.blend", sha256="0"))
    assert plan_state(workspace, resolve(None, {}, environment={}), {}) is None


def test_spent_since_it_was_made(tmp_path: Path) -> None:
    """What was before does not count; a stage that has ended counts with its start, one under way with its parts."""
    workspace = planned(tmp_path / "w.dnr", chosen=prediction(6, 25))
    book(workspace, "finetune", MADE - 1, 1000.0)
    finish(workspace, "select", MADE - 50, 500.0)
    book(workspace, "raytrace", MADE + 10, 30.0, workers=2)
    finish(workspace, "raytrace", MADE + 30, 22.0)
    book(workspace, "finetune", MADE + 40, 7.0)
    book(workspace, "finetune", MADE + 41, 8.0)
    found = look(workspace, {"select": "done", "raytrace": "done", "finetune": "partial", "evaluate": "missing"})
    assert [(s.stage, s.predicted, s.spent, s.done) for s in found.stages] == [
        ("select", 2.0, None, True),  # done before
        ("raytrace", 20.0, 22.0, True),
        ("finetune", 38.0, 15.0, False),
        ("evaluate", 9.0, 0.0, False),
    ]
    assert (found.spent, found.total, found.low, found.high) == (37.0, 60.0, 48.0, 75.0)
    assert (found.views, found.spp, found.epochs, found.fits) == (6, 16, 25, True)
    book(workspace, "raytrace", MADE + 60, 40.0)  # it was interrupted: its last run is not all of it
    assert look(workspace, {"raytrace": "done"}).stages[1].spent == 55.0


def test_which_prediction(tmp_path: Path) -> None:
    """The one for the settings in force, be it the choice or the settings as they were; else the choice, which is
    said not to fit."""
    workspace = planned(tmp_path / "w.dnr", chosen=prediction(6, 25))
    found = look(workspace, {}, views=25, epochs=40)
    assert (found.views, found.fits) == (25, True)
    found = look(workspace, {}, views=7)
    assert (found.views, found.fits) == (6, False)
    table = planned(tmp_path / "t.dnr", chosen=None)
    found = look(table, {}, views=7)
    assert (found.views, found.fits) == (25, False)
    noisy = resolve(
        None, {"select": {"budget": 6}, "raytrace": {"spp": 16, "noise": 0.01}, "finetune": {"step2": {"epochs": 25}}},
        environment={},
    )  # fmt: skip
    state = plan_state(workspace, noisy, {})
    assert state is not None and not state.fits  # samples are not what is asked for


@pytest.mark.parametrize("text", ["{", "[]", '{"made": 1}', "[" * 100_000])
def test_damaged(tmp_path: Path, text: str) -> None:
    workspace = planned(tmp_path / "w.dnr", chosen=None)
    (tmp_path / "w.dnr" / "plan" / "plan.json").write_text(text)
    with pytest.raises(UserError, match="dnrpipe plan"):
        plan_state(workspace, resolve(None, {}, environment={}), {})

"""Compares the last plan's prediction with what its stages have cost since."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..core.ledger import total
from ..core.settings import Settings
from ..core.workspace import Workspace
from ..studies.planning.records import RENDERER_STAGES, Choice, read_plan
from .models import PlannedStage, PlanState


def plan_state(workspace: Workspace, settings: Settings, states: Mapping[str, str]) -> PlanState | None:
    """The plan's prediction and the seconds spent since; None without a plan.

    A finished stage counts the wall seconds of its last run, or, if that was interrupted, the ledger's records of its
    parts. A running stage counts the records so far, which leave out the start of processes.

    Args:
        workspace: whose plan, ledger and manifest are read.
        settings: in force; the prediction for these comes first.
        states: of the stages, by name.

    Raises:
        UserError: the plan's file is damaged.
    """
    plan = read_plan(workspace.root)
    if plan is None:
        return None
    known = [found for found in (plan.carried_out, plan.chosen, plan.settings_default) if found is not None]
    prediction = next((found for found in known if _fits(found.choice, settings)), known[0])
    seconds, choice = prediction.seconds, prediction.choice
    since = [record for record in workspace.ledger.read() if record.time >= plan.made]
    stages = []
    for stage in (*RENDERER_STAGES, "evaluate"):
        record = workspace.manifest.stages.get(stage)
        done = states.get(stage) == "done"
        spent: float | None = total(r for r in since if r.stage == stage).wall_seconds
        if record is not None and record.finished >= plan.made:
            spent = max(spent, record.seconds)
        elif done and not spent:
            spent = None
        stages.append(PlannedStage(stage=stage, predicted=getattr(seconds, stage), spent=spent, done=done))
    return PlanState(
        made=plan.made,
        **choice.model_dump(include={"views", "spp", "epochs"}),
        fits=_fits(choice, settings),
        stages=stages,
        total=seconds.total.expected,
        low=seconds.total.low,
        high=seconds.total.high,
        spent=sum(stage.spent or 0.0 for stage in stages if stage.stage in RENDERER_STAGES),
    )


def _fits(choice: Choice, settings: Settings) -> bool:
    wanted: tuple[Any, ...] = (settings.select.budget, settings.raytrace.spp, settings.finetune.step2.epochs)
    targets = settings.raytrace.noise is not None or settings.raytrace.time is not None
    return not targets and wanted == (choice.views, choice.spp, choice.epochs)

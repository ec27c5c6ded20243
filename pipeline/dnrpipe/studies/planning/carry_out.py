"""Carrying a plan out: select and ray-trace, then train for the time that is really left.

A forecast of ray tracing is off by some percent either way; what it was off is given to training, or taken from it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from dnrtrain.atomic import write_json

from ...core.ledger import StageName, total
from ...core.scene_files import split_views
from ...core.units import duration
from .choose import STEPS, Predictor, cheapest_of_the_best
from .make_plan import make_predictor, plan_path
from .pilot import read_pilot
from .quality import Prior, load_prior
from .records import Choice, Prediction

if TYPE_CHECKING:
    from ...stages.session import Session

FILLED = 0.97
"""Part of the time left that training is expected to take: being late is worse than a step fewer."""


def apply(session: Session, record: dict[str, Any], prior: Prior | None = None) -> dict[str, Any]:
    """Run the stages with the plan's choice -> the record with ``carried_out``, the choice and its prediction once the
    steps fit the time left, and ``actual``, what it took and gave; ``plan/plan.json`` holds it. prior: by default the
    package's.
    """
    workspace = session.workspace
    before = len(workspace.ledger.read())
    names: list[StageName] = ["select", "raytrace", "finetune"]
    if split_views(workspace).get("test"):
        names.append("evaluate")
    session.adopt(overrides_of(record))
    session.stages(*names[:2])
    record = steps_that_fit(session, record, prior or load_prior())
    session.adopt(overrides_of(record))
    write_json(plan_path(workspace), record)  # after Ctrl-C the same training goes on
    session.stages(*names[2:])
    answers = session.answers
    made = {name: answers[name].get("seconds", 0.0) if answers[name]["ran"] else 0.0 for name in names}
    spent = workspace.ledger.read()[before:]
    actual: dict[str, Any] = {
        "seconds": {**made, "total": sum(made[name] for name in names[:3])},
        "cpu_seconds": total(r for r in spent if r.purpose == "training").cpu_seconds,
        "ran": {name: answers[name]["ran"] for name in names},
        "psnr": answers.get("evaluate", {}).get("mean", {}).get("psnr"),
    }
    record = record | {"actual": actual}
    write_json(plan_path(workspace), record)
    return record


def overrides_of(record: dict[str, Any]) -> dict[str, Any]:
    """The settings that carry out a plan's choice, as it was made or as it is carried out."""
    choice = (record.get("carried_out") or record["chosen"])["choice"]
    return {
        "select": {"budget": choice["views"], "policy": record["policy"]},
        "raytrace": {"spp": choice["spp"]},
        "finetune": {"step2": {"epochs": choice["epochs"]}},
    }


def steps_within(predictor: Predictor, choice: Choice, seconds: float) -> Prediction:
    """The choice of the same views and samples with the highest expected PSNR whose training is expected to last
    ``seconds`` at most: one pass over the views at least. More steps than that may be worse where views are noisy."""
    per_epoch = predictor.choice(choice.views, choice.spp, 1).steps
    one, two = (predictor.wall.finetune(n * per_epoch, n) for n in (1, 2))
    most = max(1, 1 + math.floor((seconds - one) / (two - one)))  # time is a straight line in steps
    epochs = {most, *(n for n in (round(steps / per_epoch) for steps in STEPS) if 1 <= n < most)}
    found = [predictor.predict(predictor.choice(choice.views, choice.spp, n * per_epoch)) for n in epochs]
    return cheapest_of_the_best(found)


def steps_that_fit(session: Session, record: dict[str, Any], prior: Prior) -> dict[str, Any]:
    """The record with ``carried_out`` where a plan spends a time; else, with a wanted PSNR or where all was traced by
    an earlier run, the record as it is."""
    wanted, answers = record["wanted"]["seconds"], session.answers
    pilot = read_pilot(session.workspace)
    if wanted is None or record["wanted"]["psnr"] is not None or not answers["raytrace"]["ran"] or pilot is None:
        return record
    predictor = make_predictor(session.workspace, session.settings, pilot, prior)
    chosen = Prediction.model_validate(record["chosen"])
    select = answers["select"]["seconds"] if answers["select"]["ran"] else 0.0
    left = wanted - select - answers["raytrace"]["seconds"]
    found = steps_within(predictor, chosen.choice, FILLED * left)
    session.console.say(
        f"{duration(max(0.0, left))} of {duration(wanted)} are left for training: {found.choice.steps} steps"
        f" ({chosen.choice.steps} were planned)"
    )
    return record | {"carried_out": found.model_dump(mode="json")}

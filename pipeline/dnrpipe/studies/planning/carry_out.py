"""Carrying a plan out: select and ray-trace, then train for the time that is really left.

A forecast of ray tracing is off by some percent either way; what it was off is given to training, or taken from it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from ...core.ledger import StageName, total
from ...core.scene_files import split_views
from ...core.units import duration
from .choose import STEPS, Predictor, cheapest_of_the_best
from .make_plan import make_predictor
from .pilot import read_pilot
from .quality import Prior, load_prior
from .records import Actual, Choice, Plan, Prediction, write_plan

if TYPE_CHECKING:
    from ...stages.session import Session

FILLED = 0.97
"""Part of the time left that training is expected to take: being late is worse than a step fewer."""


def apply(session: Session, plan: Plan, prior: Prior | None = None) -> Plan:
    """Run the stages with the plan's choice and return the plan as it was carried out, which is written, too.

    ``carried_out`` is the choice once its steps fit the time left; ``actual`` is what it took and gave. The session
    adopts the plan's settings. prior: by default the package's.
    """
    workspace = session.workspace
    before = len(workspace.ledger.read())
    names: list[StageName] = ["select", "raytrace", "finetune"]
    if split_views(workspace).get("test"):
        names.append("evaluate")
    session.adopt(overrides_of(plan))
    session.stages(*names[:2])
    plan = steps_that_fit(session, plan, prior or load_prior())
    session.adopt(overrides_of(plan))
    write_plan(workspace.root, plan)  # after Ctrl-C the same training goes on
    session.stages(*names[2:])
    answers = session.answers
    seconds = {name: answers[name].get("seconds", 0.0) if answers[name]["ran"] else 0.0 for name in names}
    spent = workspace.ledger.read()[before:]
    actual = Actual(
        seconds={**seconds, "total": sum(seconds[name] for name in names[:3])},
        cpu_seconds=total(r for r in spent if r.purpose == "training").cpu_seconds,
        ran={name: answers[name]["ran"] for name in names},
        psnr=answers.get("evaluate", {}).get("mean", {}).get("psnr"),
    )
    plan = plan.model_copy(update={"actual": actual})
    write_plan(workspace.root, plan)
    return plan


def overrides_of(plan: Plan) -> dict[str, Any]:
    """The settings that carry out a plan's choice, as it was made or as it is carried out."""
    found = plan.carried_out or plan.chosen
    assert found is not None  # a plan without a choice is not carried out
    return {
        "select": {"budget": found.choice.views, "policy": plan.policy},
        "raytrace": {"spp": found.choice.spp, "noise": None, "time": None},  # the samples are the goal now
        "finetune": {"step2": {"epochs": found.choice.epochs}},
    }


def steps_within(predictor: Predictor, choice: Choice, seconds: float) -> Prediction:
    """The same views and samples with the steps of the highest expected PSNR within ``seconds`` of training.

    That is one pass over the views at least. More steps may be worse where views are noisy.
    """
    per_epoch = predictor.choice(choice.views, choice.spp, 1).steps
    one, two = (predictor.wall.finetune(n * per_epoch, n) for n in (1, 2))
    most = max(1, 1 + math.floor((seconds - one) / (two - one)))  # time is a straight line in steps
    epochs = {most, *(n for n in (round(steps / per_epoch) for steps in STEPS) if 1 <= n < most)}
    found = [predictor.predict(predictor.choice(choice.views, choice.spp, n * per_epoch)) for n in epochs]
    return cheapest_of_the_best(found)


def steps_that_fit(session: Session, plan: Plan, prior: Prior) -> Plan:
    """The plan with ``carried_out``; as it is without a wanted time, with a wanted PSNR, or if all was traced."""
    wanted, answers = plan.wanted.seconds, session.answers
    pilot = read_pilot(session.workspace)
    if wanted is None or plan.wanted.psnr is not None or not answers["raytrace"]["ran"] or pilot is None:
        return plan
    assert plan.chosen is not None  # a time chooses
    choice = plan.chosen.choice
    predictor = make_predictor(session.workspace, session.settings, pilot, prior)
    select = answers["select"]["seconds"] if answers["select"]["ran"] else 0.0
    left = wanted - select - answers["raytrace"]["seconds"]
    found = steps_within(predictor, choice, FILLED * left)
    session.console.say(
        f"{duration(max(0.0, left))} of {duration(wanted)} are left for training: {found.choice.steps} steps"
        f" ({choice.steps} were planned)"
    )
    return plan.model_copy(update={"carried_out": found})

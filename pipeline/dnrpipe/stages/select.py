"""Stage `select`: which candidates are ray-traced; with the coarse model (step 1) where anything needs it."""

from __future__ import annotations

import functools
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING

from dnrtrain.atomic import write_json
from dnrtrain.contract import View
from dnrtrain.events import Selected
from dnrtrain.selector.names import ACTIVE_NAMES, TRAINED_NAMES

from ..core.console import Bar, Console
from ..core.errors import UserError
from ..core.ledger import CostRecord
from ..core.scene_files import split_views
from ..core.settings import Settings
from ..core.workspace import Workspace, digest, file_sha256
from ..effects.store import plan_of
from .pipeline import STAGES, fingerprint
from .rounds import check_rounds, go_on, portions, trace_round
from .stage import Outcome
from .trainer import epochs_done, follow, load, torch_device

if TYPE_CHECKING:
    from dnrtrain.selector.protocol import Choice, Policy
    from dnrtrain.selector.sightings import Sightings


def run(workspace: Workspace, settings: Settings, console: Console, run_id: str) -> Outcome:
    """Choose ``budget`` views and write ``selection.json``; train the coarse DNR on the way where it is wanted."""
    views = split_views(workspace)["train"]
    check_budget(settings.select.budget, len(views))
    check_rounds(settings.select)
    if settings.trains_step1:
        chosen = _train_and_choose(workspace, settings, console, run_id, views)
        made: list[object] = [chosen.views, file_sha256(workspace.checkpoints("step1") / "model.safetensors")]
    else:
        chosen = _choose(workspace, settings, console, run_id, views)
        made = [chosen.views]
    write_json(
        workspace.selection,
        {
            "policy": chosen.policy,
            "budget": settings.select.budget,
            "seed": settings.select.seed,
            "rounds": settings.select.rounds,
            "views": chosen.views,
            "gains": chosen.gains,
            "why": chosen.why,
            "details": chosen.details,
        },
    )
    return Outcome(digest(made), {"policy": chosen.policy, "views": chosen.views})


def progress(workspace: Workspace, settings: Settings) -> tuple[int, int]:
    """(epochs trained, epochs wanted); without training (1 or 0, 1)."""
    there = workspace.selection.exists()
    if not settings.trains_step1:
        return int(there), 1
    return epochs_done(workspace.checkpoints("step1"), settings.select.step1.epochs, there)


def check_budget(budget: int, candidates: int) -> None:
    """Raises UserError when more views are wanted than there are."""
    if budget > candidates:
        raise UserError(
            f"--budget {budget}: only {candidates} candidate views exist; lower the budget or prepare more"
            f" (`dnrpipe prepare --views {budget}`)"
        )


def rule_of(settings: Settings) -> Policy | None:
    """The policy, with its weights where they are named; None for one that step 1 must train."""
    from dnrtrain.selector.policies import untrained

    select = settings.select
    if select.policy == "dqn" and select.weights:
        from dnrtrain.selector.learned import DqnPolicy

        return DqnPolicy(Path(select.weights))
    return untrained(select.policy)


def _choose(workspace: Workspace, settings: Settings, console: Console, run_id: str, views: list[View]) -> Selected:
    policy = settings.select.policy
    console.say(f"select: no training; policy {policy} needs none, and step 2 starts fresh")
    rule = rule_of(settings)
    assert rule is not None  # settings.trains_step1 is False
    choice = _choose_by(rule, workspace, settings, console, run_id, views)
    # A model of another policy's run would pass for this one's in the report.
    if workspace.checkpoints("step1").exists():
        shutil.rmtree(workspace.checkpoints("step1"))
    return Selected([views[i].name for i in choice.views], policy, choice.details, choice.gains, choice.why)


def _choose_by(
    rule: Policy, workspace: Workspace, settings: Settings, console: Console, run_id: str, views: list[View]
) -> Choice:
    """The rule's choice, in as many rounds as are wanted."""
    import numpy as np

    from dnrtrain.selector.protocol import Candidates

    select = settings.select
    stages = portions(select.budget, select.rounds)
    clock, cpu = time.monotonic(), time.process_time()
    positions = np.stack([view.position for view in views])
    directions = np.stack([-view.matrix[:3, 2] for view in views])
    sightings = look(workspace, console, views) if rule.looks else None
    candidates = Candidates(positions, directions, sightings)
    choice: Choice | None = None
    for number, budget in enumerate(stages, start=1):
        if choice is not None:
            _book(workspace, run_id, f"selection {number - 1}", *_since(clock, cpu))
            trace_round(workspace, settings, console, run_id, [views[i] for i in choice.views])
            clock, cpu = time.monotonic(), time.process_time()
        title = f"choosing by {select.policy}" + (f", round {number} of {len(stages)}" if len(stages) > 1 else "")
        with console.bar(title, len(views) * rule.effort) as bar:
            tick = functools.partial(_advance, bar)
            if choice is None:
                choice = rule.choose(candidates, budget, select.seed, tick)
            else:
                names = [views[i] for i in choice.views]
                traced = load(workspace, names, "train", raytraced=True, base=settings.model.base)
                choice = go_on(candidates, choice, traced, budget, tick)
            tick(bar.total)
    assert choice is not None  # there is at least one round
    _book(workspace, run_id, "selection" if len(stages) == 1 else f"selection {len(stages)}", *_since(clock, cpu))
    return choice


def _advance(bar: Bar, weighed: int) -> None:
    bar.advance(min(weighed, bar.total - bar.done))  # a policy's effort is an estimate


def _since(clock: float, cpu: float) -> tuple[float, float]:
    """Wall and processor seconds since ``clock`` (monotonic) and ``cpu`` (process time)."""
    return time.monotonic() - clock, time.process_time() - cpu


def _book(workspace: Workspace, run_id: str, name: str, seconds: float, cpu_seconds: float) -> None:
    """Book what choosing took."""
    workspace.ledger.append(
        CostRecord(
            time=time.time(),
            run=run_id,
            stage="select",
            purpose="training",
            unit="scene",
            name=name,
            seconds=seconds,
            cpu_seconds=cpu_seconds,
            device="cpu",
        )
    )


def epochs_of_step1(settings: Settings) -> int:
    """Epochs that step 1 trains, those of the policy's own models included."""
    select = settings.select
    if select.policy not in ACTIVE_NAMES:
        return select.step1.epochs
    from dnrtrain.selector.active import active_epochs

    own = active_epochs(select.policy, select.active, select.budget)
    return own + (select.step1.epochs if settings.starts_coarse or not own else 0)


def _train_and_choose(
    workspace: Workspace, settings: Settings, console: Console, run_id: str, views: list[View]
) -> Selected:
    import numpy as np

    from dnrtrain.step1 import run_step1

    select = settings.select
    if select.policy not in TRAINED_NAMES:
        console.say(f"select: policy {select.policy} needs no training, but step 2 starts from the coarse model")
    rule = rule_of(settings)
    choice = None if rule is None else _choose_by(rule, workspace, settings, console, run_id, views)
    sightings = look(workspace, console, views) if select.policy == "fisher" else None
    validation = split_views(workspace)["val"]
    stamp = fingerprint(STAGES["select"], workspace, settings)
    assert stamp is not None  # its inputs were required
    chosen: Selected | None = None
    events = run_step1(
        load(workspace, views, "train"),
        load(workspace, validation, "val") if validation else None,
        np.stack([view.position for view in views]),
        plan_of(workspace, settings).model(settings.model).coarse(),
        select.step1,
        policy=select.policy,
        budget=select.budget,
        seed=select.seed,
        device=torch_device(settings),
        checkpoints=workspace.checkpoints("step1"),
        fingerprint=stamp,
        sightings=sightings,
        choice=choice,
        active=select.active,
        coarse=settings.starts_coarse,
    )
    epochs = epochs_of_step1(settings)
    for event in follow(events, "select", epochs, workspace, console, run_id):
        if isinstance(event, Selected):
            chosen = event
            if event.seconds and choice is None:  # 0 where a finished run was found
                _book(workspace, run_id, "selection", event.seconds, event.cpu_seconds)
    assert chosen is not None  # run_step1 ends with Selected
    return chosen


def look(workspace: Workspace, console: Console, views: list[View]) -> Sightings:
    """What the candidates see, from their pass files."""
    from dnrtrain.selector.sightings import read_sightings

    with console.bar("what candidates see", len(views)) as bar:
        return read_sightings([workspace.passes("train", view.name) for view in views], views, tick=bar.advance)

"""Stage `select`: which candidates are ray-traced; with the coarse model (step 1) where anything needs it."""

from __future__ import annotations

import shutil
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from dnrtrain.contract import View
from dnrtrain.events import Selected
from dnrtrain.records import Selection, write
from dnrtrain.selector.policies import untrained
from dnrtrain.selector.protocol import Candidates

from ..core.console import Console
from ..core.errors import UserError
from ..core.scene_files import split_views
from ..core.settings import Settings
from ..core.workspace import Workspace, digest, file_sha256
from .prepare import draw_missing, needed_passes
from .stage import Outcome, Run
from .trainer import epochs_done, follow, load, torch_device
from .worth import worth

if TYPE_CHECKING:
    from dnrtrain.selector.protocol import Choice, Policy
    from dnrtrain.selector.visibility import SurfaceVisibility


def select_views(run: Run) -> Outcome:
    """Choose ``budget`` views and write ``selection.json``; train the coarse DNR on the way where it is wanted."""
    workspace = run.workspace
    views = split_views(workspace)["train"]
    check_budget(run.settings.select.budget, len(views))
    details: dict[str, Any] = {}
    if run.settings.select.budget == "auto":
        require_baked(run.settings, "--budget auto")
        found = worth(run, len(views))
        details["worth"] = found.model_dump()
        run.console.say(f"select: {found.told}")
        run = replace(run, settings=run.settings.with_budget(found.views))
    elif run.settings.select.budget == 0:
        require_baked(run.settings, "--budget 0")
        run.console.say("select: no views (--budget 0); the shipped corrector renders as it is")
    settings = run.settings
    draw_missing(run, needed_passes(settings))
    if settings.select.budget == 0:
        chosen = Selection(policy=settings.select.policy, budget=0, seed=settings.select.seed, views=[])
        made: list[object] = [[]]
    elif settings.trains_step1:
        chosen = _train_and_choose(run, views)
        made = [chosen.views, file_sha256(workspace.checkpoints("step1") / "model.safetensors")]
    else:
        chosen = _choose(run, views)
        made = [chosen.views]
    # A copy: records write what they were given, and a default that was filled later is not among it.
    chosen = chosen.model_copy(update={"details": {**chosen.details, **details}})
    write(workspace.selection, chosen)
    return Outcome(digest(made), {"policy": chosen.policy, "views": chosen.views})


def progress(workspace: Workspace, settings: Settings) -> tuple[int, int]:
    """(epochs trained, epochs wanted); without training (1 or 0, 1)."""
    there = workspace.selection.exists()
    if not settings.trains_step1:
        return int(there), 1
    return epochs_done(workspace.checkpoints("step1"), settings.select.step1.epochs, there)


def require_baked(settings: Settings, option: str) -> None:
    """Raises UserError: the shipped corrector corrects baked light. option: what asked for it."""
    if settings.model.base != "baked":
        raise UserError(
            f"{option} renders with the shipped corrector, which corrects baked light, and model.base ="
            f" {settings.model.base}; type --set model.base=baked"
        )


def check_budget(budget: int | Literal["auto"], candidates: int) -> None:
    """Raises UserError when more views are wanted than there are."""
    if budget != "auto" and budget > candidates:
        raise UserError(
            f"--budget {budget}: only {candidates} candidate views exist; lower the budget or prepare more"
            f" (`dnrpipe prepare --views {budget}`)"
        )


def _choose(run: Run, views: list[View]) -> Selection:
    workspace, policy = run.workspace, run.settings.select.policy
    run.console.say(f"select: no training; policy {policy} needs none")
    rule = untrained(policy)
    assert rule is not None  # settings.trains_step1 is False
    choice = _choose_by(rule, run, views)
    # A model of another policy's run would pass for this one's in the report.
    if workspace.checkpoints("step1").exists():
        shutil.rmtree(workspace.checkpoints("step1"))
    return choice.selection([view.name for view in views], policy, run.settings.select.seed)


def _choose_by(rule: Policy, run: Run, views: list[View]) -> Choice:
    """The rule's choice; what it took is booked."""
    select = run.settings.select
    clock, cpu = time.monotonic(), time.process_time()
    candidates = Candidates.of_views(views, look(run.workspace, run.console, views) if rule.needs_visibility else None)
    with run.console.bar(f"choosing by {select.policy}", len(views) * rule.effort) as bar:

        def tick(weighed: int) -> None:
            bar.advance(min(weighed, bar.total - bar.done))  # a policy's effort is an estimate

        choice = rule.choose(candidates, select.most, select.seed, tick)
        tick(bar.total)
    _book(run, time.monotonic() - clock, time.process_time() - cpu)
    return choice


def _book(run: Run, seconds: float, cpu_seconds: float) -> None:
    run.book("training", "scene", "selection", seconds, cpu_seconds=cpu_seconds, device="cpu")


def _train_and_choose(run: Run, views: list[View]) -> Selection:
    from dnrtrain.step1 import run_step1

    workspace, settings, select = run.workspace, run.settings, run.settings.select
    rule = untrained(select.policy)
    choice: Choice | None = None
    if rule is not None:
        run.console.say(f"select: policy {select.policy} needs no training, but step 2 starts from the coarse model")
        choice = _choose_by(rule, run, views)
    validation = split_views(workspace)["val"]
    chosen: Selection | None = None
    events = run_step1(
        load(workspace, views, "train"),
        load(workspace, validation, "val") if validation else None,
        run.effect_plan.model(settings.model),
        select.step1,
        policy=select.policy,
        budget=select.most,
        seed=select.seed,
        device=torch_device(settings),
        checkpoints=workspace.checkpoints("step1"),
        fingerprint=run.fingerprint,
        choice=choice,
    )
    for event in follow(run, events, select.step1.epochs):
        if isinstance(event, Selected):
            chosen = event.selection
            if event.seconds and choice is None:  # 0 where a finished run was found
                _book(run, event.seconds, event.cpu_seconds)
    assert chosen is not None  # run_step1 ends with Selected
    return chosen


def look(workspace: Workspace, console: Console, views: list[View]) -> SurfaceVisibility:
    """What the candidates see, from their pass files."""
    from dnrtrain.selector.visibility import read_visibility

    with console.bar("what candidates see", len(views)) as bar:
        return read_visibility([workspace.passes("train", view.name) for view in views], views, tick=bar.advance)

"""Selection in rounds: trace a part of the budget, look where the base image is wrong there, choose on.

All of it is stage `select`: what comes out is a function of the candidates' passes and of the settings of selection and
ray tracing. Traced files are `raytrace-selected`'s own, made by its code and booked as its costs, so that stage finds
them done; a run that was interrupted finds them, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dnrtrain.contract import View

from ..core.console import Console
from ..core.errors import UserError
from ..core.settings import SelectSettings, Settings
from ..core.workspace import Workspace
from .base_images import base_views
from .raytrace import trace_views

if TYPE_CHECKING:
    from dnrtrain.dataset import ViewSet
    from dnrtrain.selector.protocol import Candidates, Choice, Tick

LOOKING_AGAIN = "auto"
"""The policy that can go on from views that are given, with errors that are known."""


def check_rounds(select: SelectSettings) -> None:
    """Raises UserError: the policy chooses all at once, or there are more rounds than views."""
    if select.rounds > 1 and select.policy != LOOKING_AGAIN:
        raise UserError(
            f"--rounds {select.rounds}: policy {select.policy} chooses all views at once;"
            f" use --policy {LOOKING_AGAIN}, or --rounds 1"
        )
    if select.rounds > select.budget:
        raise UserError(f"--rounds {select.rounds}: --budget {select.budget} has fewer views; lower --rounds")


def portions(budget: int, rounds: int) -> list[int]:
    """How many views are chosen after each round: evenly spread, the last is ``budget``."""
    return [-(-budget * done // rounds) for done in range(1, rounds + 1)]


def trace_round(workspace: Workspace, settings: Settings, console: Console, run_id: str, views: list[View]) -> None:
    """Ray-trace the views that are not on disk yet, with their base images."""
    told: dict[str, Any] = {"views": views, "split": "train", "stage": "raytrace", "purpose": "training"}
    trace_views(workspace, settings, console, run_id, spp=settings.raytrace.spp, **told)
    base_views(workspace, settings, console, run_id, **told)


def go_on(candidates: Candidates, chosen: Choice, traced: ViewSet, budget: int, tick: Tick | None = None) -> Choice:
    """``chosen`` completed to ``budget`` by a second look at ``traced``: its views with ray-traced targets."""
    from dnrtrain.selector.exchange import second_look
    from dnrtrain.selector.protocol import Choice
    from dnrtrain.selector.remaining import cell_errors

    assert candidates.sightings is not None  # its policy looks
    errors = cell_errors(traced, candidates.sightings.grid)
    rest = second_look(candidates, chosen.views, budget, errors, tick)
    known = chosen.details.get("rounds") or [{"views": len(chosen.views), **chosen.details}]
    details = dict(rest.details)
    this = {"views": len(rest.views), "error_found": errors.mean, "remaining_error": details.pop("remaining_error", [])}
    return Choice(
        [*chosen.views, *rest.views],
        [*chosen.gains, *rest.gains],
        [*chosen.why, *(f"round {len(known) + 1}: {reason}" for reason in rest.why)],
        {**details, "rounds": [*known, this]},
    )

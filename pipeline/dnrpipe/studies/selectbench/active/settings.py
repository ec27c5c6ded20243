"""How much active learning trains; imports no torch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ActiveSettings:
    """Of policies that train small renderers on the views chosen so far.

    Args:
        members: renderers of policy ensemble, at least 2; variance trains one.
        rounds: batches in which views are added to the first third of the budget.
        epochs: each renderer's passes over the views chosen so far.
    """

    members: int = 3
    rounds: int = 2
    epochs: int = 10

"""What every selection policy has in common: what it may know, and what it answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from ..contract import ContractError, View
from ..records import Selection

if TYPE_CHECKING:
    from .visibility import SurfaceVisibility


Tick = Callable[[int], object]
"""Told how many candidates were weighed since the last call."""


@dataclass(frozen=True)
class Candidates:
    """N views to choose from.

    positions, directions: camera centres and unit viewing directions in world space, float64 [N, 3] each.
    visibility: what each of them sees of the surface, or None where nobody looked.
    facts: what a policy knows of each beside that, [N, ...], or None.
    """

    positions: np.ndarray
    directions: np.ndarray
    visibility: SurfaceVisibility | None = None
    facts: np.ndarray | None = None

    def __post_init__(self) -> None:
        count = len(self.positions)
        if np.shape(self.positions) != (count, 3) or np.shape(self.directions) != (count, 3):
            raise ContractError(
                f"camera positions of shape {np.shape(self.positions)} and directions of shape"
                f" {np.shape(self.directions)}: must be [N, 3] both"
            )
        if self.visibility is not None and len(self.visibility) != count:
            raise ContractError(
                f"{count} cameras but the surface visibility of {len(self.visibility)} views: must agree"
            )

    @staticmethod
    def of_views(views: Sequence[View], visibility: SurfaceVisibility | None = None) -> Candidates:
        """The cameras of ``views`` as candidates."""
        positions = np.stack([view.position for view in views])
        directions = np.stack([-view.matrix[:3, 2] for view in views])  # a camera looks along its -Z
        return Candidates(positions, directions, visibility)

    def __len__(self) -> int:
        return len(self.positions)

    def take(self, order: np.ndarray) -> Candidates:
        """The candidates at ``order``, in that order."""
        visibility = None if self.visibility is None else self.visibility.take(order)
        facts = None if self.facts is None else self.facts[order]
        return Candidates(self.positions[order], self.directions[order], visibility, facts)


@dataclass(frozen=True)
class Choice:
    """An ordered selection of distinct views.

    views: indices of candidates. gains: what each added when it was taken, in the policy's own measure (which
    ``details["measure"]`` names). why: one plain sentence per view. details: anything JSON-able.
    """

    views: list[int]
    gains: list[float]
    why: list[str]
    details: dict[str, Any] = field(default_factory=dict)

    def selection(self, names: Sequence[str], policy: str, seed: int) -> Selection:
        """The record of the choice. names: of all candidates."""
        return Selection(
            policy=policy,
            budget=len(self.views),
            seed=seed,
            views=[names[i] for i in self.views],
            gains=self.gains,
            why=self.why,
            details=self.details,
        )


class Policy(Protocol):
    """A policy that needs no training.

    needs_visibility: whether it uses `Candidates.visibility`.
    effort: how often it weighs each candidate, roughly; for progress bars. 0: it is done at once.
    """

    needs_visibility: ClassVar[bool]
    effort: ClassVar[int]

    def choose(self, candidates: Candidates, budget: int, seed: int, tick: Tick | None = None) -> Choice:
        """Choose ``budget`` distinct candidates.

        Raises ContractError: not 1 <= budget <= N, or it cannot do without visibility and there is none.
        """
        ...


def check_budget(budget: int, candidates: int) -> None:
    """Raise ContractError unless 1 <= budget <= candidates."""
    if not 1 <= budget <= candidates:
        raise ContractError(
            f"budget {budget}: there are {candidates} candidate views; choose 1 to {candidates} (--budget)"
        )

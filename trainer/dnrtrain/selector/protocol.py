"""What every selection policy has in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..contract import ContractError

POLICIES = ("rl", "random", "farthest")


@dataclass(frozen=True)
class Cameras:
    """What a geometric policy may know of the candidates: centres and unit viewing directions, [N, 3] each."""

    positions: np.ndarray
    directions: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)


class Policy(Protocol):
    """A policy that needs no training: indices of ``budget`` distinct views, in order."""

    def choose(self, views: Cameras, budget: int, seed: int) -> list[int]: ...


def check_budget(budget: int, candidates: int) -> None:
    """Raise ContractError unless 1 <= budget <= candidates."""
    if not 1 <= budget <= candidates:
        raise ContractError(
            f"budget {budget}: there are {candidates} candidate views; choose 1 to {candidates} (--budget)"
        )

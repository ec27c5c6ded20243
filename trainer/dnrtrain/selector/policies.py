"""The policies that need no training, by name."""

from __future__ import annotations

from ..contract import ContractError
from .baselines import FarthestPolicy, RandomPolicy
from .coverage import CoveragePolicy
from .kmedoids import KMedoidsPolicy
from .names import NAMES
from .protocol import Policy

UNTRAINED: dict[str, Policy] = {
    # No learned selection was better than the rules, and coverage is the best of them on average: by hundredths of a
    # dB, by more where the renderer paints from nothing (docs/bench-select.md).
    "auto": CoveragePolicy(),
    "coverage": CoveragePolicy(),
    "kmedoids": KMedoidsPolicy(),
    "farthest": FarthestPolicy(),
    "random": RandomPolicy(),
}


def untrained(name: str) -> Policy | None:
    """The policy of that name; None for one that step 1 must train. Raises ContractError for an unknown one."""
    if name not in NAMES:
        raise ContractError(f"unknown policy '{name}'; choose one of {', '.join(NAMES)}")
    return UNTRAINED.get(name)

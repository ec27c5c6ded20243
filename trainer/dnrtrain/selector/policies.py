"""The policies that need no training, by name."""

from __future__ import annotations

from ..contract import ContractError
from .auto import AutoPolicy
from .baselines import FarthestPolicy, RandomPolicy
from .coverage import CoveragePolicy
from .doptimal import DOptimalPolicy
from .exchange import ExchangePolicy
from .kmedoids import KMedoidsPolicy
from .learned import DqnPolicy
from .names import NAMES, full_name
from .protocol import Policy

UNTRAINED: dict[str, Policy] = {
    "auto": AutoPolicy(),
    "coverage": CoveragePolicy(),
    "exchange": ExchangePolicy(),
    "kmedoids": KMedoidsPolicy(),
    "d-optimal": DOptimalPolicy(),
    "dqn": DqnPolicy(),
    "farthest": FarthestPolicy(),
    "random": RandomPolicy(),
}


def untrained(name: str) -> Policy | None:
    """The policy of that name or alias; None for one that step 1 must train.

    Raises ContractError for an unknown one.
    """
    name = full_name(name)
    if name not in NAMES:
        raise ContractError(f"unknown policy '{name}'; choose one of {', '.join(NAMES)}")
    return UNTRAINED.get(name)

"""Names of the policies; imports nothing, so that command lines can list them at no cost."""

from __future__ import annotations

from typing import Literal, get_args

UntrainedName = Literal["auto", "kmedoids", "coverage", "d-optimal", "dqn", "farthest", "random"]
TrainedName = Literal["rl-paper", "fisher"]
PolicyName = Literal[UntrainedName, TrainedName]

UNTRAINED_NAMES: tuple[UntrainedName, ...] = get_args(UntrainedName)
"""Policies that choose in seconds, from camera poses and G-buffers."""
TRAINED_NAMES: tuple[TrainedName, ...] = get_args(TrainedName)
"""Policies that choose by what step 1 learns."""
ALIASES = {"rl": "rl-paper"}
NAMES = (*UNTRAINED_NAMES, *TRAINED_NAMES)


def full_name(name: str) -> str:
    """An alias's policy; any other text as it is."""
    return ALIASES.get(name, name)

"""Names of the policies and of the shipped weights; imports nothing heavy: command lines list them at no cost."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

UntrainedName = Literal["auto", "coverage", "exchange", "kmedoids", "d-optimal", "dqn", "farthest", "random"]
TrainedName = Literal["rl-paper", "fisher", "ensemble", "variance"]
PolicyName = Literal[UntrainedName, TrainedName]

UNTRAINED_NAMES: tuple[UntrainedName, ...] = get_args(UntrainedName)
"""Policies that choose in seconds, from camera poses and G-buffers."""
TRAINED_NAMES: tuple[TrainedName, ...] = get_args(TrainedName)
"""Policies that choose by what step 1 learns."""
ACTIVE_NAMES: tuple[TrainedName, ...] = ("ensemble", "variance")
"""Those of them that train models of their own, on the views chosen so far, and choose on (:mod:`.active`)."""
ALIASES = {"rl": "rl-paper"}
NAMES = (*UNTRAINED_NAMES, *TRAINED_NAMES)
SHIPPED_WEIGHTS = Path(__file__).with_name("dqn.safetensors")
"""Of policy dqn: trained on this repository's scenes by `dnrpipe train-selector`."""


def full_name(name: str) -> str:
    """An alias's policy; any other text as it is."""
    return ALIASES.get(name, name)

"""Names of the policies. Imports nothing heavy, so that command lines list them at no cost."""

from __future__ import annotations

from typing import Literal, get_args

UntrainedName = Literal["auto", "coverage", "kmedoids", "farthest", "random"]
TrainedName = Literal["rl-paper"]
PolicyName = Literal[UntrainedName, TrainedName]

UNTRAINED_NAMES: tuple[UntrainedName, ...] = get_args(UntrainedName)
"""Policies that choose in seconds, from camera poses and G-buffers."""
TRAINED_NAMES: tuple[TrainedName, ...] = get_args(TrainedName)
"""Policies that choose by what step 1 learns."""
NAMES = (*UNTRAINED_NAMES, *TRAINED_NAMES)

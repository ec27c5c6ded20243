"""Names of the light-transport effects, and which of them a user can switch."""

from __future__ import annotations

from typing import Literal, get_args

EffectName = Literal[
    "indirect",
    "refraction",
    "caustics",
    "volumes",
    "subsurface",
    "alpha",
    "environment",
    "area-lights",
    "point-lights",
    "glow",
    "hair",
    "depth-of-field",
    "spectral",
    "motion",
    "view-dependence",
    "depth",
    "normal",
]
NAMES: tuple[EffectName, ...] = get_args(EffectName)
NEURAL: frozenset[str] = frozenset({"view-dependence", "depth", "normal"})
FORCEABLE: frozenset[str] = NEURAL | {"indirect", "volumes", "spectral"}
"""Effects that can be simulated where nothing calls for them; the others need something in the scene."""
LAMPS: tuple[EffectName, ...] = ("area-lights", "point-lights", "glow")
REMOVABLE: frozenset[str] = frozenset({"refraction", "subsurface", "alpha", "environment", "hair", *LAMPS})
"""Effects that are left out by editing the bundle (`bundle`)."""

"""Names and titles of the light-transport effects, and which of them a user can switch."""

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
TITLES: dict[EffectName, str] = {
    "indirect": "indirect light",
    "refraction": "refraction",
    "caustics": "caustics",
    "volumes": "volumes",
    "subsurface": "subsurface",
    "alpha": "alpha masks",
    "environment": "environment light",
    "area-lights": "area lights",
    "point-lights": "point, spot and sun lights",
    "glow": "glowing surfaces",
    "hair": "hair strands",
    "depth-of-field": "depth of field",
    "spectral": "spectral rendering",
    "motion": "motion blur",
    "view-dependence": "spherical harmonics of the view",
    "depth": "texture by depth",
    "normal": "texture by normal",
}
NEURAL: frozenset[str] = frozenset({"view-dependence", "depth", "normal"})
FORCEABLE: frozenset[str] = NEURAL | {"indirect", "volumes", "spectral"}
"""Effects that can be simulated where nothing calls for them; the others need something in the scene."""
REMOVABLE: frozenset[str] = frozenset(
    {
        "refraction",
        "subsurface",
        "alpha",
        "environment",
        "area-lights",
        "point-lights",
        "glow",
        "hair",
    }
)
"""Effects that are left out by editing the bundle (`bundle`)."""
LAMPS: tuple[EffectName, ...] = ("area-lights", "point-lights", "glow")

"""Amounts as a user writes them: ``1%``, ``0.01``; ``90s``, ``10m``, ``1h30m``."""

from __future__ import annotations

import math
import re

UNITS = {"h": 3600.0, "m": 60.0, "s": 1.0}
NUMBER = r"\d+(?:\.\d+)?|\.\d+"
PERCENT = re.compile(rf"({NUMBER})\s*%")
DURATION = re.compile(rf"(?:({NUMBER})h)?(?:({NUMBER})m(?:in)?)?(?:({NUMBER})s)?")


def parse_share(text: str | float) -> float:
    """``"1%"``, ``"0.01"`` or 0.01 -> 0.01. Raises ValueError unless 0 < share < 1."""
    found = PERCENT.fullmatch(text.strip()) if isinstance(text, str) else None
    try:
        share = float(found[1]) / 100 if found else float(text)
    except ValueError:
        share = math.nan
    if not 0 < share < 1:
        raise ValueError("expected a share above 0 and below 100%, e.g. 1% or 0.01")
    return share


def parse_seconds(text: str | float) -> float:
    """``"90s"``, ``"10m"``, ``"1h30m"``, ``"90"`` or 90 -> seconds. Raises ValueError unless finite and above 0."""
    seconds = math.nan
    if not isinstance(text, str) or re.fullmatch(NUMBER, text.strip()):
        seconds = float(text)
    elif (found := DURATION.fullmatch(text.strip().replace(" ", "").lower())) and any(found.groups()):
        seconds = sum(float(part) * unit for part, unit in zip(found.groups(), UNITS.values(), strict=True) if part)
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError("expected a time above 0, e.g. 90s, 10m or 1h30m")
    return seconds

"""Amounts as a user writes them: ``1%``, ``0.01``; ``90s``, ``10m``, ``1h30m``."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

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


def duration(seconds: float) -> str:
    """``13 ms``, ``2.41 s``, ``48 s``, ``3 min 05 s``, ``2 h 10 min``; a minus sign where negative."""
    if seconds < 0:
        return "−" + duration(-seconds)
    if seconds == 0:
        return "0 s"
    if seconds < 0.9995:
        return f"{seconds * 1000:.3g} ms" if seconds < 0.01 else f"{seconds * 1000:.0f} ms"
    if seconds < 9.995:
        return f"{seconds:.2f} s"
    if seconds < 99.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min"


def count(number: int) -> str:
    """Thousands set apart by thin spaces."""
    return f"{number:,}".replace(",", "\u2009")


def several(numbers: Sequence[int]) -> str:
    """``64``, ``64, 128``, or from least to most where views have each their own number: ``80 to 664``."""
    return ", ".join(map(str, numbers)) if len(numbers) <= 3 else f"{min(numbers)} to {max(numbers)}"


def ratio(slow: float, fast: float) -> str:
    """How many times faster, with two significant digits."""
    value = slow / fast
    return f"{value:.1f}" if value < 10 else f"{float(f'{value:.2g}'):.0f}"

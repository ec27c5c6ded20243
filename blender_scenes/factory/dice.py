"""Random choices that depend on a seed alone."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")
Rgb = tuple[float, float, float]


def linear(colour: Rgb) -> Rgb:
    """Linear values of a display-encoded colour."""
    r, g, b = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour)
    return r, g, b


def scaled(colour: Rgb, factor: float) -> Rgb:
    """Lighter or darker by a factor."""
    r, g, b = colour
    return r * factor, g * factor, b * factor


class Dice:
    """A seeded generator with the draws that scenes need."""

    def __init__(self, *seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def log(self, low: float, high: float) -> float:
        """Log-uniform: as often in (low, 2 low) as in (high / 2, high)."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def whole(self, low: int, high: int) -> int:
        """Integer from low to high, both included."""
        return int(self.rng.integers(low, high + 1))

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def pick(self, items: Sequence[T]) -> T:
        return items[int(self.rng.integers(len(items)))]

    def weighted(self, weights: Mapping[T, float]) -> T:
        """A key, as often as its weight says."""
        keys, shares = list(weights), np.array(list(weights.values()), dtype=float)
        return keys[int(self.rng.choice(len(keys), p=shares / shares.sum()))]

    def seed(self) -> int:
        """A seed for functions that take one."""
        return int(self.rng.integers(1 << 30))

    def shown(self, saturation: tuple[float, float] = (0.0, 0.85), value: tuple[float, float] = (0.12, 0.92)) -> Rgb:
        """Display-encoded colour. Warm and weak hues are more common than others, as about us."""
        low, high = saturation
        strength = low + (high - low) * self.rng.random() ** 1.4
        hue = self.rng.uniform(0.0, 0.15) if self.chance(0.4) else self.rng.random()
        return colorsys.hsv_to_rgb(hue, strength, self.rng.uniform(*value))

    def colour(self, saturation: tuple[float, float] = (0.0, 0.85), value: tuple[float, float] = (0.12, 0.92)) -> Rgb:
        """Linear colour of any hue."""
        return linear(self.shown(saturation, value))

    def near(self, colour: Rgb, spread: float = 0.2) -> Rgb:
        """The display-encoded colour, a little lighter or darker and shifted."""
        tone = self.uniform(-spread, spread)
        r, g, b = (min(max(c + tone + self.uniform(-spread, spread) * 0.4, 0.02), 0.98) for c in colour)
        return r, g, b

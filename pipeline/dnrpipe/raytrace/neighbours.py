"""Pixels of a frame, an array element each, and their neighbours, within recorded kernels."""

from __future__ import annotations

from typing import Any

AROUND = tuple((right, below) for below in (-1, 0, 1) for right in (-1, 0, 1))
"""A pixel and its eight neighbours."""


class Pixels:
    """Of a frame; beyond the border the last pixel continues. x, y: columns and rows."""

    def __init__(self, mi: Any, width: int, height: int) -> None:
        import drjit as dr

        self.mi, self.width, self.height = mi, width, height
        self.pixel = dr.arange(mi.UInt32, width * height)
        self.x, self.y = mi.Int32(self.pixel % width), mi.Int32(self.pixel // width)

    def index(self, right: int, below: int) -> Any:
        """Of the neighbours so far away."""
        import drjit as dr

        return dr.clip(self.y + below, 0, self.height - 1) * self.width + dr.clip(self.x + right, 0, self.width - 1)

"""Light transport that both renderers are asked for. No bpy, no mitsuba."""

from __future__ import annotations

BOUNCES = 11
"""Cycles' bounces."""
PATH_DEPTH = BOUNCES + 1
"""Mitsuba counts path vertices: one more."""

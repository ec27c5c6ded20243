"""Rotation-minimising frames: how a section is carried along a path."""

from __future__ import annotations

import numpy as np


def tangents(path: np.ndarray, closed: bool) -> np.ndarray:
    """Unit directions [N, 3] of a path [N, 3]."""
    tangent = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    return tangent / np.linalg.norm(tangent, axis=1, keepdims=True)


def minimal_frame(tangent: np.ndarray, side: np.ndarray, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """(sides [N, 3], twists [N]): ``side`` carried along unit tangents [N, 3], turning as little as it can.

    On a closed path the frame comes back turned; ``twists`` (radians) spread that gap evenly. Else they are 0.
    """
    count = len(tangent)
    frame = np.zeros_like(tangent)
    for i in range(count):
        side = side - tangent[i] * (side @ tangent[i])
        side /= np.linalg.norm(side)
        frame[i] = side
    twist = np.zeros(count)
    if closed:
        last = frame[-1] - tangent[0] * (frame[-1] @ tangent[0])
        gap = np.arctan2(np.cross(last, frame[0]) @ tangent[0], last @ frame[0])
        twist = gap * np.arange(count) / count
    return frame, twist

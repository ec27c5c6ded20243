"""What a scene file says of a shot: the camera of each of its frames, and what changes over them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Literal

from .errors import UserError
from .scene_records import SceneCamera, SceneRecord

MOST_FRAMES = 100_000
LAST_FRAME = 1_048_574
"""Blender's (MAXFRAME); the first one is its negative."""
_RANGE = re.compile(r"(-?\d+)(?:\s*-\s*(-?\d+))?(?:\s*/\s*(\d+))?")


ChangeKind = Literal[
    "moves", "deforms", "changes its material", "light changes", "world changes", "appears or disappears"
]


class Change(SceneRecord):
    """What differs in some frames from the frame that is converted.

    Args:
        name: of the object, lamp or world; of instances the object that instances them.
        surfaces: names of the objects whose surfaces change, as in ``object_names`` of scene/summary.json.
        frames: of the shot, rising.
    """

    name: str
    kind: ChangeKind
    surfaces: tuple[str, ...]
    frames: tuple[int, ...]


class ShotFacts(SceneRecord):
    """A shot as the scene file has it.

    Args:
        cameras: of each frame, in order; ``frame`` and ``name`` say which. A frame's name follows camera markers.
        fps: frames per second.
        frame_start, frame_end: the file's own range.
        resolution: width and height of the file's pictures, its percentage applied; pixels.
        film_transparent: the file's pictures leave the world behind everything out.
        converted: the frame that a conversion of the file freezes.
        changes: what differs from it, cameras apart; by name.
        examined: how many frames were evaluated. Where that took too long for all, a frame between two evaluated ones
            counts as changed by what changed in either.
        warnings: lines for the user.
    """

    cameras: list[SceneCamera]
    fps: float
    frame_start: int
    frame_end: int
    resolution: tuple[int, int]
    film_transparent: bool
    converted: int
    changes: list[Change]
    examined: int
    warnings: list[str]

    @property
    def frames(self) -> list[int]:
        return [camera.frame for camera in self.cameras if camera.frame is not None]

    def changing(self, frame: int) -> list[str]:
        """Names of what differs at a frame from the converted one; empty where the scene stands still."""
        return sorted({change.name for change in self.changes if frame in change.frames})

    @property
    def still(self) -> list[int]:
        """Frames that show the scene as it is converted, from another camera at most."""
        moved = {frame for change in self.changes for frame in change.frames}
        return [frame for frame in self.frames if frame not in moved]


def parse_frames(text: str) -> tuple[int, ...]:
    """``1-240``, ``1-240/2`` (every second one), ``7``, ``-10--1``, and several by commas -> frames, rising.

    Raises UserError: anything else.
    """
    frames: set[int] = set()
    for part in text.split(","):
        found = _RANGE.fullmatch(part.strip())
        if found is None:
            raise UserError(f"--frames {text}: expected frames such as 1-240, 1-240/2 or 7,12")
        first = int(found[1])
        last = first if found[2] is None else int(found[2])
        step = 1 if found[3] is None else int(found[3])
        if last < first or step < 1:
            raise UserError(
                f"--frames {text}: '{part.strip()}' holds no frame; write the first frame first, as in 1-240/2"
            )
        if max(abs(first), abs(last)) > LAST_FRAME or (last - first) // step >= MOST_FRAMES:
            raise UserError(f"--frames {text}: at most {MOST_FRAMES:,} frames up to number {LAST_FRAME:,}")
        frames.update(range(first, last + 1, step))
    return tuple(sorted(frames))


def told_frames(frames: Sequence[int]) -> str:
    """``frames 2-5, 9`` of rising numbers."""
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = frame
        else:
            runs.append([frame, frame])
    told = ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in runs)
    return f"frame{'s' if len(frames) > 1 else ''} {told}"

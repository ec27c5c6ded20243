"""Compare the frames of a shot with the frame that is converted."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any

import bpy
import numpy as np

from dnrpipe.core.errors import UserError
from dnrpipe.core.shot_records import Change, ChangeKind, told_frames

from ..geometry.render_graph import with_render_graph
from ..visible import freeze_visible
from .simulations import is_simulated, play
from .states import State, StateReader, same, shows_anything
from .suspects import action_curves, find_suspects

SECONDS = 30.0
"""Evaluating all frames may take so long; beyond it, some are."""
LEAST = 16
"""Frames that are evaluated, however long it takes."""
Differences = dict[tuple[str, ChangeKind], set[str]]
"""Surfaces by (name, kind)."""


def find_changes(scene: Any, frames: Sequence[int]) -> tuple[list[Change], int]:
    """What differs at some of the frames from the frame that a conversion of the open file freezes; frames evaluated.

    Where nothing is animated, driven, simulated or reads the time, nothing is evaluated. The scene is left at the
    frame that is converted: the current one, or where that shows nothing, see `freeze_visible`.

    Args:
        frames: rising.

    Raises NothingVisible: no frame shows a surface. Raises UserError: some of those that are evaluated do not.
    """
    suspects = find_suspects(scene)
    if not suspects:
        return [], 0
    reader = StateReader(suspects)
    anything, base = with_render_graph(scene, lambda engine, graph: (shows_anything(graph), reader.read(graph)))
    if not anything:
        freeze_visible(scene)
        base = with_render_graph(scene, lambda engine, graph: reader.read(graph))
    simulated = is_simulated(scene)
    if simulated:
        play(scene, frames[-1])
    now, subframe = scene.frame_current, scene.frame_subframe
    # Before it is played, a simulation may be elsewhere at the frame that is converted.
    wanted = [frame for frame in frames if simulated or frame != now or subframe]
    found = {frame: Differences() for frame in frames if frame not in wanted}
    if wanted:
        found |= with_render_graph(scene, lambda engine, graph: _compare(engine, graph, reader, base, wanted))
    return _changes(found, frames), len(found)


def _compare(
    engine: Any, graph: Any, reader: StateReader, base: State, frames: Sequence[int]
) -> dict[int, Differences]:
    """What differs at the frames, at all of them or at as many as there is time for. Raises UserError: some show no
    surface, and could not be converted."""
    scene = graph.scene
    now, subframe = scene.frame_current, scene.frame_subframe
    found: dict[int, Differences] = {}
    empty: list[int] = []
    chosen = list(frames)
    try:
        while chosen:
            frame, started = chosen.pop(0), time.monotonic()
            engine.frame_set(frame, 0.0)
            found[frame] = _differences(base, reader.read(graph))
            if not shows_anything(graph):
                empty.append(frame)
            if len(found) == 2:  # the first one also loads what frames share
                chosen = _affordable(chosen, max(LEAST, int(SECONDS / (time.monotonic() - started))))
    finally:
        engine.frame_set(now, subframe)
    if empty:
        raise UserError(f"no surface is visible in {told_frames(empty)}; leave them out with --frames")
    return found


def _affordable(frames: Sequence[int], count: int) -> list[int]:
    """All frames, or ``count`` of them: half evenly spread, half where keys are; the last one is among them."""
    if len(frames) <= count:
        return list(frames)
    keys = sorted(_key_times() & set(frames))
    spread = [*_spread(frames, count - min(count // 2, len(keys))), *_spread(keys, count // 2)]
    return sorted({*spread, frames[-1]})


def _spread(items: Sequence[int], count: int) -> list[int]:
    if len(items) <= count:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, count).round().astype(int)]


def _key_times() -> set[int]:
    """Frames at which anything has a key, in actions' own time."""
    curves = (curve for action in bpy.data.actions for curve in action_curves(action))
    return {round(point.co[0]) for curve in curves for point in curve.keyframe_points}


def _differences(base: State, state: State) -> Differences:
    found: Differences = {}
    known: dict[tuple[int, int], bool] = {}
    for key in base.keys() | state.keys():
        name, surface, _ = key
        before, after = base.get(key), state.get(key)
        if before is None or after is None:
            found.setdefault((name, "appears or disappears"), set()).add(surface)
            continue
        for kind in before.keys() | after.keys():
            if not same(before.get(kind), after.get(kind), known):
                found.setdefault((name, kind), set()).add(surface)
    return found


def _changes(found: dict[int, Differences], frames: Iterable[int]) -> list[Change]:
    """Differences by frame -> frames and surfaces by name and kind. Frames in between take those of both neighbours."""
    evaluated = np.array(sorted(found))
    when: dict[tuple[str, ChangeKind], list[int]] = {}
    surfaces: Differences = {}
    for frame in frames:
        place = int(np.searchsorted(evaluated, frame))
        around = (
            [frame] if frame in found else [int(evaluated[i]) for i in (place - 1, place) if 0 <= i < len(evaluated)]
        )
        for what in {what for near in around for what in found[near]}:
            when.setdefault(what, []).append(frame)
            surfaces.setdefault(what, set()).update(*(found[near].get(what, ()) for near in around))
    return [
        Change(name=what[0], kind=what[1], surfaces=tuple(sorted(surfaces[what])), frames=tuple(when[what]))
        for what in sorted(when)
    ]

"""Rendering, and ``dr.freeze``, that Python's garbage collector does not disturb."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np

from .lobes import media_of
from .tasks import Costs, costs_since


@contextmanager
def without_collection() -> Iterator[None]:
    """No garbage collection within.

    Dr.Jit 1.x aborts the process, or reads freed memory, when the collector happens to free an older scene or kernel
    while calls of plugins are being recorded, which `mi.render` does and a frozen function's first call.
    """
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


class Recorded:
    """A function of Dr.Jit arrays, recorded at its first call and replayed afterwards.

    On a GPU it is not: there Dr.Jit 1.5 aborts the process where it records what looks up a scene ("jit_var(r0):
    unknown variable", on an H100). The function is called anew each time, which takes some 70 ms of Python a frame.

    scene: what the function renders. Pointers to its media go in with the arguments: calls of media are refused where
    the process holds others than the scene's (`second_targets`), unless a pointer says that all of them are meant. Of
    emitters, shapes and BSDFs the scene holds such pointers.
    """

    def __init__(self, function: Callable[..., Any], scene: Any = None) -> None:
        import drjit as dr
        import mitsuba as mi

        media = [mi.MediumPtr(medium) for medium in media_of(scene)] if scene is not None else []
        self.evaluate: Any = dr.eval
        self.replays = not str(mi.variant()).startswith("cuda")
        self.frozen: Any = dr.freeze(function, state_fn=lambda *arguments: media, enabled=self.replays)
        self.calls = 0

    @property
    def n_recordings(self) -> int:
        """How often it was recorded: more than once where something that varies came in other than as data. Where it
        is not replayed, the first call counts, which compiles."""
        return self.frozen.n_recordings if self.replays else min(1, self.calls)

    def __call__(self, *arguments: Any) -> Any:
        known, began = self.n_recordings, (time.monotonic(), time.process_time())
        with without_collection():
            values = self.frozen(*arguments)
            if not self.replays:
                self.evaluate(values)  # as a replay leaves them
        self.calls += 1
        if self.n_recordings > known:
            Stopwatch.leave_out(*began)
        return values


class Stopwatch:
    """What pictures cost from its making on, without the seconds in which kernels were recorded."""

    recording: ClassVar[list[float]] = [0.0, 0.0]
    """Wall-clock and processor seconds of all recordings of this process."""

    @classmethod
    def leave_out(cls, wall: float, cpu: float) -> None:
        """What has passed since, by `time.monotonic` and `time.process_time`, was recording."""
        cls.recording[0] += time.monotonic() - wall
        cls.recording[1] += time.process_time() - cpu

    def __init__(self) -> None:
        self.started, self.known = (time.monotonic(), time.process_time()), tuple(self.recording)

    def costs(self) -> Costs:
        """Up to now."""
        times = zip(self.started, self.recording, self.known, strict=True)
        return costs_since(*(started + recorded - known for started, recorded, known in times))


def timed(ms: dict[str, float], name: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """What the function returns; its milliseconds, recording included, go to ``ms[name]``."""
    started = time.perf_counter()
    result = function(*arguments, **options)
    ms[name] = 1000 * (time.perf_counter() - started)
    return result


def prepare_emitters(mi: Any, scene: Any) -> None:
    """Let emitters make what they make at their first use (a mesh's distribution of areas), once, before recording.

    Within a recording Dr.Jit refuses it: "virtual function call ... no such object instance".
    """
    import drjit as dr

    if not scene.emitters():
        return
    here = dr.zeros(mi.SurfaceInteraction3f)
    source, _ = scene.sample_emitter_direction(here, mi.Point2f(0.5), False)
    dr.eval(source, scene.pdf_emitter_direction(here, source))


def planes_of(values: Sequence[Any], shape: tuple[int, int]) -> list[np.ndarray]:
    """Evaluated Dr.Jit arrays that nothing else reads as planes [H, W] that may be written to.

    On a CPU they are Dr.Jit's memory: fresh planes would cost more, for the pages that they begin, than what is done to
    them afterwards. Of arrays that share theirs all but one are copies.
    """
    found, known = [], set()
    for value in values:
        plane = value.numpy().reshape(shape)
        shared = plane.ctypes.data in known or not plane.flags.writeable
        known.add(plane.ctypes.data)
        found.append(plane.copy() if shared else plane)
    return found


def inputs_of(mi: Any, planes: Iterable[np.ndarray]) -> list[Any]:
    """The planes as flat Dr.Jit arrays for a recorded function, each in memory of its own.

    On a CPU they are numpy's memory where it is aligned. Of planes in one memory all but the first are copies: Dr.Jit
    would record them as one argument, and go on reading the first where they differ in a later call.
    """
    found, known = [], set()
    for plane in planes:
        flat = aligned(plane)
        if flat.ctypes.data in known:
            flat = aligned(flat.copy())
        known.add(flat.ctypes.data)
        found.append(mi.Float(flat))
    return found


def aligned(plane: np.ndarray) -> np.ndarray:
    """The plane, flat, float32, at an address that is a multiple of 64: itself where it is, as Dr.Jit's memory is.

    Dr.Jit takes memory as it is, and records a kernel anew for memory that is aligned otherwise.
    """
    flat = np.ascontiguousarray(plane, np.float32).ravel()
    if flat.ctypes.data % 64 == 0:
        return flat
    buffer = np.empty(flat.size + 16, np.float32)
    start = -buffer.ctypes.data // 4 % 16
    copy = buffer[start : start + flat.size]
    copy[:] = flat
    return copy

"""Frame processes: one per workspace that somebody views; they start on demand and end when idle.

While the camera moves, resolution and samples follow from measured frame times.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from dnrtrain.text import one_line

from ..core.errors import UserError
from ..workers.processes import LocalWorker, TaskFailed, WorkerDied
from ..workers.task_list import MAX_ATTEMPTS
from .config import ServerConfig
from .live_scene import LiveRequest, LiveScene, open_scene
from .root import ServiceRoot

FRAME_SECONDS = 120.0
"""Timeout of a frame; the first one loads the scene and compiles kernels."""
IDLE_CHECK = 2.0
REFERENCE_SPP = 4
MOST_SPP, MOST_RAYS = 1024, 64
"""Per pixel, of a reference and of a base image at rest."""
BUDGET = 66.0
"""Milliseconds that a moving frame may take: fifteen a second."""
LEVELS: tuple[tuple[float, int | None], ...] = (
    (1.0, None),
    (1.0, 2),
    (1.0, 1),
    (0.75, 1),
    (0.5, 2),
    (0.5, 1),
    (0.375, 1),
    (0.25, 1),
)
"""(share of the side, rays per pixel of the base image; None: the model's own)."""
START = 2
STEP = 32
"""Sides are multiples of this: the U-Net halves them."""
LEAST = 4 * STEP
"""The side of a moving frame, where the view at rest has no fewer."""
SMOOTHING = 0.3
SLACK = 0.45
"""Below this share of the budget the pace tries a finer level, which costs about twice as much."""
MIN_FRAMES = 8
"""Frames at a level before it may change."""
HASTY = 2.0
"""Two frames on end that take so many times the budget make it coarser at once; one alone may compile a kernel."""


@dataclass
class Pace:
    """Chooses a level by frame times. The first frame at a level compiles its kernels and does not count."""

    budget: float = BUDGET
    level: int = START
    _mean: float | None = None
    _frames: int = 0
    _slow: int = 0
    _known: set[tuple[int, int]] = field(default_factory=set)

    def pick(self, size: int) -> tuple[int, int | None]:
        """(side in pixels, samples) of the next moving frame, of a view of ``size``² at rest."""
        share, samples = LEVELS[self.level]
        return size if share == 1 else max(min(size, LEAST), round(share * size / STEP) * STEP), samples

    def record(self, size: int, milliseconds: float) -> None:
        """Record the time of a moving frame of a view of `size`²; change the level where that calls for it."""
        if (self.level, size) not in self._known:
            self._known.add((self.level, size))
            return
        mean, most = self._mean, HASTY * self.budget
        told = min(milliseconds, most)  # else one frame that compiled weighs as many slow ones
        self._mean = told if mean is None else mean + SMOOTHING * (told - mean)
        self._frames += 1
        self._slow = self._slow + 1 if milliseconds > most else 0
        too_slow = self._slow >= 2
        if self._frames < MIN_FRAMES and not too_slow:
            return
        if self._mean > self.budget and self.level + 1 < len(LEVELS):
            self._move(1)
        elif self._mean < SLACK * self.budget and self.level > 0:
            self._move(-1)

    def _move(self, step: int) -> None:
        self.level += step
        self._mean, self._frames, self._slow = None, 0, 0


class LiveSession:
    """One workspace's frame process. One thread starts it and requests all frames: Linux kills the process when the
    thread that started it ends."""

    def __init__(self, scene: LiveScene) -> None:
        self.scene = scene
        self.viewers = 0
        self.used = time.monotonic()
        self.pace = Pace()
        self._warm = False
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=f"live-{scene.root.stem}")
        log = scene.root / "logs" / "live.log"
        self._worker = LocalWorker("dnrpipe.service.live_frames", scene.common, log, scene.environment)

    async def frame(self, request: LiveRequest) -> dict[str, Any]:
        """The answer of the frame process (see `live_frames`), and `nearest`: the most similar training view;
        `viewers`: how many share the process; `waited_ms`: for frames of others, part of `total_ms`.

        Raises UserError: the frame failed; says why.
        """
        self.used = time.monotonic()
        moving = request.moving and request.mode not in ("nearest", "reference", "error")
        size, samples = self.pace.pick(request.size) if moving else (request.size, None)
        view = self.scene.view(request.camera, size)
        nearest = self.scene.nearest(view)
        if request.mode == "nearest" and nearest is None:
            raise UserError("there is no training view")
        task = {
            "view": view.model_dump(mode="json"),
            "mode": request.mode,
            "samples": samples,
            "spp": REFERENCE_SPP,
            "fine": not request.moving,
            "file": str(self.scene.root / "raytraced" / "train" / f"{nearest.name}.exr") if nearest else None,
        }
        started = time.perf_counter()
        began, answer = await asyncio.get_running_loop().run_in_executor(self._thread, self._ask, task)
        total, waited = 1000 * (time.perf_counter() - started), 1000 * (began - started)
        if moving:
            self.pace.record(request.size, total)
        return answer | {
            "total_ms": round(total, 1),
            "waited_ms": round(waited, 1),
            "viewers": self.viewers,
            "nearest": nearest.name if nearest else None,
            "samples": samples,
        }

    async def warm(self, request: LiveRequest) -> None:
        """Compile the kernels of moving frames before the camera moves; does nothing after the first time."""
        if not self._warm:
            self._warm = True
            with contextlib.suppress(UserError):  # the request for the frame itself reports it
                await self.frame(request.model_copy(update={"moving": True, "mode": "neural"}))

    def _ask(self, task: dict[str, Any]) -> tuple[float, dict[str, Any]]:
        """(when it was asked, by perf_counter; the answer)"""
        reason, began = "", time.perf_counter()
        for _ in range(MAX_ATTEMPTS):  # a new process replaces one that died
            try:
                return began, self._worker.ask(task, FRAME_SECONDS)
            except (TaskFailed, WorkerDied, OSError, ValueError) as error:
                reason = one_line(error)
        raise UserError(f"the frame failed: {reason}; see {self.scene.root.name}/logs/live.log")

    async def close(self) -> None:
        await asyncio.get_running_loop().run_in_executor(self._thread, self._worker.close)
        self._thread.shutdown(wait=False)


class LivePool:
    """At most `config.viewers` sessions; a new one replaces the one that was idle for longest."""

    def __init__(self, config: ServerConfig, root: ServiceRoot) -> None:
        self.config, self.root = config, root
        self.sessions: dict[str, LiveSession] = {}
        self._lock = asyncio.Lock()

    @contextlib.asynccontextmanager
    async def session(self, name: str) -> AsyncIterator[LiveSession]:
        """The workspace's session; a new one where its model has changed. Raises UserError, UnknownName."""
        path = self.root.workspace(name)
        scene = await asyncio.to_thread(open_scene, path)
        async with self._lock:
            found = self.sessions.get(name)
            if found is not None and found.scene.fingerprint != scene.fingerprint and found.viewers == 0:
                await self._end(name)
                found = None
            if found is None:
                await self._make_room()
                found = self.sessions[name] = LiveSession(scene)
            found.viewers += 1
        try:
            yield found
        finally:
            found.viewers -= 1
            found.used = time.monotonic()

    async def close_idle(self) -> None:
        """End sessions that nobody has viewed for a while; runs for as long as the server does."""
        while True:
            await asyncio.sleep(IDLE_CHECK)
            async with self._lock:
                for name, session in list(self.sessions.items()):
                    if session.viewers == 0 and time.monotonic() - session.used > self.config.idle_seconds:
                        await self._end(name)

    async def close(self) -> None:
        async with self._lock:
            for name in list(self.sessions):
                await self._end(name)

    async def _make_room(self) -> None:
        if len(self.sessions) < self.config.viewers:
            return
        idle = [(session.used, name) for name, session in self.sessions.items() if session.viewers == 0]
        if not idle:
            raise UserError(f"{len(self.sessions)} workspaces are being viewed, which is the limit; close one")
        await self._end(min(idle)[1])

    async def _end(self, name: str) -> None:
        await self.sessions.pop(name).close()

"""The application's state, as its routes see it."""

from __future__ import annotations

import asyncio
import contextlib
import math
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

from fastapi import Depends, HTTPException
from starlette.concurrency import run_in_threadpool
from starlette.requests import HTTPConnection

from .config import ServerConfig
from .live_pool import LivePool
from .queue import Queue
from .root import ServiceRoot
from .supervisor import Supervisor

POLL = 0.1
T = TypeVar("T")


class Feed:
    """Wakes event streams when the queue has a new event: polls it once for all of them."""

    def __init__(self, queue: Queue) -> None:
        self.queue = queue
        self._news = asyncio.Event()
        self._last = 0
        self.listeners = 0

    async def watch(self) -> None:
        """Run for as long as the server does."""
        while True:
            await asyncio.sleep(POLL)
            if not self.listeners:
                continue
            last = await run_in_threadpool(self.queue.last_event)
            if last != self._last:
                self._last = last
                news, self._news = self._news, asyncio.Event()
                news.set()

    async def wait(self, seconds: float) -> bool:
        """Wait for an event of any job. Returns False after `seconds` without one."""
        with contextlib.suppress(TimeoutError):
            return await asyncio.wait_for(self._news.wait(), seconds)
        return False


class Remembered:
    """Answers that take long to make: each is made by one request at a time, and good for all who ask within
    ``seconds`` while nothing happens."""

    SECONDS = 1.0

    def __init__(self, seconds: float = SECONDS) -> None:
        self.seconds = seconds
        self._lock = threading.Lock()
        self._locks: dict[str, threading.Lock] = {}
        self._made: dict[str, tuple[float, int, Any]] = {}

    def get(self, key: str, version: int, make: Callable[[], T]) -> T:
        """What ``make`` returned for the key, begun at most ``seconds`` ago and with this version. What it raises is
        not remembered."""
        with self._lock:
            lock = self._locks.setdefault(key, threading.Lock())
        with lock:
            when, made_with, value = self._made.get(key, (-math.inf, version, None))
            began = time.monotonic()
            if began - when > self.seconds or made_with != version:
                value = make()
                self._made[key] = (began, version, value)
            return value


@dataclass
class State:
    """What the routes share, one per server."""

    config: ServerConfig
    root: ServiceRoot
    queue: Queue
    supervisor: Supervisor
    live: LivePool
    feed: Feed
    streams: int = 0
    details: Remembered = field(default_factory=Remembered)
    sizes: Remembered = field(default_factory=partial(Remembered, 30.0))
    packing: asyncio.Lock = field(default_factory=asyncio.Lock)
    """Held while a folder is packed: one at a time, so that each finds the space that it was promised."""

    def require_space(self, folder: Path, mb: float = 0.0) -> None:
        """Raises HTTPException 507: too little of the folder's disk is free. mb: what is to be written, MiB."""
        least = self.config.free_disk_mb + math.ceil(mb)
        if shutil.disk_usage(folder).free < least * 2**20:
            raise HTTPException(507, f"less than {least} MiB of disk are free; make space")

    @contextlib.contextmanager
    def stream(self) -> Iterator[None]:
        """Counts an open event stream or viewer. Raises HTTPException 503 above the limit."""
        if self.streams >= self.config.streams:
            raise HTTPException(503, "too many open streams; close some")
        self.streams += 1
        try:
            yield
        finally:
            self.streams -= 1


def get_state(connection: HTTPConnection) -> State:
    return connection.app.state.service


Shared = Annotated[State, Depends(get_state)]

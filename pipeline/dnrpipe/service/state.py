"""The application's state, as its routes see it."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fastapi import Depends, HTTPException
from starlette.concurrency import run_in_threadpool
from starlette.requests import HTTPConnection

from .config import ServerConfig
from .live_pool import LivePool
from .queue import Queue
from .root import ServiceRoot
from .supervisor import Supervisor

POLL = 0.1


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

    def require_space(self, folder: Path) -> None:
        """Raises HTTPException 507: too little of the folder's disk is free."""
        if shutil.disk_usage(folder).free < self.config.free_disk_mb * 2**20:
            raise HTTPException(507, f"less than {self.config.free_disk_mb} MiB of disk are free; make space")

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

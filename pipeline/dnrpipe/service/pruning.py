"""Deletes logs and events of jobs that ended long ago; the jobs stay in the list, with how they ended."""

from __future__ import annotations

import asyncio
import logging
import time
from pathlib import Path

from starlette.concurrency import run_in_threadpool

from .config import ServerConfig
from .queue import Queue
from .root import ServiceRoot

LOG = logging.getLogger("dnrpipe.pruning")
INTERVAL = 3600.0
DAY = 86_400.0


def prune(queue: Queue, root: ServiceRoot, config: ServerConfig, now: float | None = None) -> list[int]:
    """Prune jobs that ended more than `config.keep_days` or `config.keep_jobs` jobs ago; returns their numbers.

    Queued and running jobs are kept, whatever their age.
    """
    now = time.time() if now is None else now
    has_files = _jobs_with_files(root.log(0).parent) | _jobs_with_files(root.events(0).parent)

    def remove(job: int) -> None:
        for path in (root.log(job), root.events(job)):
            path.unlink(missing_ok=True)

    return queue.prune(
        before=now - config.keep_days * DAY, beyond=config.keep_jobs, has_files=has_files, remove_files=remove
    )


async def prune_regularly(queue: Queue, root: ServiceRoot, config: ServerConfig) -> None:
    """Prune at the start and every hour, for as long as the server runs."""
    while True:
        try:
            pruned = await run_in_threadpool(prune, queue, root, config)
            if pruned:
                LOG.info("old logs and events removed", extra={"facts": {"jobs": len(pruned)}})
        except Exception:  # a full disk, a busy queue: the server goes on and tries again
            LOG.exception("old logs and events could not be removed")
        await asyncio.sleep(INTERVAL)


def _jobs_with_files(folder: Path) -> set[int]:
    return {int(path.stem) for path in folder.iterdir() if path.stem.isdigit()}

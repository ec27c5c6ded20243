"""The web application: routes, error answers, and the description (/openapi.json)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Mapping

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from dnrtrain.text import one_line

from .. import __version__
from ..core.errors import UserError
from . import routes_jobs, routes_leases, routes_live, routes_server, routes_workspaces
from .config import LOOPBACK
from .guard import Guard
from .leases import LeaseGone
from .models import first_fault
from .queue import QueueFull, WrongState
from .root import UnknownName
from .state import State
from .users import User
from .webhooks import tell_of_ended

LOG = logging.getLogger("dnrpipe.pruning")
WORKERS = logging.getLogger("dnrpipe.workers")
LAPSE_INTERVAL = 1.0
_STATUS: dict[type[UserError], int] = {
    QueueFull: 429,
    WrongState: 409,
    LeaseGone: 410,
    UnknownName: 404,
    UserError: 422,
}


def create_app(state: State, users: Mapping[str, User] | None) -> FastAPI:
    """The application for ``state``. users: by token; None only where the server listens on the loopback interface."""

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        chores = [state.feed.watch(), state.live.close_idle(), _prune_regularly(state), _end_lapsed_leases(state)]
        if state.config.webhooks:
            chores.append(tell_of_ended(state.queue, state.config.webhooks))
        tasks = [asyncio.create_task(chore) for chore in chores]
        yield
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await state.live.close()

    app = FastAPI(
        title="dnrpipe",
        version=__version__,
        summary="Jobs that turn scenes into neural renderers, and their live view.",
        docs_url=None,  # its scripts come from a CDN
        redoc_url=None,
        lifespan=lifespan,
        separate_input_output_schemas=True,
    )
    app.state.service = state
    for module in (routes_server, routes_jobs, routes_workspaces, routes_live, routes_leases):
        app.include_router(module.router)
    for kind in (*_STATUS, RequestValidationError, HTTPException):
        app.add_exception_handler(kind, _answer)
    app.add_middleware(
        Guard,
        hosts=LOOPBACK if state.config.host in LOOPBACK else (),
        public=state.config.public_url,
        users=users,
        rate=state.config.rate,
        burst=state.config.burst,
    )
    if users is not None:
        schema = app.openapi()  # made once, and kept
        schema.setdefault("components", {})["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
        schema["security"] = [{"token": []}]
    return app


async def _prune_regularly(state: State) -> None:
    """Delete old logs and events at the start and every hour, for as long as the server runs."""
    while True:
        try:
            pruned = await run_in_threadpool(state.queue.prune, state.root, state.config)
            await run_in_threadpool(state.root.drop_deleted, time.time() - 86_400 * state.config.undo_days)
            if pruned:
                LOG.info("old logs and events removed", extra={"facts": {"jobs": len(pruned)}})
        except Exception:  # a full disk, a busy queue: the server goes on and tries again
            LOG.exception("old logs and events could not be removed")
        await asyncio.sleep(3600)


async def _end_lapsed_leases(state: State) -> None:
    """Queue jobs again whose workers elsewhere are silent, for as long as the server runs."""
    while True:
        try:
            for job in await run_in_threadpool(state.queue.recover_lapsed):
                WORKERS.error("worker elsewhere was lost", extra={"facts": {"job": job}})
        except Exception:  # a full disk, a busy queue: the server goes on and tries again
            WORKERS.exception("lapsed leases could not be ended")
        await asyncio.sleep(LAPSE_INTERVAL)


async def _answer(_: Request, error: Exception) -> JSONResponse:
    """What is wrong, in one line."""
    if isinstance(error, HTTPException):
        return JSONResponse({"detail": str(error.detail)}, error.status_code, headers=error.headers)
    if isinstance(error, RequestValidationError):
        return JSONResponse({"detail": first_fault(error)}, 422)
    status = next(status for kind, status in _STATUS.items() if isinstance(error, kind))
    return JSONResponse({"detail": one_line(error)}, status)

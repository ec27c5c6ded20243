"""The web application: routes, error answers, and the description (/openapi.json)."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from .. import __version__
from ..core.errors import UserError
from . import routes_jobs, routes_live, routes_server, routes_workspaces
from .config import LOOPBACK, ServerConfig
from .guard import Guard
from .pruning import prune_regularly
from .queue import QueueFull, WrongState
from .root import UnknownName
from .state import State

_STATUS: dict[type[Exception], int] = {QueueFull: 429, WrongState: 409, UnknownName: 404, UserError: 422}


def create_app(state: State, token: str | None) -> FastAPI:
    """The application for ``state``. token: None only where the server listens on the loopback interface."""

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        chores = (state.feed.watch(), state.live.close_idle(), prune_regularly(state.queue, state.root, state.config))
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
    for module in (routes_server, routes_jobs, routes_workspaces, routes_live):
        app.include_router(module.router)
    for kind, status in _STATUS.items():
        app.add_exception_handler(kind, _answer(status))
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _refused)
    app.add_middleware(
        Guard,
        hosts=hosts_of(state.config),
        token=token,
        rate=state.config.rate,
        burst=state.config.burst,
    )
    if token is not None:
        _describe_token(app)
    return app


def hosts_of(config: ServerConfig) -> set[str]:
    """Host names that requests may address: those of the loopback interface; any, if the server has another one."""
    return set(LOOPBACK) if config.loopback else set()


def _answer(status: int) -> Any:
    async def handle(_: Request, error: Exception) -> JSONResponse:
        return JSONResponse({"detail": " ".join(str(error).split())}, status)

    return handle


async def _refused(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    return JSONResponse({"detail": str(error.detail)}, error.status_code, headers=error.headers)


async def _invalid(_: Request, error: Exception) -> JSONResponse:
    """The first fault of a request in one line, without what was sent (it may be anything)."""
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return JSONResponse({"detail": f"{where}: {first['msg']}"}, 422)


def _describe_token(app: FastAPI) -> None:
    """Add the token to the description."""
    plain = app.openapi

    def described() -> dict[str, Any]:
        schema = plain()
        schemes = schema.setdefault("components", {}).setdefault("securitySchemes", {})
        schemes["token"] = {"type": "http", "scheme": "bearer"}
        schema["security"] = [{"token": []}]
        return schema

    app.openapi = described  # type: ignore[method-assign]

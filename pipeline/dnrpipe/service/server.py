"""`dnrpipe serve`: one server per root, its workers, its log."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import sys
import time
from collections.abc import Callable, Mapping, MutableMapping
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from ..core.errors import UserError
from .app import create_app
from .config import LOOPBACK, ServerConfig
from .guard import is_upload
from .live_pool import LivePool
from .queue import Queue
from .root import ServiceRoot
from .state import Feed, State
from .supervisor import Supervisor
from .users import User
from .worker import MACHINE_VARIABLES

HEAD_SECONDS, BODY_SECONDS = 20.0, 30.0
"""How long a client may take to send the head of a request, and its body."""
UPGRADED = ("upgraded", 0)


def serve(config: ServerConfig, users: Mapping[str, User] | None, *, ready: Callable[[str], None]) -> None:
    """Serve until SIGTERM or Ctrl-C. ``ready`` is called with the address once requests are answered.

    Raises UserError: a host that others can reach without a token, a root that another server holds, a port in use.
    """
    if config.host not in LOOPBACK and users is None:
        raise UserError(f"--host {config.host}: others can reach it, so a token is needed; give --token-file FILE")
    if users is None and (config.public_url or config.trusted_proxy):
        raise UserError("behind a proxy others can reach the server, so a token is needed; give --token-file FILE")
    if not config.root.parent.is_dir():
        raise UserError(f"--root {config.root}: {config.root.parent} does not exist")
    forget_settings(os.environ)
    root = ServiceRoot(config.root).create()
    config = config.model_copy(update={"root": root.folder})
    os.chdir(root.folder)  # a dnrpipe.toml there counts for the pages as it does for the jobs, and no other
    _log_as_json()
    with root.held(f"{root.folder}: another server works here; stop it or choose another --root"):
        root.clear()
        queue = Queue(root.queue)
        queue.recover()
        supervisor = Supervisor(config, queue, root.private / "workers.log")
        live = LivePool(config, root)
        state = State(config, root, queue, supervisor, live, Feed(queue))
        settings = uvicorn.Config(
            create_app(state, users),
            host=config.host,
            port=config.port,
            log_config=None,
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=3,
            ws="websockets-sansio",
            ws_max_size=64 * 1024,
            http=_Patient,
            proxy_headers=bool(config.trusted_proxy),
            forwarded_allow_ips=config.trusted_proxy or "",
            limit_concurrency=config.streams + 1000,
        )
        try:
            socket = settings.bind_socket()
        except SystemExit:  # how uvicorn reports it
            raise UserError(f"--port {config.port}: cannot be listened on at {config.host}; choose another") from None
        host = f"[{config.host}]" if ":" in config.host else config.host
        server = _Server(settings, lambda: ready(f"http://{host}:{socket.getsockname()[1]}"))
        supervisor.start()
        try:
            with contextlib.suppress(KeyboardInterrupt):  # the usual end; uvicorn raises it after its shutdown
                server.run(sockets=[socket])
        finally:
            supervisor.stop()
            queue.close()


def forget_settings(environment: MutableMapping[str, str]) -> None:
    """Jobs and the dashboard see the settings of workspaces, not those of whoever starts the server."""
    for name in [n for n in environment if n.startswith("DNRPIPE_") and n not in MACHINE_VARIABLES]:
        del environment[name]


class _Patient(H11Protocol):
    """Closes connections whose request does not come: its head in time, and its body, uploads aside."""

    _timer: asyncio.TimerHandle | None = None
    _awaited: tuple[str, int] | None = None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self._awaited != UPGRADED:
            self._watch()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._await(UPGRADED, 0.0)
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        self._await(None, 0.0)
        super().connection_lost(exc)

    def _watch(self) -> None:
        """Look at what is awaited; more bytes of the same are no reason to wait longer."""
        theirs = self.conn.their_state
        if theirs is h11.IDLE:
            self._await(("head", id(self.cycle)), HEAD_SECONDS)
        elif theirs is h11.SEND_BODY and not is_upload(self.scope):
            self._await(("body", id(self.cycle)), BODY_SECONDS)
        else:
            self._await(None, 0.0)

    def _await(self, what: tuple[str, int] | None, seconds: float) -> None:
        if what == self._awaited:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._awaited, self._timer = what, self.loop.call_later(seconds, self._close) if seconds else None

    def _close(self) -> None:
        if not self.transport.is_closing():
            self.transport.close()


class _Server(uvicorn.Server):
    """Calls `ready` once it answers requests."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self.ready = ready

    async def startup(self, sockets: Any = None) -> None:
        await super().startup(sockets)
        if self.started:
            self.ready()


class _JsonLines(logging.Formatter):
    """One JSON object per line; facts come as ``extra={"facts": {...}}``."""

    def format(self, record: logging.LogRecord) -> str:
        line = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(record.created)),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **getattr(record, "facts", {}),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line)


def _log_as_json() -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_JsonLines())
    for name in ("dnrpipe", "uvicorn"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [handler], False
        logger.setLevel(logging.INFO if name == "dnrpipe" else logging.WARNING)

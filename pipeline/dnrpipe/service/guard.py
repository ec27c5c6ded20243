"""Access control and rate limits: checks every request before a route sees it.

A token names a user, whose role says what kinds of requests are theirs. It comes in a header (`Authorization: Bearer
...`), or as the subprotocol `dnrpipe.token.<token>` of a WebSocket, for which browsers send no headers. The comparison
takes constant time, and no log shows the token. A server on the loopback interface needs no token, but answers only to
the names of that interface and to pages of its own origin: web pages that the user visits can neither read nor send
anything (DNS rebinding, cross-site requests). Behind a proxy it answers to the name of its public address, too; what a
proxy says of the client counts where that proxy is trusted.
"""

from __future__ import annotations

import hmac
import logging
import math
import re
import time
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from .users import LOCAL, User

ACCESS = logging.getLogger("dnrpipe.access")
SUBPROTOCOL = "dnrpipe.live"
TOKEN_PREFIX = "dnrpipe.token."
MAX_BODY = 256 * 1024
"""Bytes of any request but an upload: of a scene, or of what a worker elsewhere made."""
MAX_CLIENTS = 10_000
REFUSALS_PER_MINUTE = 20
WORKER_PATHS = "/leases"
OPEN_PATHS = ("/", "/healthz", "/favicon.ico")
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:;"
    " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Buckets:
    """A token bucket per client: gains `rate` tokens a second, holds at most `size`.

    Drops the clients that were silent for longest.
    """

    def __init__(self, rate: float, size: float) -> None:
        self.rate, self.size = rate, size
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()  # level, when

    def take(self, client: str) -> float:
        """Take a token of `client`: 0 if there is one, else the seconds until there is."""
        level = self._level(client)
        taken = level >= 1
        self._levels[client] = (level - taken, time.monotonic())
        if len(self._levels) > MAX_CLIENTS:
            self._levels.popitem(last=False)
        return 0.0 if taken else (1 - level) / self.rate

    def _level(self, client: str) -> float:
        level, updated = self._levels.get(client, (self.size, 0.0))
        if client in self._levels:
            self._levels.move_to_end(client)
        return min(self.size, level + (time.monotonic() - updated) * self.rate)


class Guard:
    """ASGI middleware around the application.

    Args:
        hosts: names that the Host header may have, without port; empty: any (then there is a token).
        public: the address that a proxy in front answers to, or "".
        users: every request needs the token of one of them, but for the open paths; None: no token.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        hosts: Iterable[str],
        public: str = "",
        users: Mapping[str, User] | None,
        rate: float,
        burst: int,
    ) -> None:
        self.app = app
        self.public = _origin(public) if public else None
        self.hosts = frozenset(hosts) | ({self.public[1]} if self.public and hosts else set())
        self.users = None if users is None else {token.encode(): user for token, user in users.items()}
        self.rates = Buckets(rate, burst)
        self.refusals = Buckets(REFUSALS_PER_MINUTE / 60, REFUSALS_PER_MINUTE)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        started = time.monotonic()
        status = 0

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        client = (scope.get("client") or "?")[0]
        refusal = self._refusal(scope, Headers(scope=scope), client)
        try:
            if refusal is not None:
                await refusal(scope, receive, sending)
            else:
                await self.app(scope, self._bounded(scope, receive), sending)
        finally:
            facts = {
                "client": client,
                "method": scope.get("method", "WEBSOCKET"),
                "path": scope["path"],
                "status": status,
                "ms": round(1000 * (time.monotonic() - started), 1),
            }
            ACCESS.info("request", extra={"facts": facts})

    def _refusal(self, scope: Scope, headers: Headers, client: str) -> ASGIApp | None:
        """The answer if the guard refuses the request, else None."""

        def refused(status: int, reason: str, **more: str) -> ASGIApp:
            if scope["type"] == "websocket":
                return WebSocketClose(1008, reason)  # before accept: 403
            return JSONResponse({"detail": reason}, status, {"connection": "close", **more})

        host = headers.get("host", "")
        if self.hosts and _name_of(host) not in self.hosts:
            return refused(421, f"this server does not answer to the host name {host[:80]!r}")
        forwarded = headers.get("x-forwarded-host")  # a proxy that hides the name it was asked by
        if forwarded is not None and _name_of(forwarded) not in {_name_of(host), self.public and self.public[1]}:
            return refused(421, f"this server does not answer to the host name {forwarded[:80]!r} (--public-url)")
        origin = headers.get("origin")
        named = _origin(origin or "")  # None, too, where it is no address that `urlsplit` takes
        own = origin is None or (named is not None and urlsplit(origin).netloc.lower() == host.lower())
        if not own and (self.public is None or named != self.public):
            return refused(403, "requests of pages from other origins are refused")
        # The dashboard's files hold no data, and the dashboard asks for the token.
        is_open = scope["type"] == "http" and (scope["path"] in OPEN_PATHS or scope["path"].startswith("/static/"))
        # The token first: who has it is never locked out by others behind the same address. Tokens are long and random
        # (users.TOKEN_PATTERN): guesses need no other bound than the one on wrong answers.
        user = LOCAL if is_open or self.users is None else self._user(_given_token(scope, headers))
        if user is None:
            if self.refusals.take(client) > 0:
                more = {"retry-after": "60", "www-authenticate": "Bearer"}
                return refused(429, "too many wrong tokens; wait a minute", **more)
            reason = "wrong or missing token; send it as Authorization: Bearer TOKEN"
            return refused(401, reason, **{"www-authenticate": "Bearer"})
        if not is_open and not _allowed(user, scope):
            return refused(403, f"{user.name} is a {user.role} here; ask the operator for another role")
        scope.setdefault("state", {})["user"] = user
        wait = self.rates.take(client if is_open or self.users is None else f"{client} as {user.name}")
        if wait > 0:
            return refused(429, "too many requests; slow down", **{"retry-after": str(max(1, math.ceil(wait)))})
        length = headers.get("content-length", "0")
        if not is_upload(scope) and length.isascii() and length.isdigit() and int(length) > MAX_BODY:
            return refused(413, f"the request is larger than {MAX_BODY} bytes")
        return None

    def _user(self, token: bytes) -> User | None:
        """Whose token it is; takes as long for any."""
        assert self.users is not None
        found = [user for known, user in self.users.items() if hmac.compare_digest(token, known)]
        return found[0] if found else None

    def _bounded(self, scope: Scope, receive: Receive) -> Receive:
        """Cut a body without a stated length off at the same size; the route then sees a broken request."""
        if is_upload(scope) or scope["type"] != "http":
            return receive
        seen = 0

        async def receiving() -> Message:
            nonlocal seen
            message = await receive()
            seen += len(message.get("body", b""))
            return message if seen <= MAX_BODY else {"type": "http.disconnect"}

        return receiving


def _allowed(user: User, scope: Scope) -> bool:
    """Whether the role allows the kind of request; what is whose, the routes ask."""
    if scope["path"].startswith(WORKER_PATHS):
        return user.role in ("worker", "admin")
    looks = scope["type"] == "websocket" or scope["method"] in ("GET", "HEAD", "OPTIONS")
    return user.role in ("submitter", "admin") or (user.role == "viewer" and looks)


def _origin(url: str) -> tuple[str, str, int] | None:
    """(scheme, host name, port) of an address; None: it is none."""
    try:
        parts = urlsplit(url.lower())
        port = parts.port or {"http": 80, "https": 443}[parts.scheme]
    except (KeyError, ValueError):
        return None
    return (parts.scheme, parts.hostname, port) if parts.hostname else None


def _name_of(host: str) -> str:
    """``[::1]:8420`` -> ``::1``; empty where it is no host and port."""
    found = re.fullmatch(r"(?:\[([0-9a-f:]+)\]|([a-z0-9.-]+))(?::[0-9]{1,5})?", host.lower())
    return (found[1] or found[2]) if found else ""


def is_upload(scope: Any) -> bool:
    """Whether a request sends a scene file, or what a worker elsewhere made."""
    if scope["type"] != "http" or scope["method"] != "PUT":
        return False
    path = scope["path"]
    return path.startswith("/scenes/") or (path.startswith(f"{WORKER_PATHS}/") and path.endswith("/result"))


def _given_token(scope: Scope, headers: Headers) -> bytes:
    scheme, _, value = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return value.strip().encode("utf-8", "replace")
    if scope["type"] == "websocket":
        for name in scope.get("subprotocols", []):
            if name.startswith(TOKEN_PREFIX):
                return name.removeprefix(TOKEN_PREFIX).encode("utf-8", "replace")
    return b""

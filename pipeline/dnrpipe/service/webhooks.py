"""Telling other servers that a job has ended: a POST of the job as JSON, to addresses that the operator allows.

An address is allowed where its origin, and the path as a prefix, are those of a `serve --webhook`. A name that leads to
this machine or into a private network is refused even then; there the operator writes the network address itself. So a
submitter cannot reach into the network through the server, not by a name that changes its address either: the
connection goes to the address that was looked at. Redirects are not followed. A receiver that does not answer is tried
again twice.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import socket
import sqlite3
from collections.abc import Sequence
from urllib.parse import SplitResult, urlsplit

import httpx
from fastapi import HTTPException
from starlette.concurrency import run_in_threadpool

from .models import Job
from .queue import Queue

LOG = logging.getLogger("dnrpipe.webhooks")
POLL, TIMEOUT = 1.0, 10.0
PAUSES = (10.0, 60.0)
"""Seconds before the second and the third attempt."""


def check_webhook(url: str, allowed: Sequence[str]) -> None:
    """Raises HTTPException 422: not an address that the operator allows."""
    if _allowing(url, allowed) is None:
        known = f"those begin with {', '.join(allowed)}" if allowed else "ask its operator for serve --webhook"
        raise HTTPException(422, f"webhook: not an address that this server calls; {known}")


def address_of(url: str, allowed: Sequence[str]) -> str:
    """The network address to connect to. Raises ValueError: not allowed, unknown, or in a private network that the
    operator did not name."""
    prefix = _allowing(url, allowed)
    if prefix is None:
        raise ValueError("the operator allows it no more")
    parts = urlsplit(url)
    found = socket.getaddrinfo(parts.hostname, _port(parts), type=socket.SOCK_STREAM)
    addresses = [str(entry[4][0]) for entry in found]
    named = _is_literal(urlsplit(prefix).hostname or "")
    for address in addresses:
        if not named and not ipaddress.ip_address(address.partition("%")[0]).is_global:
            raise ValueError(f"{parts.hostname} leads into a private network; --webhook has to name its address")
    return addresses[0]


async def tell(job: Job, allowed: Sequence[str]) -> None:
    """One attempt. Raises ValueError, OSError, httpx.HTTPError: it was not heard."""
    url = str(job.request.webhook)
    parts = urlsplit(url)
    address = await run_in_threadpool(address_of, url, allowed)
    host = f"[{address}]" if ":" in address else address
    target = parts._replace(netloc=f"{host}:{_port(parts)}").geturl()
    async with httpx.AsyncClient(follow_redirects=False, timeout=TIMEOUT, trust_env=False) as client:
        answer = await client.post(
            target,
            content=job.model_dump_json(),
            headers={"Host": parts.netloc, "Content-Type": "application/json", "User-Agent": "dnrpipe"},
            extensions={"sni_hostname": parts.hostname},
        )
    if not answer.is_success:
        raise ValueError(f"it answered with {answer.status_code}")


async def tell_of_ended(queue: Queue, allowed: Sequence[str]) -> None:
    """Tell of every job that ends, for as long as the server runs; those of a former server first."""
    while True:
        try:
            for job, attempt in await run_in_threadpool(queue.due_hooks):
                again = await _attempt(job, attempt, allowed)
                await run_in_threadpool(queue.hook_told, job.id, again)
        except sqlite3.Error:  # a full disk, a busy queue: the server goes on and tries again
            LOG.exception("webhooks could not be looked up")
        await asyncio.sleep(POLL)


async def _attempt(job: Job, attempt: int, allowed: Sequence[str]) -> float | None:
    """Seconds until the next attempt; None: it was heard, or is given up."""
    try:
        await tell(job, allowed)
    except (ValueError, OSError, httpx.HTTPError) as error:
        reason = str(error) or type(error).__name__
        facts = {"job": job.id, "url": job.request.webhook, "attempt": attempt + 1, "reason": reason}
        LOG.warning("webhook failed", extra={"facts": facts})
        return PAUSES[attempt] if attempt < len(PAUSES) else None
    return None


def _allowing(url: str, allowed: Sequence[str]) -> str | None:
    """The operator's address that allows ``url``."""
    try:
        wanted = urlsplit(url)
        for prefix in allowed:
            known = urlsplit(prefix)
            same = (wanted.scheme, wanted.hostname, _port(wanted)) == (known.scheme, known.hostname, _port(known))
            below = wanted.path == known.path or wanted.path.startswith(known.path.rstrip("/") + "/")
            if same and below and wanted.username is None and ".." not in wanted.path:
                return prefix
    except ValueError:
        pass
    return None


def _port(parts: SplitResult) -> int:
    return parts.port or (443 if parts.scheme == "https" else 80)


def _is_literal(host: str) -> bool:
    """Whether the operator wrote an address or this machine's name: it is meant."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return host == "localhost"
    return True

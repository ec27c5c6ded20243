"""A request's body, which may be large, into a file."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

from fastapi import HTTPException, Request
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect


async def receive(
    request: Request, target: Path, most_mb: int | None, alive: Callable[[], None] = lambda: None
) -> tuple[str, int]:
    """(SHA-256, bytes) of the body, which is in ``target`` then; calls ``alive`` at each piece of it.

    Raises HTTPException: 413 above ``most_mb`` MiB, 400 if the connection ends before the body does. The caller
    removes the file.
    """
    limit = None if most_mb is None else most_mb * 2**20
    declared = request.headers.get("content-length", "")
    if limit is not None and declared.isascii() and declared.isdigit() and int(declared) > limit:
        raise HTTPException(413, f"the file is larger than {most_mb} MiB")
    checksum, size = hashlib.sha256(), 0
    try:
        with target.open("xb") as file:

            def keep(chunk: bytes) -> None:
                file.write(chunk)
                alive()

            async for chunk in request.stream():
                size += len(chunk)
                if limit is not None and size > limit:
                    raise HTTPException(413, f"the file is larger than {most_mb} MiB")
                checksum.update(chunk)
                await run_in_threadpool(keep, chunk)
    except ClientDisconnect:
        raise HTTPException(400, "the connection ended before the file did") from None
    return checksum.hexdigest(), size

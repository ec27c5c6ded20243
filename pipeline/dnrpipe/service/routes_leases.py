"""Workers elsewhere: take a job, say that they live, fetch what it needs, send what it made, end it.

Only roles `worker` and `admin` come here (`guard`).
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import secrets
import shutil
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Header, HTTPException, Query, Request, Response
from fastapi import Path as PathParameter
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from .. import __version__
from ..core.errors import UserError
from ..core.scene_files import TAKES_SCENE
from ..core.workspace import Workspace, locked
from . import archive
from .config import tightest
from .leases import (
    ID_PATTERN,
    SECONDS,
    SHA256_HEADER,
    SHA256_PATTERN,
    Beat,
    BeatAnswer,
    Lease,
    LeaseTerms,
    LeaseWish,
    SceneFile,
)
from .models import End, Job
from .queue import Queue
from .root import ServiceRoot
from .routes_jobs import REFUSED, refusals
from .state import Shared, State
from .uploads import receive

LeasePath = Annotated[str, PathParameter(pattern=ID_PATTERN)]
TAR: dict[int | str, dict[str, Any]] = {200: {"content": {"application/x-tar": {}}, "description": "A tar"}}
FILE: dict[int | str, dict[str, Any]] = {200: {"content": {"application/octet-stream": {}}, "description": "A file"}}
BINARY = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
BODY = {"requestBody": {"required": True, "content": BINARY}}
ARCHIVE_SHARE = 1.1
"""How much larger than a workspace's files their archive may be."""

router = APIRouter(tags=["leases"], responses=REFUSED)


class _Alive:
    """A transfer is a sign of life, too: called at each piece, it extends the lease every few seconds."""

    INTERVAL = SECONDS / 10

    def __init__(self, queue: Queue, lease: str) -> None:
        self.queue, self.lease, self.due = queue, lease, 0.0

    def __call__(self) -> None:
        """Raises LeaseGone."""
        if time.monotonic() >= self.due:
            self.queue.extend(self.lease, SECONDS)
            self.due = time.monotonic() + self.INTERVAL


@router.get("/leases", responses=refusals(409))
def terms(version: Annotated[str, Query(max_length=64, description="The worker's dnrpipe")]) -> LeaseTerms:
    """What a worker may expect here. 409: its dnrpipe is another than the server's."""
    _require_same(version)
    return LeaseTerms(seconds=SECONDS)


@router.post("/leases", responses=refusals(409) | {204: {"description": "Nothing waits"}}, response_model=Lease)
def take(wish: LeaseWish, service: Shared) -> Lease | Response:
    """Take the next job. 409: the worker's dnrpipe is another than the server's."""
    _require_same(wish.version)
    lease = secrets.token_urlsafe(24)
    job = service.queue.claim(f"{wish.worker}/{wish.device}", lease=lease, seconds=SECONDS)
    if job is None:
        return Response(status_code=204)
    # How much memory there is, each machine knows of itself.
    ours = service.config.limits.model_copy(update={"memory_mb": None})
    settings = service.root.folder / "dnrpipe.toml"
    return Lease(
        id=lease,
        seconds=SECONDS,
        job=job,
        scene=_scene_of(job, service.root),
        root=str(service.root.folder),
        settings=settings.read_text(encoding="utf-8", errors="replace") if settings.is_file() else "",
        limits=tightest(job.request.limits, ours),
    )


@router.post("/leases/{lease}", responses=refusals(410))
def beat(lease: LeasePath, told: Beat, service: Shared) -> BeatAnswer:
    """A sign of life, with what the job has said since the last."""
    queue = service.queue
    with queue.leased(lease) as job:
        if queue.hear(job.id, told.number):
            queue.add_events(job.id, told.told())
            with service.root.log(job.id).open("ab") as log:
                log.write(told.log)
        queue.extend(lease, SECONDS)
        return BeatAnswer(cancelled=job.cancel_requested)


@router.get("/leases/{lease}/scene", response_class=StreamingResponse, responses=refusals(404, 410) | FILE)
def fetch_scene(lease: LeasePath, service: Shared) -> StreamingResponse:
    """The scene file that the lease names."""
    job = service.queue.extend(lease, SECONDS)
    scene = _scene_of(job, service.root)
    if scene is None:
        raise HTTPException(404, f"job {job.id} needs no scene file")
    _, path = service.root.submitted_scene(scene.name, scene.sha256)
    headers = {"content-length": str(path.stat().st_size)}
    pieces = _pieces(path, _Alive(service.queue, lease))
    return StreamingResponse(pieces, media_type="application/octet-stream", headers=headers)


@router.get("/leases/{lease}/workspace", response_class=StreamingResponse, responses=refusals(410) | TAR)
def fetch_workspace(lease: LeasePath, service: Shared) -> StreamingResponse:
    """All files of the job's workspace, if there is one yet."""
    job = service.queue.extend(lease, SECONDS)
    workspace = service.root.workspace(job.request.workspace, must_exist=False)
    alive = _Alive(service.queue, lease)

    def pieces() -> Iterator[bytes]:
        for piece in archive.pack(workspace, archive.stamps(workspace)):
            alive()
            yield piece

    return StreamingResponse(pieces(), media_type="application/x-tar")


@router.put("/leases/{lease}/result", status_code=204, responses=refusals(409, 410, 507), openapi_extra=BODY)
async def receive_result(
    lease: LeasePath,
    request: Request,
    service: Shared,
    sha256: Annotated[str, Header(alias=SHA256_HEADER, pattern=SHA256_PATTERN)],
) -> Response:
    """New and changed files of the job's workspace. They are there when all of them are here and checked, or none.

    409: a command works in the workspace.
    """
    job = await run_in_threadpool(service.queue.extend, lease, SECONDS)
    await run_in_threadpool(service.require_space, service.root.private)
    limits = tightest(job.request.limits, service.config.limits)
    most_mb = None if limits.disk_mb is None else int(ARCHIVE_SHARE * limits.disk_mb) + 16
    alive = _Alive(service.queue, lease)
    folder = service.root.incoming / secrets.token_hex(8)
    try:
        folder.mkdir()
        found, _ = await receive(request, folder / "result.tar", most_mb, alive)
        if found != sha256:
            raise HTTPException(422, "the body is not what its checksum says; it was damaged on the way, send it again")
        async with _kept(service.queue, lease):
            await run_in_threadpool(_place, folder, lease, service)
    finally:
        await run_in_threadpool(shutil.rmtree, folder, True)
    return Response(status_code=204)


@router.post("/leases/{lease}/end", status_code=204, responses=refusals(409, 410))
def end(lease: LeasePath, how: End, service: Shared) -> Response:
    """How the job ended. 409: it is done, but what it made did not come."""
    with service.queue.leased(lease) as job:
        if how.state == "done" and not service.queue.has_result(job.id):
            raise HTTPException(409, f"job {job.id} cannot be done: send its result first")
        service.queue.end(job.id, how)
    return Response(status_code=204)


@contextlib.asynccontextmanager
async def _kept(queue: Queue, lease: str) -> AsyncIterator[None]:
    """The worker waits for us: its lease lasts meanwhile."""

    async def extend() -> None:
        while True:
            await run_in_threadpool(queue.extend, lease, SECONDS)
            await asyncio.sleep(_Alive.INTERVAL)

    task = asyncio.create_task(extend())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def _place(folder: Path, lease: str, service: State) -> None:
    """Check and unpack what came, and move it into the workspace. Raises BadArchive, LeaseGone, HTTPException 409."""
    fresh = folder / "files"
    fresh.mkdir()
    with (folder / "result.tar").open("rb") as tar:
        archive.unpack(tar, fresh)
    archive.save(fresh)
    queue = service.queue
    workspace = service.root.workspace(queue.extend(lease, SECONDS).request.workspace, must_exist=False)
    with contextlib.ExitStack() as stack:
        if workspace.exists() or archive.brings_files(fresh):  # else the job made none; locking would make a folder
            try:
                stack.enter_context(locked(workspace, "result of a worker"))
            except UserError as error:
                raise HTTPException(409, str(error)) from None
        job = stack.enter_context(queue.leased(lease))  # it can be nobody else's before the files are there
        archive.put_in_place(fresh, workspace)
        queue.result_came(job.id)


def _require_same(version: str) -> None:
    if version != __version__:
        raise HTTPException(409, f"this server is dnrpipe {__version__}, the worker {version[:64]}; install the same")


def _scene_of(job: Job, root: ServiceRoot) -> SceneFile | None:
    """What commands of scenes read: the file that the job was submitted with, else that of the workspace."""
    request = job.request
    if request.command not in TAKES_SCENE:
        return None
    if request.scene is not None and request.scene_sha256 is not None:
        return SceneFile(name=request.scene, sha256=request.scene_sha256)
    try:
        source = Workspace.open(root.workspace(request.workspace)).manifest.source
        if not re.fullmatch(SHA256_PATTERN, source.sha256):
            return None
        sha256, path = root.submitted_scene(Path(source.path).name, source.sha256)
    except UserError:  # it was not uploaded, or is gone; the command says so if it matters
        return None
    return SceneFile(name=path.name, sha256=sha256)


def _pieces(path: Path, alive: _Alive) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(archive.CHUNK):
            alive()
            yield piece

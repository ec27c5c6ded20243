"""Jobs: submit, list, look at, cancel, retry, logs, events."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Header, HTTPException, Path, Query
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from ..core.cameras import KEYWORDS
from ..core.scene_files import TAKES_SCENE
from ..core.settings import merge, parse_assignment, resolve
from ..core.shot_records import parse_frames
from .models import EXPORTS, FINAL, Job, JobPage, JobRequest, LogPage, Name, Problem, State
from .state import Shared
from .state import State as Service
from .users import Caller, User
from .webhooks import check_webhook

KEEP_ALIVE = 15.0
LOG_CHUNK = 256 * 1024
SERVER_SETTINGS = ("device", "strict", "executor")
"""Settings that the server decides."""
STATUSES = {
    400: "The request is not what HTTP wants",
    401: "Wrong or missing token",
    403: "A page of another origin",
    404: "No such thing",
    409: "The job's state forbids it",
    410: "The lease is over",
    413: "Too large",
    421: "Not a name of this server",
    422: "Not a valid request",
    429: "Too many requests, or too many jobs",
    503: "Too many streams",
    507: "No space left",
}


def refusals(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """These answers in the description of a route."""
    return {status: {"model": Problem, "description": STATUSES[status]} for status in statuses}


EVENT: dict[str, Any] = {
    "type": "object",
    "properties": {name: {"type": "string"} for name in ("id", "event", "data")} | {"retry": {"type": "integer"}},
}
"""One server-sent event, as its fields are parsed."""
JobPath = Annotated[int, Path(ge=1, le=2**53, description="The job's number")]

REFUSED = refusals(400, 401, 403, 413, 421, 422, 429)
"""What every route may answer."""

router = APIRouter(tags=["jobs"], responses=REFUSED)


@router.post("/jobs", status_code=201, responses=refusals(404, 503, 507))
def submit(
    request: JobRequest,
    service: Shared,
    caller: Caller,
    idempotency_key: Annotated[str | None, Header(max_length=64, pattern=r"^[A-Za-z0-9_-]{8,64}$")] = None,
) -> Job:
    """Put a job into the queue. It is on disk when the answer is sent.

    A request that repeats an Idempotency-Key gets the job that the first one made.
    """
    check_request(request, service)
    service.require_space(service.root.folder)
    if request.scene is not None:  # a later upload of that name is no business of this job
        sha256, _ = service.root.submitted_scene(request.scene, request.scene_sha256)
        request = request.model_copy(update={"scene_sha256": sha256})
    return service.queue.submit(
        request, most_queued=service.config.most_queued, token=idempotency_key, owner=caller.name
    )


@router.get("/jobs")
def list_jobs(
    service: Shared,
    state: Annotated[list[State] | None, Query(max_length=5)] = None,
    workspace: Annotated[Name | None, Query()] = None,
    search: Annotated[str, Query(max_length=200, description="Words in number, workspace, command or owner")] = "",
    before: Annotated[int | None, Query(ge=1, le=2**53)] = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 100,
) -> JobPage:
    """Jobs, newest first."""
    jobs = service.queue.page(states=state or (), workspace=workspace, search=search, before=before, limit=limit + 1)
    more = len(jobs) > limit
    return JobPage(jobs=jobs[:limit], next=jobs[limit - 1].id if more else None)


@router.get("/jobs/{job}", responses=refusals(404))
def get_job(job: JobPath, service: Shared) -> Job:
    """One job."""
    return service.queue.get(job)


@router.post("/jobs/{job}/cancel", responses=refusals(404, 409))
def cancel(job: JobPath, service: Shared, caller: Caller) -> Job:
    """Cancel a queued or running job. A running one stops within seconds; what it made is kept."""
    require_own(service.queue.get(job), caller)
    return service.queue.cancel(job)


@router.post("/jobs/{job}/retry", responses=refusals(404, 409))
def retry(job: JobPath, service: Shared, caller: Caller) -> Job:
    """Queue a failed or cancelled job again. It goes on from its checkpoints."""
    require_own(service.queue.get(job), caller)
    return service.queue.retry(job)


@router.get("/jobs/{job}/logs", responses=refusals(404))
def logs(
    job: JobPath,
    service: Shared,
    offset: Annotated[int, Query(ge=-(2**40), le=2**40, description="Bytes; negative: from the end")] = 0,
) -> LogPage:
    """What the job's process printed: at most 256 KiB from ``offset``."""
    service.queue.get(job)
    try:
        with service.root.log(job).open("rb") as file:
            size = file.seek(0, 2)
            start = min(max(0, size + offset) if offset < 0 else offset, size)
            file.seek(start)
            data = file.read(LOG_CHUNK)
    except FileNotFoundError:
        return LogPage(text="", offset=0, next=0, size=0)
    return LogPage(text=data.decode("utf-8", "replace"), offset=start, next=start + len(data), size=size)


@router.get(
    "/jobs/{job}/events",
    response_class=StreamingResponse,
    responses=refusals(404)
    | {
        200: {
            "content": {"text/event-stream": {"schema": EVENT}},
            "description": "Server-sent events: id, event (its kind), data (JSON). Ends when the job has.",
        }
    }
    | refusals(503),
)
async def events(
    job: JobPath,
    service: Shared,
    after: Annotated[int, Query(ge=0, le=2**53, description="Id of the last event that is known")] = 0,
    last_event_id: Annotated[str | None, Header(max_length=32)] = None,
) -> StreamingResponse:
    """The job's events, those of the past first, then as they come.

    Last-Event-ID (which wins over `after`) resumes a broken stream: nothing is lost or sent twice.
    """
    await run_in_threadpool(service.queue.get, job)
    if last_event_id is not None and last_event_id.isascii() and last_event_id.isdigit():
        after = min(int(last_event_id), 2**53)
    stream = service.stream()
    stream.__enter__()  # refused before the answer starts; left by the generator

    async def lines() -> AsyncIterator[str]:
        service.feed.listeners += 1
        last = after
        try:
            yield "retry: 2000\n\n"
            while True:
                # The state first: the events read after it include all that came before it became final.
                ended = (await run_in_threadpool(service.queue.get, job)).state in FINAL
                found = await run_in_threadpool(service.queue.events, job, last)
                for event in found:
                    last = event.id
                    data = json.dumps({"time": event.time, **event.data})
                    yield f"id: {event.id}\nevent: {event.kind}\ndata: {data}\n\n"
                if found:
                    continue
                if ended:
                    yield "event: end\ndata: {}\n\n"
                    return
                if not await service.feed.wait(KEEP_ALIVE):
                    yield ": still here\n\n"
        finally:
            service.feed.listeners -= 1
            stream.__exit__(None, None, None)

    return StreamingResponse(lines(), media_type="text/event-stream")


def require_own(job: Job, caller: User) -> None:
    """Raises HTTPException 403: another's job, and not an admin."""
    if not caller.may_change(job.owner):
        raise HTTPException(403, f"job {job.id} is {job.owner or 'nobody'}'s; only they and admins may change it")


def check_request(request: JobRequest, service: Service) -> None:
    """Refuse what the job's command would refuse later: unknown settings, scenes, workspaces.

    Raises HTTPException 422, UnknownName.
    """
    if request.orbit is not None and request.command != "render":
        raise HTTPException(422, f"orbit: {request.command} makes no frames; only render does")
    if (request.frames or request.size) and request.command != "shot":
        raise HTTPException(422, f"frames, size: {request.command} takes none; only shot does")
    if request.frames is not None:
        parse_frames(request.frames)
    if request.command in EXPORTS and (request.settings or request.preset or request.force):
        raise HTTPException(422, f"settings: {request.command} takes none; it exports what is there")
    if request.webhook is not None:
        check_webhook(request.webhook, service.config.webhooks)
    if request.scene is not None:
        if request.command not in TAKES_SCENE:
            raise HTTPException(422, f"scene: {request.command} takes none; only {', '.join(TAKES_SCENE)} do")
        if request.scene_sha256 is None:
            service.root.scene(request.scene)
    path = service.root.workspace(request.workspace, must_exist=request.scene is None)
    if not path.exists() and len(service.root.workspaces()) >= service.config.most_workspaces:
        raise HTTPException(429, f"there are {service.config.most_workspaces} workspaces already; remove some")
    overrides: dict[str, Any] = {}
    for key, value in request.settings.items():
        if key.split(".")[0] in SERVER_SETTINGS:
            raise HTTPException(422, f"settings: {key} is the server's to decide")
        text = value if isinstance(value, str) else json.dumps(value)
        overrides = merge(overrides, parse_assignment(f"{key}={text}"))
    settings = resolve(request.preset, overrides, environment={})
    if settings.cameras.source not in KEYWORDS:
        raise HTTPException(422, f"settings: cameras.source must be one of {', '.join(KEYWORDS)} on a server")

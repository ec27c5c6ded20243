"""A typed client of `dnrpipe serve`.

with Client("http://127.0.0.1:8420") as client:
    scene = client.upload(Path("scene.blend"))
    job = client.submit(JobRequest(command="run", workspace="scene", scene=scene.name))
    for event in client.events(job.id):
        print(event.kind, event.data)
"""

from __future__ import annotations

import functools
import json
import secrets
import ssl
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Self, TypeVar

import httpx
from pydantic import TypeAdapter

from ..core.errors import UserError
from ..stages.records import PreviewState
from .models import (
    Deleted,
    Job,
    JobEvent,
    JobPage,
    JobRequest,
    LogPage,
    Result,
    Scene,
    State,
    WorkspaceDetail,
    WorkspaceSummary,
)

DEFAULT_SERVER = "http://127.0.0.1:8420"
RETRY_SECONDS = 4.0
"""Seconds during which the client retries a server that does not answer (it may be restarting)."""
RETRY_INTERVAL = 0.5
MAX_WAIT = 60.0
MAX_REFUSALS = 5
PASSING = (500, 502, 503, 504)
"""Statuses of a server, or of a proxy in front of it, that may answer in a moment: as good as no answer. Sending the
request again is safe: submits carry an idempotency key. 507, a full disk, is no such status."""
CHUNK = 1 << 20
Answer = TypeVar("Answer")


class Refused(UserError):
    """The server refused the request; `status` is the HTTP status. wait: seconds until it may be sent again, if so."""

    def __init__(self, status: int, message: str, wait: float | None = None) -> None:
        super().__init__(message)
        self.status, self.wait = status, wait


class Unreachable(UserError):
    """The server does not answer."""


class Client:
    """Talks to one server; retries when it is busy or does not answer.

    Raises Unreachable. Raises Refused: the server refuses the request.
    """

    def __init__(
        self, server: str = DEFAULT_SERVER, token: str | None = None, *, retry_seconds: float = RETRY_SECONDS
    ) -> None:
        self.server, self.retry_seconds = server, retry_seconds
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        try:
            self._http = httpx.Client(base_url=server, headers=headers, timeout=60.0, verify=_trust())
        except (httpx.InvalidURL, ValueError) as error:
            raise UserError(f"--server {server}: not an address ({error}); e.g. {DEFAULT_SERVER}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def submit(self, request: JobRequest) -> Job:
        """Queue a job: one job, even if a broken connection makes the client send it again."""
        headers = {"Idempotency-Key": secrets.token_urlsafe(24)}
        return self._ask("POST", "/jobs", Job, json=request.model_dump(mode="json"), headers=headers)

    def job(self, job: int) -> Job:
        return self._ask("GET", f"/jobs/{job}", Job)

    def jobs(self, states: Sequence[State] = (), search: str = "") -> Iterator[Job]:
        """All jobs, newest first; asks for further ones as they are wanted."""
        parameters: dict[str, Any] = {"state": states, "search": search, "limit": 500}
        while True:
            page = self._ask("GET", "/jobs", JobPage, params=parameters)
            yield from page.jobs
            if page.next is None:
                return
            parameters["before"] = page.next

    def cancel(self, job: int) -> Job:
        return self._ask("POST", f"/jobs/{job}/cancel", Job)

    def retry(self, job: int) -> Job:
        return self._ask("POST", f"/jobs/{job}/retry", Job)

    def log(self, job: int, offset: int = 0) -> LogPage:
        """At most 256 KiB of the job's log; a negative offset counts from its end."""
        return self._ask("GET", f"/jobs/{job}/logs", LogPage, params={"offset": offset})

    def events(self, job: int, after: int = 0) -> Iterator[JobEvent]:
        """The job's events until it has ended; resumes a broken stream where it broke.

        Raises UserError: nothing came for ``retry_seconds`` after it broke.
        """
        last, failing = after, None

        def heard() -> None:
            nonlocal failing
            failing = None

        while True:
            try:
                for event in self._stream(job, last, heard):
                    if event is None:
                        return
                    last = event.id
                    yield event
            except httpx.TransportError as error:
                now = time.monotonic()
                failing = failing or now
                if now - failing > self.retry_seconds:
                    raise UserError(f"{self.server}: the event stream broke ({error})") from None
            time.sleep(RETRY_INTERVAL)

    def upload(self, path: Path, name: str | None = None, *, sent: Callable[[int], None] | None = None) -> Scene:
        """Store a scene file on the server; calls `sent` with the size of each chunk, bytes."""

        def chunks() -> Iterator[bytes]:
            with path.open("rb") as file:
                while chunk := file.read(CHUNK):
                    yield chunk
                    if sent is not None:
                        sent(len(chunk))

        headers = {"Content-Length": str(path.stat().st_size), "Content-Type": "application/octet-stream"}
        try:
            answer = self._http.put(f"/scenes/{name or path.name}", content=chunks(), headers=headers)
        except httpx.TransportError as error:
            raise UserError(f"{self.server}: the upload of {path} broke ({error}); try again") from None
        return self._read(checked(answer), Scene)

    def workspaces(self) -> list[WorkspaceSummary]:
        return self._ask("GET", "/workspaces", list[WorkspaceSummary])

    def workspace(self, name: str) -> WorkspaceDetail:
        return self._ask("GET", f"/workspaces/{name}", WorkspaceDetail)

    def results(self, workspace: str) -> list[Result]:
        return self._ask("GET", f"/workspaces/{workspace}/results", list[Result])

    def download(self, workspace: str, file: str, target: Path) -> None:
        """Write one of the results to ``target``, whole or not at all."""
        temporary = target.with_name(f".{target.name}.part")
        try:
            with (
                self._http.stream("GET", f"/workspaces/{workspace}/results/{file}") as answer,
                temporary.open("wb") as out,
            ):
                if answer.is_error:
                    answer.read()
                checked(answer)
                for chunk in answer.iter_bytes(CHUNK):
                    out.write(chunk)
            temporary.replace(target)
        except httpx.TransportError as error:
            raise UserError(f"{self.server}: the download of {file} broke ({error}); try again") from None
        finally:
            temporary.unlink(missing_ok=True)

    def delete(self, workspace: str) -> Deleted:
        return self._ask("DELETE", f"/workspaces/{workspace}", Deleted)

    def restore(self, deleted: str) -> Deleted:
        return self._ask("POST", f"/deleted/{deleted}/restore", Deleted)

    def preview(self, workspace: str) -> PreviewState:
        """What the last picture of a fine-tuning shows. Raises Refused (404) before there is one."""
        return self._ask("GET", f"/workspaces/{workspace}/preview", PreviewState)

    def _stream(self, job: int, after: int, heard: Callable[[], None]) -> Iterator[JobEvent | None]:
        """Events; None at the end of the job. heard: called at each line, a quiet job's signs of life, too."""
        headers = {"Last-Event-ID": str(after), "Accept": "text/event-stream"}
        with self._http.stream("GET", f"/jobs/{job}/events", headers=headers) as answer:
            if answer.is_error:
                answer.read()
            checked(answer)
            fields: dict[str, str] = {}
            for line in answer.iter_lines():
                heard()
                if line:
                    name, _, value = line.partition(":")
                    fields[name] = value.removeprefix(" ")
                    continue
                if fields.get("event") == "end":
                    yield None
                    return
                if "id" in fields:
                    data = json.loads(fields["data"])
                    moment = float(data.pop("time"))
                    yield JobEvent(id=int(fields["id"]), job=job, time=moment, kind=fields["event"], data=data)
                fields = {}

    def _ask(self, method: str, path: str, model: type[Answer], **options: Any) -> Answer:
        """Send a request, with retries: safe for everything but uploads, since submissions carry a key."""
        return self._retrying(lambda: self._read(checked(self._http.request(method, path, **options)), model))

    def _retrying(self, attempt: Callable[[], Answer]) -> Answer:
        """What ``attempt`` returns; tried again while the server does not answer, or says to wait."""
        failing, refusals = None, 0
        while True:
            try:
                return attempt()
            except httpx.TransportError as error:
                now = time.monotonic()
                failing = failing or now
                if now - failing > self.retry_seconds:
                    raise Unreachable(
                        f"{self.server}: cannot be reached ({error}); is `dnrpipe serve` running there?"
                    ) from None
                time.sleep(RETRY_INTERVAL)
            except Refused as refused:
                if refused.status != 429 or refused.wait is None or refusals >= MAX_REFUSALS:
                    raise
                refusals += 1
                time.sleep(min(refused.wait, MAX_WAIT))

    def _read(self, answer: httpx.Response, model: type[Answer]) -> Answer:
        try:
            return TypeAdapter(model).validate_json(answer.content)
        except ValueError:
            raise UserError(f"{self.server}: is not a dnrpipe server, or one of another version") from None


@functools.cache
def _trust() -> ssl.SSLContext:
    """The system's certificates, read once: reading them takes longer than most requests."""
    return ssl.create_default_context()


def checked(answer: httpx.Response) -> httpx.Response:
    """Raises Refused. Raises httpx.TransportError: the server, or a proxy in front of it, fails for the moment."""
    if answer.is_success:
        return answer
    try:
        detail = str(answer.json()["detail"])
    except (ValueError, KeyError, TypeError):
        detail = f"{answer.request.method} {answer.request.url.path} was answered with {answer.status_code}"
    if answer.status_code in PASSING:
        raise httpx.TransportError(detail)
    wait = answer.headers.get("retry-after", "")
    raise Refused(answer.status_code, detail, float(wait) if wait.isdigit() else None)

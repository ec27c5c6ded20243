"""The worker of one device on another machine than the server: takes whole jobs of it over HTTP (`dnrpipe worker`).

A job's workspace is fetched, worked in as the server's own workers would, and what changed goes back; then it is
removed here. A worker that is killed loses its start of the job, nothing else: the server queues the job again when the
lease is over.
"""

from __future__ import annotations

import base64
import contextlib
import secrets
import shutil
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dnrtrain.text import one_line

from ..core.errors import UserError
from ..core.workspace import SUFFIX, Workspace
from . import archive
from .client import Refused, Unreachable
from .config import tightest
from .lease_client import LeaseClient
from .leases import BEAT_SECONDS, MAX_EVENTS, MAX_LOG, Beat, Lease, LeaseGone, WorkerEvent
from .models import End, Limits
from .queue import DAY
from .root import ServiceRoot
from .worker import run_job

IDLE = 1.0
MARKER = "elsewhere"
"""File in the private folder of a worker's root: its workspaces are copies."""
UNWANTED = (401, 403)
"""What a server answers that does not want this worker; other refusals are about one job."""


@dataclass(frozen=True)
class WorkerConfig:
    """name: of this machine, for the list of jobs. device: "cpu" or "cuda:<n>". limits: of this machine."""

    server: str
    token: str | None
    root: Path
    name: str
    device: str
    limits: Limits


class RemoteWorker:
    """Works for one server until it is stopped. say: told of each job in one line."""

    def __init__(self, config: WorkerConfig, say: Callable[[str], None]) -> None:
        self.config, self.say = config, say
        self.root = ServiceRoot(config.root)
        self.stopping = False

    def run(self) -> None:
        """Work until Ctrl-C or SIGTERM; the running job is stopped then, sent back and queued again.

        Raises Refused: the server does not want this worker. Raises Unreachable. Raises UserError: the root holds
        something else, or another worker works in it.
        """
        config = self.config
        with _own(self.root), LeaseClient(config.server, config.token) as client, _signals(self.stop):
            client.check()
            self.say(f"working for {config.server} on {config.device}; Ctrl-C stops, a running job is queued again")
            while not self.stopping:
                lease = client.take(config.name, config.device)
                if lease is None:
                    time.sleep(IDLE)
                    continue
                request = lease.job.request
                self.say(f"job {lease.job.id}: {request.command} of {request.workspace}")
                try:
                    self._work(client, lease)
                except UserError as error:
                    if _is_unwanted(error):
                        raise
                    self.say(f"job {lease.job.id}: given up ({one_line(error)})")
                finally:
                    self._forget(lease)

    def stop(self, *_: Any) -> None:
        """Raises KeyboardInterrupt the second time: do not wait for anything."""
        if self.stopping:
            raise KeyboardInterrupt
        self.stopping = True

    def _work(self, client: LeaseClient, lease: Lease) -> None:
        """Raises UserError: the job is not ours any more; the server queues it again when the lease is over."""
        job, root = lease.job, self.root
        workspace = root.workspace(job.request.workspace, must_exist=False)
        root.log(job.id).unlink(missing_ok=True)
        report = _LeaseReport(client, lease, root.log(job.id))
        limits = tightest(lease.limits, self.config.limits)
        try:
            self._fetch(client, lease, workspace)
        except (UserError, OSError) as error:  # half a workspace is nothing to send back
            _raise_if_over(error)
            client.end(lease, End(state="failed", error=f"it could not be fetched: {one_line(error)}"))
            return
        before = archive.stamps(workspace)
        try:
            end = run_job(job, root, self.config.device, limits, report, lambda: self.stopping)
        except (UserError, OSError) as error:
            _raise_if_over(error)
            end = End(state="failed", error=one_line(error))
        report.flush()
        try:
            _move_source(workspace, root.folder, Path(lease.root))
            after = archive.stamps(workspace)
            changed = [name for name, stamp in after.items() if before.get(name) != stamp]
            client.send_result(lease, workspace, changed, before.keys() - after.keys(), report.cancelled)
        except (UserError, OSError) as error:
            _raise_if_over(error)
            end = End(state="failed", exit_code=end.exit_code, error=f"what it made was not taken: {one_line(error)}")
        client.end(lease, end)

    def _fetch(self, client: LeaseClient, lease: Lease, workspace: Path) -> None:
        """The server's settings, the scene file, and the workspace as it is so far."""
        root, scene = self.root, lease.scene
        (root.folder / "dnrpipe.toml").write_text(lease.settings, encoding="utf-8")
        if scene is not None:
            kept = root.uploads / scene.sha256 / scene.name
            if not kept.is_file():
                part = root.incoming / secrets.token_hex(8)
                try:
                    client.fetch_scene(lease, scene, part)
                    root.keep_scene(part, scene.name, scene.sha256)
                finally:
                    part.unlink(missing_ok=True)
        client.fetch_workspace(lease, workspace)
        _move_source(workspace, Path(lease.root), root.folder)

    def _forget(self, lease: Lease) -> None:
        """Nothing of the job stays; a scene file stays for a day, for the next job of it."""
        shutil.rmtree(self.root.workspace(lease.job.request.workspace, must_exist=False), ignore_errors=True)
        for path in (self.root.log(lease.job.id), self.root.events(lease.job.id)):
            path.unlink(missing_ok=True)
        for path in self.root.scenes.iterdir():
            path.unlink()
        self.root.drop_uploads((), time.time() - DAY)


class _LeaseReport:
    """To the server, by heartbeats. One without an answer is sent again as it was, so that nothing is told twice."""

    def __init__(self, client: LeaseClient, lease: Lease, log: Path) -> None:
        self.client, self.lease, self.log = client, lease, log
        self._waiting: deque[dict[str, Any]] = deque()
        self._log_sent, self._number = 0, 0
        self._beat: Beat | None = None
        self._due, self._heard = 0.0, time.monotonic()
        self._cancelled = False

    def news(self, events: list[dict[str, Any]]) -> None:
        self._waiting.extend(events)

    def cancelled(self) -> bool:
        """Sends a heartbeat if one is due. Raises LeaseGone, also when the server was silent for too long."""
        if time.monotonic() >= self._due:
            self._send()
        return self._cancelled

    def flush(self) -> None:
        """Send all that is left. Raises LeaseGone."""
        while self._beat is not None or self._has_more():
            self._send()
            if self._beat is not None:
                time.sleep(IDLE)

    def _send(self) -> None:
        began = time.monotonic()
        self._beat = self._beat or self._next()
        answer = self.client.beat(self.lease, self._beat)
        if answer is None:
            if time.monotonic() - self._heard > self.lease.seconds:
                raise LeaseGone(f"the server did not answer for {self.lease.seconds:g} s")
        else:
            self._beat, self._heard, self._cancelled = None, began, answer.cancelled
        behind = answer is not None and self._has_more()
        self._due = time.monotonic() + (0.0 if behind else BEAT_SECONDS)

    def _next(self) -> Beat:
        events, room = [], MAX_EVENTS
        while self._waiting:
            try:
                event = WorkerEvent.model_validate(self._waiting[0])
            except ValidationError:  # not of our commands
                self._waiting.popleft()
                continue
            size = len(event.model_dump_json().encode())
            if room < size <= MAX_EVENTS:
                break
            self._waiting.popleft()
            if size <= MAX_EVENTS:  # a larger one fits into no request
                events.append(event)
                room -= size
        text = b""
        if self.log.is_file():
            with self.log.open("rb") as file:
                file.seek(self._log_sent)
                text = file.read(MAX_LOG)
        self._log_sent += len(text)
        self._number += 1
        return Beat(number=self._number, events=events, log=base64.b64encode(text))

    def _has_more(self) -> bool:
        return bool(self._waiting) or (self.log.is_file() and self.log.stat().st_size > self._log_sent)


@contextlib.contextmanager
def _own(root: ServiceRoot) -> Iterator[None]:
    """Hold the root, and clear it of what a killed worker left.

    Raises UserError: it holds something else than a worker's files, or another worker works in it.
    """
    marker = root.private / MARKER
    if root.folder.exists() and not marker.exists() and (not root.folder.is_dir() or any(root.folder.iterdir())):
        raise UserError(f"--root {root.folder}: holds something else than a worker's files; choose an empty folder")
    root.folder.mkdir(parents=True, exist_ok=True)
    root.private.mkdir(mode=0o700, exist_ok=True)
    marker.touch()
    root.create()
    with root.held(f"--root {root.folder}: another worker works here; choose another"):
        root.clear()
        for folder in root.folder.glob(f"*{SUFFIX}"):
            shutil.rmtree(folder)
        yield


@contextlib.contextmanager
def _signals(stop: Callable[..., None]) -> Iterator[None]:
    """Ctrl-C and SIGTERM call ``stop``."""
    before = [(number, signal.signal(number, stop)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)


def _move_source(workspace: Path, old: Path, new: Path) -> None:
    """The manifest has the paths of its scene file and of its shot's cameras, a file of the workspace: what lay under
    one root lies there under the other."""
    with contextlib.suppress(UserError):  # no manifest yet, or a damaged one, as the job will say
        found = Workspace.open(workspace)
        before = found.manifest.model_copy(deep=True)
        source = Path(found.manifest.source.path)
        if source.is_relative_to(old):
            found.manifest.source.path = str(new / source.relative_to(old))
        cameras = found.manifest.overrides.get("cameras", {})
        views = Path(cameras.get("source", ""))
        if views.is_relative_to(old / workspace.name):
            cameras["source"] = str(new / views.relative_to(old))
        if found.manifest != before:
            found.save()


def _is_unwanted(error: Exception) -> bool:
    return isinstance(error, Refused) and error.status in UNWANTED


def _raise_if_over(error: Exception) -> None:
    """Raise what leaves nobody to tell how the job ended."""
    if isinstance(error, LeaseGone | Unreachable) or _is_unwanted(error):
        raise error

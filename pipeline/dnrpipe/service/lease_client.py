"""A worker's side of `routes_leases`."""

from __future__ import annotations

import hashlib
import io
import shutil
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import IO, cast

import httpx
from pydantic import TypeAdapter

from .. import __version__
from ..core.workspace import file_sha256
from . import archive
from .client import CHUNK, Client, Refused, checked
from .leases import SECONDS, SHA256_HEADER, Beat, BeatAnswer, Lease, LeaseGone, LeaseTerms, LeaseWish, SceneFile
from .models import End

BEAT_TIMEOUT = 5.0
RESULT_TIMEOUT = httpx.Timeout(60.0, read=900.0)
"""The answer comes when the server has checked and moved all files."""
GONE = 410


class LeaseClient(Client):
    """Takes jobs of a server. It waits for a server that does not answer for as long as a lease lasts.

    Raises Unreachable, Refused. Raises LeaseGone: the server has taken the job back.
    """

    def __init__(self, server: str, token: str | None) -> None:
        super().__init__(server, token, retry_seconds=SECONDS)

    def check(self) -> None:
        """Raises Refused: the server takes no workers, this token has another role, or the versions differ."""
        try:
            self._ask("GET", "/leases", LeaseTerms, params={"version": __version__})
        except Refused as refused:
            if refused.status != 404:
                raise
            raise Refused(404, f"{self.server}: is no dnrpipe server that takes workers; another version?") from None

    def take(self, worker: str, device: str) -> Lease | None:
        """A job; None: nothing waits. Raises Refused: as `check`."""
        wish = LeaseWish(worker=worker, device=device, version=__version__).model_dump()

        def attempt() -> Lease | None:
            answer = checked(self._http.post("/leases", json=wish))
            return None if answer.status_code == 204 else self._read(answer, Lease)

        return self._retrying(attempt)

    def beat(self, lease: Lease, beat: Beat) -> BeatAnswer | None:
        """One attempt. None: the server does not answer now, fails, or has too much to do."""
        content = TypeAdapter(Beat).dump_json(beat)
        headers = {"Content-Type": "application/json"}
        try:
            answer = _alive(self._http.post(_path(lease), content=content, headers=headers, timeout=BEAT_TIMEOUT))
        except httpx.TransportError:
            return None
        except Refused as refused:
            if refused.status == 429 or refused.status >= 500:  # no reason to end a job
                return None
            raise
        return self._read(answer, BeatAnswer)

    def fetch_scene(self, lease: Lease, scene: SceneFile, target: Path) -> None:
        """Write the lease's scene file to ``target``, checked."""

        def attempt() -> None:
            with self._http.stream("GET", f"{_path(lease)}/scene") as answer, target.open("wb") as file:
                for chunk in _streamed(answer).iter_bytes(CHUNK):
                    file.write(chunk)
            if file_sha256(target) != scene.sha256:
                raise httpx.RemoteProtocolError("the scene file was damaged on the way")

        self._retrying(attempt)

    def fetch_workspace(self, lease: Lease, folder: Path) -> None:
        """Make the folder anew with what the server's workspace has; it stays away where there is nothing."""

        def attempt() -> None:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            with self._http.stream("GET", f"{_path(lease)}/workspace") as answer:
                archive.unpack(cast(IO[bytes], _Pieces(_streamed(answer).iter_bytes(CHUNK))), folder)
            (folder / archive.INDEX).unlink()

        self._retrying(attempt)
        if not any(folder.iterdir()):
            folder.rmdir()

    def send_result(
        self,
        lease: Lease,
        workspace: Path,
        names: Collection[str],
        removed: Collection[str],
        alive: Callable[[], object],
    ) -> None:
        """Send files of the workspace, and word of those that are gone. alive: called while they are only read."""
        checksum, size = hashlib.sha256(), 0
        for piece in archive.pack(workspace, names, removed):
            alive()
            checksum.update(piece)
            size += len(piece)
        headers = {
            SHA256_HEADER: checksum.hexdigest(),
            "Content-Length": str(size),
            "Content-Type": "application/octet-stream",
        }

        def attempt() -> None:
            body = archive.pack(workspace, names, removed)
            _alive(self._http.put(f"{_path(lease)}/result", content=body, headers=headers, timeout=RESULT_TIMEOUT))

        self._retrying(attempt)

    def end(self, lease: Lease, how: End) -> None:
        self._retrying(lambda: _alive(self._http.post(f"{_path(lease)}/end", json=how.model_dump())))


class _Pieces(io.RawIOBase):
    """A stream of pieces as a file to read from."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self.pieces, self.rest = pieces, b""

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        parts, wanted = [], size
        while wanted:
            if not self.rest:
                self.rest = next(self.pieces, b"")
                if not self.rest:
                    break
            part, self.rest = self.rest[:wanted], self.rest[wanted:]
            parts.append(part)
            wanted -= len(part)
        return b"".join(parts)


def _path(lease: Lease) -> str:
    return f"/leases/{lease.id}"


def _streamed(answer: httpx.Response) -> httpx.Response:
    if answer.is_error:
        answer.read()
    return _alive(answer)


def _alive(answer: httpx.Response) -> httpx.Response:
    """Raises LeaseGone, and what `checked` raises."""
    try:
        return checked(answer)
    except Refused as refused:
        if refused.status == GONE:
            raise LeaseGone(str(refused)) from None
        raise

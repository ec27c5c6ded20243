"""The server's folder; every path in it comes from here.

root/
  <name>.dnr/          workspaces
  scenes/<file>        scene files by name: the last upload of each
  dnrpipe.toml         settings for all jobs, if the operator puts one there
  .service/            queue.sqlite, logs/<job>.log, events/<job>.jsonl, lock
    incoming/          what workers elsewhere send, until it is whole and checked
    uploads/<sha256>/<file>   the same files by content; a job names the one that it was submitted with
    deleted/<unix nanoseconds>-<name>.dnr   workspaces that can still be restored
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import time
from collections.abc import Collection, Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from ..core.errors import UserError
from ..core.workspace import LOCK_FILES, SUFFIX, Workspace, file_sha256, locked
from .models import NAME_PATTERN, SCENE_PATTERN


class UnknownName(UserError):
    """The root has no such workspace, scene or file."""


class ServiceRoot:
    """Paths under `folder`. Checks names against a pattern, and that their paths lie in the root."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.private = self.folder / ".service"
        self.queue = self.private / "queue.sqlite"
        self.scenes = self.folder / "scenes"
        self.uploads = self.private / "uploads"
        self.deleted = self.private / "deleted"
        self.incoming = self.private / "incoming"

    def create(self) -> ServiceRoot:
        """Make the folders that are missing; the private one is readable by its owner alone."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self.private.mkdir(mode=0o700, exist_ok=True)
        private = (self.uploads, self.deleted, self.incoming, self.private / "logs", self.private / "events")
        for folder in (self.scenes, *private):
            folder.mkdir(exist_ok=True)
        return self

    @contextlib.contextmanager
    def held(self, taken: str) -> Iterator[None]:
        """Hold the folder for one server or worker. Raises UserError with ``taken``: another has it."""
        try:  # one that was killed may take a moment to end
            lock = FileLock(self.private / "lock", timeout=10).acquire()
        except Timeout:
            raise UserError(taken) from None
        with lock:
            yield

    def clear(self) -> None:
        """Remove what a former server left of requests that it did not finish."""
        for left in (*self.private.glob("*.zip"), *self.scenes.glob(".*.part"), *self.uploads.glob(".*.part")):
            left.unlink(missing_ok=True)
        shutil.rmtree(self.incoming)
        self.incoming.mkdir()

    def log(self, job: int) -> Path:
        return self.private / "logs" / f"{job}.log"

    def events(self, job: int) -> Path:
        return self.private / "events" / f"{job}.jsonl"

    def workspace(self, name: str, *, must_exist: bool = True) -> Path:
        """``<root>/<name>.dnr``. Raises UnknownName: no name of a workspace, outside the root, or not there."""
        path = self._inside(self.folder / f"{name}{SUFFIX}", name, NAME_PATTERN)
        if must_exist and not (path / "manifest.json").is_file():
            raise UnknownName(f"{name}: no such workspace; see GET /workspaces")
        return path

    def scene(self, name: str, *, must_exist: bool = True) -> Path:
        """``<root>/scenes/<name>``. Raises UnknownName."""
        path = self._inside(self.scenes / name, name, SCENE_PATTERN)
        if must_exist and not path.is_file():
            raise UnknownName(f"{name}: no such scene; upload it with PUT /scenes/{name}")
        return path

    def keep_scene(self, file: Path, name: str, sha256: str) -> bool:
        """Move a file of this content to its places. Returns whether it replaced another of that name."""
        kept, named = self._upload(sha256) / name, self.scene(name, must_exist=False)
        with file.open("rb") as written:
            os.fsync(written.fileno())
        replaced = named.is_file() and not (kept.is_file() and kept.samefile(named)) and file_sha256(named) != sha256
        if not kept.is_file():
            file.chmod(0o444)  # what was submitted stays what it was
            file.replace(kept)
        _link(kept, named)
        return replaced

    def submitted_scene(self, name: str, sha256: str | None) -> tuple[str, Path]:
        """(hash, path) of the file that a job is submitted with: of that hash, or the one of that name now.

        Raises UnknownName: there is none, or none of that name and content.
        """
        if sha256 is None:
            named = self.scene(name)
            for kept in self.uploads.glob(f"*/{name}"):
                if kept.samefile(named):
                    return kept.parent.name, self._upload(kept.parent.name) / name
            temporary = self.uploads / f".{secrets.token_hex(8)}.part"  # put there by hand
            try:
                shutil.copyfile(named, temporary)
                sha256 = file_sha256(temporary)
                self.keep_scene(temporary, name, sha256)
            finally:
                temporary.unlink(missing_ok=True)
        kept = self._inside(self.uploads / sha256 / name, name, SCENE_PATTERN)
        if not kept.is_file():
            raise UnknownName(f"{name}: no file of content {sha256[:12]}… was uploaded by this name; upload it again")
        return sha256, self._upload(sha256) / name

    def _upload(self, sha256: str) -> Path:
        """The folder of a content, which is wanted now: `drop_uploads` leaves it for a day."""
        folder = self.uploads / sha256
        folder.mkdir(exist_ok=True)
        os.utime(folder)
        return folder

    def drop_uploads(self, wanted: Collection[str], before: float) -> None:
        """Remove uploads that no job wants and no workspace was made from, by hash, that no scene is, and that nobody
        named since ``before``, unix seconds."""
        made_from = set()
        for path in self.folder.glob(f"*{SUFFIX}/manifest.json"):
            with contextlib.suppress(UserError):
                made_from.add(Workspace.open(path.parent).manifest.source.sha256)
        for folder in self.uploads.iterdir():
            if folder.is_dir() and folder.name not in made_from | set(wanted) and folder.stat().st_mtime < before:
                files = list(folder.iterdir())
                if all(file.stat().st_nlink == 1 for file in files):
                    shutil.rmtree(folder, ignore_errors=True)

    def delete(self, name: str) -> str:
        """Put a workspace away; what it is called there. Raises UnknownName; UserError: a command works in it."""
        path = self.workspace(name)
        put_away = f"{time.time_ns()}-{name}"
        with locked(path, "delete"):
            path.rename(self.deleted / f"{put_away}{SUFFIX}")
        (self.deleted / f"{put_away}{SUFFIX}" / LOCK_FILES[1]).unlink(missing_ok=True)
        return put_away

    def restorable(self) -> list[tuple[str, str, float]]:
        """(what it is called, workspace, when it was deleted) of the workspaces put away, the last first."""
        found = []
        for path in self.deleted.glob(f"*{SUFFIX}"):
            when, _, name = path.name.removesuffix(SUFFIX).partition("-")
            if when.isdigit():
                found.append((f"{when}-{name}", name, int(when) / 1e9))
        return sorted(found, key=lambda entry: -entry[2])

    def restore(self, put_away: str) -> str:
        """The workspace's name. Raises UnknownName: it is not there any more; UserError: its name is taken."""
        name = next((name for known, name, _ in self.restorable() if known == put_away), None)
        if name is None:
            raise UnknownName(f"{put_away[:80]!r}: no deleted workspace; its time may be over")
        path = self.workspace(name, must_exist=False)
        if path.exists():
            raise UserError(f"{name}: there is a workspace of this name again; delete that one first")
        (self.deleted / f"{put_away}{SUFFIX}").rename(path)
        return name

    def drop_deleted(self, before: float) -> None:
        """Remove for good what was deleted before that, unix seconds."""
        for put_away, _, when in self.restorable():
            if when < before:
                shutil.rmtree(self.deleted / f"{put_away}{SUFFIX}", ignore_errors=True)

    def result(self, name: str, file: str, problem: str) -> Path:
        """A file of a workspace. Raises UnknownName with `problem`: it is not there, or leads out of the root."""
        path = self.workspace(name) / file
        if not path.is_file() or not path.resolve().is_relative_to(self.folder):
            raise UnknownName(problem)
        return path

    def workspaces(self) -> list[str]:
        """Names of the workspaces, sorted; links that lead out of the root are none."""
        names = []
        for path in self.folder.glob(f"*{SUFFIX}/manifest.json"):
            with contextlib.suppress(UnknownName):
                name = path.parent.name.removesuffix(SUFFIX)
                self.workspace(name)
                names.append(name)
        return sorted(names)

    def _inside(self, path: Path, name: str, pattern: str) -> Path:
        if not re.fullmatch(pattern, name):
            raise UnknownName(f"{name[:80]!r}: not a name; letters, digits, dash and underscore, 64 at most")
        if not path.resolve().is_relative_to(self.folder):  # a link that leads out
            raise UnknownName(f"{name}: leads out of the server's folder")
        return path


def _link(source: Path, target: Path) -> None:
    """Make ``target`` the same file, in place of whatever was there; a copy where it lies on another disk."""
    temporary = target.with_name(f".{secrets.token_hex(8)}.part")
    try:
        os.link(source, temporary)
    except OSError:
        shutil.copyfile(source, temporary)
    temporary.replace(target)
    temporary.unlink(missing_ok=True)  # renaming a file to another name of itself does nothing

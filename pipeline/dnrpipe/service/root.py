"""The server's folder; every path in it comes from here.

root/
  <name>.dnr/          workspaces
  scenes/<file>        uploaded scene files
  dnrpipe.toml         settings for all jobs, if the operator puts one there
  .service/            queue.sqlite, logs/<job>.log, events/<job>.jsonl, lock
"""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

from ..core.errors import UserError
from ..core.workspace import SUFFIX
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

    def create(self) -> ServiceRoot:
        """Make the folders that are missing; the private one is readable by its owner alone."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self.private.mkdir(mode=0o700, exist_ok=True)
        for folder in (self.scenes, self.private / "logs", self.private / "events"):
            folder.mkdir(exist_ok=True)
        return self

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

"""Files of tasks that run where this machine's disk is not: what a task reads goes there, what it wrote comes back.

Notation
    root     a folder or file of the driver's that tasks may name (a workspace, a scene file)
    pack     a file, or all files of a folder, as one archive named by its content
    mirror   a folder of a worker elsewhere, below which files lie at the absolute paths that they have on the driver

The driver finds what a task reads by the paths in it that exist. A pack is fetched once per node, whatever the number
of workers there: it is unpacked into the node's cache, and mirrors hold hard links to it.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import shutil
import socket
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from dnrtrain.atomic import atomic_path

from ..core.workspace import sha256_now

LEFT_BEHIND = ("logs", "preview", "renders", "report", "evaluation", "samples")
"""Folders of a workspace of which no task reads all."""
KEEP_SECONDS, KEEP_BYTES = 2 * 86400.0, 32 << 30
"""How long a node keeps a pack that nobody asks for, and how much of them in all."""
SMALL = 1 << 20


@dataclass(frozen=True)
class Pack:
    """digest: of all names and contents. path: where it lies on the driver. folder: whether it is one. kept: by the
    node, for further tasks; files of one task alone are not."""

    digest: str
    path: str
    folder: bool
    kept: bool


# -- driver ------------------------------------------------------------------------------------------------


def packs_of(common: Any, task: Any, roots: Sequence[Path]) -> list[Pack]:
    """What a task, and what all tasks of a worker share, name of existing files under the roots.

    A scene description stands for the folder of its meshes and textures. What lies in a folder that is named, too, is
    not told twice. ``output`` is not read.
    """
    shared = {Path(text) for _, text in strings(common)}
    own = {Path(text) for key, text in strings(task) if key != "output"}
    named = {path for path in shared | own if under(str(path), roots)}
    named = {path.parent if _is_bundle(path) else path for path in named if path.exists()}
    outermost = [path for path in sorted(named) if not any(other in path.parents for other in named)]
    return [Pack(_digest(path), str(path), path.is_dir(), path.is_dir() or path in shared) for path in outermost]


def _is_bundle(path: Path) -> bool:
    """``scene.xml``, or one without what is left out (``scene-<hash>.xml``): its meshes and textures lie beside it."""
    return path.suffix == ".xml" and path.name.startswith("scene") and path.parent.name == "scene"


def packed(pack: Pack) -> bytes:
    """The archive. Its files are as they were when its digest was taken, or another digest is due."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name, path in members(Path(pack.path)):
            archive.add(path, arcname=name, recursive=False)
    return buffer.getvalue()


def strings(values: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """All strings in JSON-able values, with the key that each stands under."""
    if isinstance(values, str):
        yield key, values
    elif isinstance(values, dict):
        for name, value in values.items():
            yield from strings(value, name)
    elif isinstance(values, list | tuple):
        for value in values:
            yield from strings(value, key)


def under(text: str, roots: Sequence[Path]) -> bool:
    """Whether the string is the absolute path of a root or of something in one."""
    return text.startswith("/") and any(Path(text).is_relative_to(root) for root in roots)


def moved(values: Any, change: Callable[[str], str]) -> Any:
    """JSON-able values with every string changed."""
    if isinstance(values, str):
        return change(values)
    if isinstance(values, dict):
        return {key: moved(value, change) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return [moved(value, change) for value in values]
    return values


def members(path: Path) -> list[tuple[str, Path]]:
    """(name in the archive, file) of a pack, in order. Temporary files and `LEFT_BEHIND` are left out."""
    if path.is_file():
        return [(path.name, path)]
    found = []
    for folder, names, files in os.walk(path):
        inside = Path(folder)
        names[:] = [name for name in names if name not in LEFT_BEHIND]
        found += [inside / name for name in files if not name.startswith(".") and not name.endswith(".lock")]
    return [(str(file.relative_to(path)), file) for file in sorted(found)]


def _digest(path: Path) -> str:
    whole = hashlib.sha256()
    for name, file in members(path):
        whole.update(f"{name}\0{sha256_now(file)}\0".encode())
    return whole.hexdigest()[:32]


# -- a worker elsewhere ------------------------------------------------------------------------------------


@dataclass
class Mirror:
    """One worker's.

    Args:
        cache: packs of the node.
        folder: its own, removed by `close`, or by another worker's once nobody holds its lock.
        placed: digest of what lies at each path.
    """

    cache: Path
    folder: Path = field(init=False)
    placed: dict[str, str] = field(default_factory=dict)
    lock: FileLock = field(init=False)

    def __post_init__(self) -> None:
        mirrors = self.cache.parent / "mirrors"
        mirrors.mkdir(parents=True, exist_ok=True)
        self.folder = Path(tempfile.mkdtemp(prefix=f"{socket.gethostname()}-", dir=mirrors))
        self.lock = FileLock(f"{self.folder}.lock")
        self.lock.acquire()
        for left in mirrors.glob(f"{socket.gethostname()}-*.lock"):
            if left != Path(self.lock.lock_file):
                with contextlib.suppress(Timeout, OSError), FileLock(left, timeout=0):
                    shutil.rmtree(left.with_suffix(""), ignore_errors=True)
                    left.unlink(missing_ok=True)

    @property
    def root(self) -> Path:
        """The driver's paths lie below it."""
        return self.folder / "files"

    def here(self, text: str) -> Path:
        """Where a path of the driver's lies."""
        return Path(f"{self.root}{text}")

    def place(self, pack: Pack, fetch: Callable[[], bytes]) -> None:
        """Make the pack's files lie where they do on the driver. fetch: called where the node does not have them."""
        if self.placed.get(pack.path) == pack.digest:
            return
        kept = self._kept(pack.digest, fetch) if pack.kept else None
        target = self.here(pack.path)
        if pack.folder:
            shutil.rmtree(target, ignore_errors=True)
            target.mkdir(parents=True)
        else:
            target.unlink(missing_ok=True)
            target = target.parent
        target.mkdir(parents=True, exist_ok=True)
        if kept is None:
            _unpack(fetch(), target)
        else:
            for name, file in members(kept):
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                _link(file, target / name)
        self.placed[pack.path] = pack.digest

    def _kept(self, digest: str, fetch: Callable[[], bytes]) -> Path:
        """The unpacked archive in the node's cache."""
        folder = self.cache / digest
        if folder.exists():
            os.utime(folder)
            return folder
        self.cache.mkdir(parents=True, exist_ok=True)
        with FileLock(self.cache / f"{digest}.lock"):
            if not folder.exists():
                fresh = self.cache / f"{digest}.fresh"
                shutil.rmtree(fresh, ignore_errors=True)
                fresh.mkdir()
                _unpack(fetch(), fresh)
                fresh.rename(folder)
        self._drop_old()
        return folder

    def _drop_old(self) -> None:
        """Packs that nobody asked for in a while, and the oldest beyond a size; mirrors have what they use."""
        found = []
        for folder in self.cache.iterdir():
            with contextlib.suppress(OSError):
                if folder.is_dir():
                    size = sum(file.stat().st_size for _, file in members(folder))
                    found.append((folder.stat().st_mtime, size, folder))
        total = 0
        for modified, size, folder in sorted(found, reverse=True):  # the newest first
            total += size
            if time.time() - modified > KEEP_SECONDS or total > KEEP_BYTES:
                shutil.rmtree(folder, ignore_errors=True)

    def state(self) -> dict[str, tuple[int, int, int]]:
        """What lies in the mirror: (inode, modified ns, size) by the driver's path."""
        found = {}
        for folder, _, files in os.walk(self.root):
            for name in files:
                path = Path(folder) / name
                stat = path.stat()
                found[str(path)[len(str(self.root)) :]] = (stat.st_ino, stat.st_mtime_ns, stat.st_size)
        return found

    def changes(self, before: dict[str, tuple[int, int, int]]) -> tuple[dict[str, bytes], list[str]]:
        """(what a task wrote since ``before``, what it removed), by the driver's paths; neither stays here."""
        written, after = {}, self.state()
        for path, state in after.items():
            if before.get(path) != state and not Path(path).name.startswith("."):
                written[path] = self.here(path).read_bytes()
                self.here(path).unlink()
        removed = [path for path in before if path not in after]
        for path in (*written, *removed):
            self._forget(path)
        return written, removed

    def _forget(self, path: str) -> None:
        """What was placed there, or around it, is no longer what its digest says."""
        for placed in [name for name in self.placed if Path(path).is_relative_to(name)]:
            del self.placed[placed]

    def close(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        self.lock.release()


def _unpack(archive: bytes, folder: Path) -> None:
    with tarfile.open(fileobj=io.BytesIO(archive)) as opened:
        opened.extractall(folder, filter="data")


def _link(source: Path, target: Path) -> None:
    """A file of a pack in a mirror. Small ones are copied: some of them (the ledger) are appended to in place."""
    try:
        if source.stat().st_size < SMALL:
            raise OSError
        os.link(source, target)
    except OSError:  # also: another file system
        shutil.copy2(source, target)


def receive(written: dict[str, bytes], removed: Sequence[str], roots: Sequence[Path]) -> None:
    """Write what came back, each file whole or not at all, and remove what was removed there.

    Raises ValueError: outside of the roots.
    """
    for path in (*written, *removed):
        if not under(path, roots):
            raise ValueError(f"{path}: a worker changed what it was not given")
    for path, content in written.items():
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
    for path in removed:
        Path(path).unlink(missing_ok=True)

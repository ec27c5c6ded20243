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
import functools
import hashlib
import io
import os
import shutil
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock

from dnrtrain.atomic import atomic_path

from ..core.workspace import file_sha256

LEFT_BEHIND = ("logs", "preview", "renders", "report", "evaluation")
"""Folders of a workspace that no task reads."""
KEEP_SECONDS = 2 * 86400.0
"""How long a node keeps a pack that nobody asks for."""


@dataclass(frozen=True)
class Pack:
    """digest: of all names and contents. path: where it lies on the driver. folder: whether it is one."""

    digest: str
    path: str
    folder: bool


# -- driver ------------------------------------------------------------------------------------------------


def packs_of(values: Any, roots: Sequence[Path]) -> list[Pack]:
    """What a task, or what all tasks of a worker share, names of existing files under the roots.

    A scene description stands for the folder of its meshes and textures. What lies in a folder that is named, too, is
    not told twice. ``output`` is not read.
    """
    named = {Path(text) for key, text in strings(values) if key != "output" and under(text, roots)}
    named = {path.parent if path.name == "scene.xml" else path for path in named if path.exists()}
    outermost = [path for path in sorted(named) if not any(other in path.parents for other in named)]
    return [Pack(_digest(path), str(path), path.is_dir()) for path in outermost]


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


def absolute(values: Any, roots: Sequence[Path]) -> Any:
    """JSON-able values in which what lies in a root, named as the root is, is named by its absolute path."""
    known = [(str(root), str(root.resolve())) for root in roots]

    def change(text: str) -> str:
        for given, whole in known:
            if text == given or text.startswith(f"{given}/"):
                return whole + text[len(given) :]
        return text

    return moved(values, change)


def under(text: str, roots: Sequence[Path]) -> bool:
    """Whether the string is the absolute path of a root or of something in one."""
    return text.startswith("/") and any(Path(text).is_relative_to(root.resolve()) for root in roots)


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
        if inside == path:
            names[:] = [name for name in names if name not in LEFT_BEHIND]
        found += [inside / name for name in files if not name.startswith(".") and not name.endswith(".lock")]
    return [(str(file.relative_to(path)), file) for file in sorted(found)]


def _digest(path: Path) -> str:
    whole = hashlib.sha256()
    for name, file in members(path):
        stat = file.stat()
        whole.update(f"{name}\0{_sha256(file, stat.st_mtime_ns, stat.st_size)}\0".encode())
    return whole.hexdigest()[:32]


@functools.lru_cache(maxsize=16384)
def _sha256(path: Path, modified_ns: int, size: int) -> str:
    del modified_ns, size  # part of the key only
    return file_sha256(path)


# -- a worker elsewhere ------------------------------------------------------------------------------------


@dataclass
class Mirror:
    """One worker's.

    Args:
        cache: packs of the node.
        folder: its own, removed by `close`, or by another worker's once its process is gone.
        placed: digest of what lies at each path.
    """

    cache: Path
    folder: Path = field(init=False)
    placed: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        mirrors = self.cache.parent / "mirrors"
        mirrors.mkdir(parents=True, exist_ok=True)
        for left in mirrors.iterdir():
            if not Path("/proc", left.name.partition("-")[0]).exists():
                shutil.rmtree(left, ignore_errors=True)
        self.folder = Path(tempfile.mkdtemp(prefix=f"{os.getpid()}-", dir=mirrors))

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
        kept = self._kept(pack.digest, fetch)
        target = self.here(pack.path)
        if pack.folder:
            shutil.rmtree(target, ignore_errors=True)
            target.mkdir(parents=True)
        else:
            target.unlink(missing_ok=True)
            target = target.parent
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
                with tarfile.open(fileobj=io.BytesIO(fetch())) as archive:
                    archive.extractall(fresh, filter="data")
                fresh.rename(folder)
        self._drop_old()
        return folder

    def _drop_old(self) -> None:
        """Packs that nobody asked for in a while; mirrors hold links of their own to what they use."""
        for folder in self.cache.iterdir():
            with contextlib.suppress(OSError):
                if time.time() - folder.stat().st_mtime > KEEP_SECONDS:
                    shutil.rmtree(folder) if folder.is_dir() else folder.unlink()

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


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # another file system
        shutil.copyfile(source, target)


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

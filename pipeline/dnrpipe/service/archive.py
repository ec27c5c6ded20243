"""A workspace on its way between a server and a worker elsewhere: a plain tar of its files.

The receiver believes nothing of it: regular files with plain relative names come out, or nothing does.
"""

from __future__ import annotations

import json
import os
import tarfile
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import IO

from pydantic import BaseModel, ValidationError

from dnrtrain.records import first_error

from ..core.errors import UserError
from ..core.workspace import LOCK_FILES

CHUNK = 1 << 20
INDEX = ".index.json"
"""The archive's first file, no file of a workspace: how many follow, and which files are gone."""
MAX_INDEX = 16 << 20
MANIFEST = "manifest.json"
Stamp = tuple[int, int, int]


class BadArchive(UserError):
    """The archive is damaged, or holds what nobody may send."""


def stamps(workspace: Path) -> dict[str, Stamp]:
    """By name: what changes when somebody writes a file. Links and locks are left out; no folder: no files."""
    found = {}
    for folder, _, names in os.walk(workspace):
        for name in names:
            path = Path(folder, name)
            relative = path.relative_to(workspace).as_posix()
            if not path.is_symlink() and path.is_file() and relative not in LOCK_FILES:
                entry = path.stat()
                found[relative] = (entry.st_ino, entry.st_size, entry.st_mtime_ns)
    return found


def pack(workspace: Path, names: Iterable[str], removed: Iterable[str] = ()) -> Iterator[bytes]:
    """The archive in pieces. Nothing of it is kept, so that a workspace of any size can be sent.

    Raises OSError: a file is gone, or was cut while it was read.
    """
    files = sorted(names)
    index = json.dumps({"files": len(files), "removed": sorted(removed)}).encode()
    yield _header(INDEX, len(index)) + index + _padding(len(index))
    for name in files:
        with (workspace / name).open("rb") as file:
            size = left = os.fstat(file.fileno()).st_size
            yield _header(name, size)
            while left:
                chunk = file.read(min(CHUNK, left))
                if not chunk:
                    raise OSError(f"{workspace / name}: became shorter while it was sent")
                left -= len(chunk)
                yield chunk
            yield _padding(size)
    yield bytes(2 * tarfile.BLOCKSIZE)


def unpack(archive: IO[bytes], folder: Path) -> None:
    """Write the archive's files into an empty folder.

    Raises BadArchive: damaged; a link, a device, an absolute path, one with ``..``, a lock, or a name twice.
    """
    seen = set()
    try:
        with tarfile.open(fileobj=archive, mode="r|", bufsize=CHUNK) as tar:
            for member in tar:
                _check(member)
                seen.add(member.name)
                tar.extract(member, folder, set_attrs=False, filter="data")
    except (tarfile.TarError, FileExistsError, NotADirectoryError, IsADirectoryError, ValueError) as error:
        raise BadArchive(f"the archive is damaged ({error})") from None
    if INDEX not in seen or _index(folder).files != len(seen) - 1:  # tarfile takes a broken end for the end
        raise BadArchive("the archive is damaged (files are missing, or there twice)")


def save(fresh: Path) -> None:
    """See to it that the files of `unpack` outlive a power cut."""
    _sync(*(fresh / name for name in stamps(fresh)))


def brings_files(fresh: Path) -> bool:
    return any(name != INDEX for name in stamps(fresh))


def put_in_place(fresh: Path, workspace: Path) -> None:
    """Move what `unpack` wrote into the workspace, and remove what the archive says is gone; the manifest comes last.

    Raises BadArchive, before anything is touched: a file would replace a folder, or lead through a link or a file.
    """
    removed = _index(fresh).removed
    names = set(stamps(fresh)) - {INDEX}
    for name in (*names, *removed):
        _check_place(workspace, name)
    folders = {workspace}
    for name in sorted(names - {MANIFEST}):
        target = workspace / name
        target.parent.mkdir(parents=True, exist_ok=True)
        (fresh / name).replace(target)
        folders.update(parent for parent in target.parents if parent.is_relative_to(workspace))
    _remove(workspace, removed)
    _sync(*folders)
    if MANIFEST in names:  # what it speaks of is there
        (fresh / MANIFEST).replace(workspace / MANIFEST)
        _sync(workspace)


def _header(name: str, size: int) -> bytes:
    info = tarfile.TarInfo(name)
    info.size, info.mode = size, 0o644
    return info.tobuf(tarfile.PAX_FORMAT)


def _padding(size: int) -> bytes:
    return bytes(-size % tarfile.BLOCKSIZE)


def _check(member: tarfile.TarInfo) -> None:
    """Raises BadArchive: no regular file, or not a plain relative name."""
    if member.type not in (tarfile.REGTYPE, tarfile.AREGTYPE) or member.sparse is not None:
        raise BadArchive(f"{member.name[:200]!r}: is no regular file; links and devices are not taken")
    if member.name == INDEX and member.size > MAX_INDEX:  # it is read at once
        raise BadArchive(f"{INDEX}: is larger than {MAX_INDEX} bytes")
    _check_name(member.name)


def _check_name(name: str) -> None:
    path = PurePosixPath(name)
    plain = name.isprintable() and name == path.as_posix() and name not in (".", *LOCK_FILES)
    if not plain or path.is_absolute() or ".." in path.parts:
        raise BadArchive(f"{name[:200]!r}: is no path of a file in a workspace")


class _Index(BaseModel, extra="forbid"):
    files: int
    removed: list[str]


def _index(fresh: Path) -> _Index:
    try:
        found = _Index.model_validate_json((fresh / INDEX).read_bytes())
    except ValidationError as error:
        raise BadArchive(f"the archive is damaged ({INDEX}: {first_error(error)})") from None
    for name in found.removed:
        _check_name(name)
    return found


def _check_place(workspace: Path, name: str) -> None:
    """The folders on the way to a file are folders, or not there yet, and it is no folder itself."""
    path = workspace / name
    way = [parent for parent in path.parents if parent != workspace and parent.is_relative_to(workspace)]
    if any(parent.is_symlink() or parent.is_file() for parent in way) or (path.is_dir() and not path.is_symlink()):
        raise BadArchive(f"{name[:200]!r}: there is something else in its place")


def _remove(workspace: Path, names: Iterable[str]) -> None:
    """Files, and the folders that are empty then."""
    for name in names:
        path = workspace / name
        path.unlink(missing_ok=True)
        for parent in path.parents:
            if parent == workspace or not parent.is_dir() or any(parent.iterdir()):
                break
            parent.rmdir()


def _sync(*paths: Path) -> None:
    """On disk, whatever happens to the power then."""
    for path in paths:
        if not path.exists():  # a folder that was emptied
            continue
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

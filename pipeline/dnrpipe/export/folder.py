"""The folder that an export writes; an export never overwrites files of the user's."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from dnrtrain.atomic import write_text

from ..core.errors import UserError

MARKER = ".dnrpipe-export"
"""Lists the files of the last export, one a line. Not JSON: instant-ngp reads every ``*.json`` of a folder."""


def claim(folder: Path, kind: str) -> None:
    """Make `folder`, or take it over from an earlier export of the same kind.

    Raises UserError: it is a file, or holds files that no such export wrote.
    """
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file; name a folder with --out")
    marker = folder / MARKER
    if marker.is_file():
        made = marker.read_text(encoding="utf-8").splitlines()
        if made[:1] != [kind]:
            raise UserError(f"{folder}: holds an export of another kind ({made[0] if made else '?'}); name another")
    elif folder.exists() and any(folder.iterdir()):
        raise UserError(f"{folder}: is not empty and no earlier export; name a new folder with --out")
    else:
        write_text(marker, f"{kind}\n")


def finish(folder: Path, kind: str, files: Collection[Path]) -> None:
    """List the files written, and remove those that only the earlier export has."""
    names = sorted(path.relative_to(folder).as_posix() for path in files)
    marker = folder / MARKER
    before = marker.read_text(encoding="utf-8").splitlines()[1:]
    write_text(marker, "\n".join([kind, *names]) + "\n")
    for name in set(before) - set(names):
        path = (folder / name).resolve()
        if path.is_relative_to(folder.resolve()):
            path.unlink(missing_ok=True)

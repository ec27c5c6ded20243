"""What a workspace has to download: movies and frames of `render` and `shot`, exports, the report."""

from __future__ import annotations

import contextlib
import os
import stat
import zipfile
from collections.abc import Iterator
from pathlib import Path

from .models import Export, Result

EXPORTED: dict[Export, str] = {
    "export-nerf": "exports/nerf",
    "export-onnx": "exports/renderer.onnx",
    "export-gltf": "exports/scene.glb",
    "export-web": "exports/web",
}
"""Where jobs write their exports, in the workspace; folders are downloaded as a zip."""
MOVIES = (".mp4", ".webp")


def results(workspace: Path) -> list[Result]:
    """Newest first. Links are left out, and hidden files: they are being written, or of no use to others."""
    found = []
    for kind in ("renders", "shots"):
        for folder in _entries(workspace / kind):
            if not folder.is_dir() or folder.is_symlink():
                continue
            movies = [path for path in _entries(folder) if path.suffix in MOVIES]
            found += [_result("movie", path, path.relative_to(workspace).as_posix()) for path in movies]
            frames, pattern = (folder, "frame_*") if kind == "renders" else (folder / "frames", "*.exr")
            if any(path.match(pattern) for path in _entries(frames)):
                found.append(_result("frames", frames, f"{frames.relative_to(workspace).as_posix()}.zip"))
    for place in EXPORTED.values():
        path = workspace / place
        if not path.is_symlink():
            found.append(_result("export", path, f"{place}.zip" if path.is_dir() else place))
    report = workspace / "report" / "report.html"
    if not report.is_symlink():
        found.append(_result("report", report, "report/report.html"))
    return sorted((result for result in found if result is not None), key=lambda result: -result.modified)


def pack(folder: Path, target: Path) -> None:
    """Write a zip of a folder's files, uncompressed (pictures are); links and hidden files are left out."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive:
        for path, _ in _files(folder):
            with contextlib.suppress(FileNotFoundError):  # it was replaced meanwhile
                archive.write(path, Path(folder.name) / path.relative_to(folder))


def packed_mb(folder: Path) -> float:
    """What `pack` will write, MiB."""
    return sum(entry.st_size for _, entry in _files(folder)) / 2**20


def _result(kind: str, path: Path, file: str) -> Result | None:
    """None: there is no file."""
    sizes = [entry for _, entry in _files(path)]
    if not sizes:
        return None
    mb = sum(entry.st_size for entry in sizes) / 2**20
    modified = max(entry.st_mtime for entry in sizes)
    return Result.model_validate({"file": file, "kind": kind, "mb": round(mb, 3), "modified": modified})


def _files(path: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """The file, or the files of a folder, without links, hidden ones, and those that a job moves away meanwhile."""
    for place, folders, names in os.walk(path):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            if not name.startswith("."):
                yield from _file(Path(place, name))
    yield from _file(path)


def _file(path: Path) -> Iterator[tuple[Path, os.stat_result]]:
    try:
        entry = path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return
    if stat.S_ISREG(entry.st_mode):
        yield path, entry


def _entries(folder: Path) -> list[Path]:
    """What lies in a folder, by name, without hidden files; nothing where it is none, or a link."""
    if folder.is_symlink():
        return []
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except (FileNotFoundError, NotADirectoryError):
        return []

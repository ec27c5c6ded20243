"""What a workspace has to download: movies and frames of `render` and `shot`, exports, the report."""

from __future__ import annotations

import zipfile
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
    """Newest first. Links are left out."""
    found = []
    for kind in ("renders", "shots"):
        for folder in _folders(workspace / kind):
            movies = [path for path in sorted(folder.iterdir()) if path.suffix in MOVIES]
            found += [_result("movie", path, path.relative_to(workspace).as_posix()) for path in movies]
            frames, pattern = (folder, "frame_*") if kind == "renders" else (folder / "frames", "*.exr")
            if any(frames.glob(pattern)):
                found.append(_result("frames", frames, f"{frames.relative_to(workspace).as_posix()}.zip"))
    for place in EXPORTED.values():
        path = workspace / place
        if path.is_file() and not path.is_symlink():
            found.append(_result("export", path, place))
        elif path.is_dir() and not path.is_symlink() and any(path.iterdir()):
            found.append(_result("export", path, f"{place}.zip"))
    report = workspace / "report" / "report.html"
    if report.is_file() and not report.is_symlink():
        found.append(_result("report", report, "report/report.html"))
    return sorted(found, key=lambda result: -result.modified)


def pack(folder: Path, target: Path) -> None:
    """Write a zip of a folder's files, uncompressed (pictures are); links are left out."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and not path.is_symlink():
                archive.write(path, Path(folder.name) / path.relative_to(folder))


def _result(kind: str, path: Path, file: str) -> Result:
    files = [path] if path.is_file() else [found for found in path.rglob("*") if found.is_file()]
    sizes = [found.lstat() for found in files]
    mb = sum(entry.st_size for entry in sizes) / 2**20
    modified = max((entry.st_mtime for entry in sizes), default=0.0)
    return Result.model_validate({"file": file, "kind": kind, "mb": round(mb, 3), "modified": modified})


def _folders(parent: Path) -> list[Path]:
    if not parent.is_dir() or parent.is_symlink():
        return []
    return sorted(path for path in parent.iterdir() if path.is_dir() and not path.is_symlink())

"""What a workspace has to download, while jobs write in it."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from fastapi import HTTPException

from dnrpipe.service.config import ServerConfig
from dnrpipe.service.results import pack, packed_mb, results
from dnrpipe.service.state import State


def _write(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x" * 2**20)


def test_hidden_files_are_no_results(tmp_path: Path) -> None:
    """A movie that is being written, and an export that was interrupted, are not there yet."""
    _write(tmp_path, "renders/a/.a.mp4.12.tmp.mp4", "exports/web/.training/model.json", "exports/web/.dnrpipe-export")
    _write(tmp_path, "shots/a/frames/.0001.exr.12.tmp.exr", "renders/a/frame_0.png", "renders/.b/b.mp4")
    assert [(found.file, found.mb) for found in results(tmp_path)] == [("renders/a.zip", 1.0)]
    _write(tmp_path, "exports/web/index.html", "exports/web/ort/x", "shots/a/frames/1.exr", "renders/a/a.mp4")
    found = {entry.file: entry.mb for entry in results(tmp_path)}
    assert found == {"renders/a.zip": 2.0, "exports/web.zip": 2.0, "shots/a/frames.zip": 1.0, "renders/a/a.mp4": 1.0}
    pack(tmp_path / "exports" / "web", tmp_path / "web.zip")
    assert zipfile.ZipFile(tmp_path / "web.zip").namelist() == ["web/index.html", "web/ort/x"]
    assert packed_mb(tmp_path / "exports" / "web") == 2.0


def test_files_that_go_meanwhile_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Listed a moment ago, and renamed since."""
    _write(tmp_path, "exports/nerf/gone", "exports/nerf/kept", "report/report.html")
    seen = Path.lstat

    def lstat(path: Path) -> Any:
        if path.name in ("gone", "report.html"):
            path.unlink(missing_ok=True)
        return seen(path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "lstat", lstat)
        assert [(entry.file, entry.mb) for entry in results(tmp_path)] == [("exports/nerf.zip", 1.0)]


def test_a_folder_is_packed_where_it_fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = State(ServerConfig(root=tmp_path, free_disk_mb=10), *cast("list[Any]", [None] * 5))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=15 * 2**20))
    state.require_space(tmp_path, 4.5)
    with pytest.raises(HTTPException, match="less than 16 MiB"):
        state.require_space(tmp_path, 5.5)

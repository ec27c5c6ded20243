"""The export commands: cheap help with examples, and one line for bad input."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dnrpipe.cli import cli, explain
from dnrpipe.core.errors import UserError
from dnrpipe.core.workspace import Source, Workspace
from dnrpipe.export import web
from dnrpipe.export.browser import require_chromium
from dnrpipe.export.surface import read_baked_light
from dnrpipe.stages.base_images import light_path

COMMANDS = ("export-nerf", "export-onnx", "export-gltf", "export-web")


def test_help_is_cheap_and_has_examples() -> None:
    code = (
        "import sys; from dnrpipe.cli import _main; codes = [_main([name, '--help']) for name in sys.argv[1:]];"
        "heavy = {'torch', 'bpy', 'mitsuba', 'numpy', 'OpenEXR', 'onnx', 'onnxruntime'} & set(sys.modules);"
        "print(sorted(heavy)); sys.exit(any(codes))"
    )
    done = subprocess.run([sys.executable, "-c", code, *COMMANDS], capture_output=True, text=True, check=True)
    assert done.stdout.count("Examples:") == len(COMMANDS)
    assert done.stdout.strip().endswith("[]"), done.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_two_workspaces_are_refused(name: str) -> None:
    with pytest.raises(UserError, match="two workspaces"):
        cli.main([name, "a.dnr", "-w", "b.dnr"], standalone_mode=False)


@pytest.mark.parametrize("name", COMMANDS)
def test_no_workspace_is_said(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="no workspace in"):
        cli.main([name], standalone_mode=False)
    assert list(tmp_path.iterdir()) == []


def test_without_npm_the_runtime_is_refused_in_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DNRPIPE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(web.shutil, "which", lambda name: None)
    with pytest.raises(UserError, match="npm is not installed"):
        web.runtime()
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize(("script", "words"), [("exit 1", "did not deliver"), ("echo x > a.tgz", "other bytes")])
def test_what_npm_delivers_is_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, words: str) -> None:
    """No network, or a tampered archive: refused, and nothing is cached."""
    npm = tmp_path / "npm"
    npm.write_text(f"#!/bin/sh\n{script}\n")
    npm.chmod(0o755)
    monkeypatch.setenv("DNRPIPE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(web.shutil, "which", lambda name: str(npm))
    with pytest.raises(UserError, match=words):
        web.runtime()
    assert not (tmp_path / "cache").exists()


def test_a_truncated_light_map_is_one_line(tmp_path: Path) -> None:
    workspace = Workspace.create(tmp_path / "w.dnr", Source(path="s.blend", sha256="0"))
    with pytest.raises(UserError, match="it comes with `dnrpipe raytrace-selected`"):
        read_baked_light(workspace)
    path = light_path(workspace)
    path.parent.mkdir()
    np.savez(path, light=np.zeros((2, 2, 8, 8, 3), np.float32), fingerprint="f")
    assert read_baked_light(workspace).shape == (2, 2, 8, 8, 3)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(UserError, match=r"light\.npz: no baked light \(.*delete it and run the stage again"):
        read_baked_light(workspace)


def test_what_the_check_of_the_page_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without Chromium, and without playwright: one line that says what to install."""
    with monkeypatch.context() as patch:
        patch.setattr("shutil.which", lambda _: None)
        with pytest.raises(UserError, match=r"no Chromium here .* install one to check the page"):
            require_chromium()
    for name in ("playwright", "playwright.sync_api"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ModuleNotFoundError) as caught:
        require_chromium()
    assert explain(caught.value) == ("playwright is not installed; run `pip install 'dnrpipe[export]'`", 2)

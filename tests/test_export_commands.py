"""The export commands: cheap help with examples, and one line for bad input."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dnrpipe.cli import cli, explain
from dnrpipe.core.console import Console
from dnrpipe.core.errors import UserError
from dnrpipe.core.workspace import Source, Workspace
from dnrpipe.export import gltf, nerf, web
from dnrpipe.export.browser import require_chromium
from dnrpipe.export.nerf import raytraced_views
from dnrpipe.export.page_data import PageLight
from dnrpipe.export.surface import read_baked_light
from dnrpipe.export.web_model import training_fingerprint
from dnrpipe.stages.base_images import light_path
from dnrpipe.stages.pipeline import STAGES, fingerprint
from dnrpipe.stages.session import resolve_settings
from dnrtrain.contract import View, write_cameras
from dnrtrain.records import Selection, write

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


def test_an_npm_that_hangs_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    npm = tmp_path / "npm"
    npm.write_text("#!/bin/sh\nexec sleep 60\n")
    npm.chmod(0o755)
    monkeypatch.setenv("DNRPIPE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(web.shutil, "which", lambda name: str(npm))
    monkeypatch.setattr(web, "NPM_SECONDS", 0.2)
    with pytest.raises(UserError, match=r"did not deliver .* within 0\.2 s"):
        web.runtime()


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


def test_pictures_of_other_cameras_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After `prepare --set cameras.seed=1` the old pictures are still there, and so is the old light."""
    monkeypatch.chdir(tmp_path)
    workspace = Workspace.create(tmp_path / "w.dnr", Source(path="s.blend", sha256="0"))
    corner = tuple(tuple(float(row == column) for column in range(4)) for row in range(4))
    views = {s: View(name="0", c2w=corner, fl_x=8, fl_y=8, cx=4, cy=4, width=8, height=8) for s in ("train", "test")}
    for split, view in views.items():
        write_cameras(workspace.cameras(split), [view], split)
        for folder in ("raytraced", "base"):
            (workspace.root / folder / split).mkdir(parents=True)
            (workspace.root / folder / split / "0.exr").touch()
    light_path(workspace).touch()
    write(workspace.selection, Selection(policy="random", budget=1, seed=0, views=["0"], details={}))
    details = {
        "prepare": {"views": {"train": 1}, "drawn": {}},
        "select": {"views": ["0"]},
        "raytrace": {"views": ["0"]},
    }
    settings = resolve_settings(workspace, {}, None)
    for name, detail in details.items():
        inputs = fingerprint(STAGES[name], workspace, settings)
        assert inputs is not None
        workspace.finish_stage(name, fingerprint=inputs, output=name, seconds=1.0, detail=detail)
    monkeypatch.setattr(nerf, "reference_is_made", lambda *_: False)
    with pytest.raises(UserError, match=r"1 of 1 held-out views were .* run `dnrpipe evaluate` first"):
        raytraced_views(workspace)
    monkeypatch.setattr(nerf, "reference_is_made", lambda *_: True)
    assert raytraced_views(workspace) == {split: [view] for split, view in views.items()}
    workspace.manifest.overrides = {"cameras": {"seed": 1}}
    monkeypatch.setattr(gltf, "read_meshes", lambda _: [])
    for export in (
        lambda: raytraced_views(workspace),
        lambda: gltf.export_gltf(workspace, tmp_path / "s.glb", Console(quiet=True)),
    ):
        with pytest.raises(UserError, match=r"^export.*: prepare is out of date .* run `dnrpipe prepare` first"):
            export()


def test_a_page_does_not_go_on_with_training_on_former_pictures(tmp_path: Path) -> None:
    """The same views and light, traced anew."""
    workspace = Workspace.create(tmp_path / "w.dnr", Source(path="s.blend", sha256="0"))
    light = PageLight(codes=np.zeros((1, 2, 2, 4), np.uint8), curve=1.0, range=1.0, files=[], cutouts=False)
    found = {training_fingerprint(workspace, [], light)}
    for output in ("first", "second"):
        workspace.finish_stage("raytrace", fingerprint="", output=output, seconds=1.0, detail={"views": []})
        found.add(training_fingerprint(workspace, [], light))
    assert len(found) == 3 and training_fingerprint(workspace, [], light) in found


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

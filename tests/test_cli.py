"""Bad input gets one clear line, exit code 2, and nothing is lost. Commands run as users run them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dnrpipe.cli.service import serve
from dnrpipe.core.errors import UserError
from dnrpipe.core.workspace import SCHEMA, Manifest, Source, Workspace, locked


def _run(*arguments: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "dnrpipe.cli", *arguments],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def _refused(done: subprocess.CompletedProcess[str], *words: str) -> None:
    lines = [line for line in done.stderr.splitlines() if line.startswith("dnrpipe: error:")]
    assert done.returncode == 2, done.stderr
    assert len(lines) == 1, done.stderr
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in lines[0]


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    (tmp_path / "scene.blend").write_bytes(b"BLENDER-v300")
    source = Source(path=str(tmp_path / "scene.blend"), sha256="0")
    return Workspace.create(tmp_path / "scene.dnr", source)


def test_no_such_scene_and_folders(tmp_path: Path) -> None:
    _refused(_run("prepare", "none.blend", folder=tmp_path), "none.blend", "no such file")
    _refused(_run("prepare", str(tmp_path), folder=tmp_path), "is a folder")
    assert not list(tmp_path.glob("*.dnr"))


def test_a_file_where_a_folder_is_wanted(tmp_path: Path) -> None:
    (tmp_path / "a.blend").write_bytes(b"BLENDER-v300")
    _refused(_run("run", "a.blend", "-w", "a.blend", folder=tmp_path), "a.blend: is there already")
    _refused(_run("serve", "--root", "a.blend", "--port", "0", folder=tmp_path), "a.blend: is there already")
    assert (tmp_path / "a.blend").read_bytes() == b"BLENDER-v300"


@pytest.mark.parametrize("option", ["--rate", "--job-hours"])
@pytest.mark.parametrize("value", ["nan", "inf", "0", "1e300"])
def test_what_no_server_can_be_told(option: str, value: str) -> None:
    with pytest.raises(UserError, match=f"{option} .*: must be above 0, and 1000000 at most"):
        serve.main([option, value, "--root", "nowhere/at/all"], standalone_mode=False)


def test_bad_numbers(tmp_path: Path) -> None:
    for budget in ("-1", "-3"):
        _refused(_run("select", "--budget", budget, folder=tmp_path), "--budget", "at least 0")
    _refused(_run("select", "--budget", "many", folder=tmp_path), "--budget", "--help", "nor auto")
    _refused(_run("prepare", "--set", "cameras.trian=3", folder=tmp_path), "no workspace")


def test_unknown_command_and_option(tmp_path: Path) -> None:
    _refused(_run("prepair", folder=tmp_path), "prepair", "--help")
    _refused(_run("select", "--bugdet", "3", folder=tmp_path), "--bugdet")


def test_unknown_setting_leaves_no_folder(tmp_path: Path) -> None:
    (tmp_path / "a.blend").write_bytes(b"BLENDER-v300")
    done = _run("prepare", "a.blend", "--set", "cameras.trian=3", folder=tmp_path)
    _refused(done, "cameras.trian", "cameras.train")
    assert not (tmp_path / "a.dnr").exists()


def test_budget_above_the_candidates_is_refused_before_work(tmp_path: Path) -> None:
    (tmp_path / "a.blend").write_bytes(b"BLENDER-v300")
    done = _run("run", "a.blend", "--budget", "41", "--views", "40", folder=tmp_path)
    _refused(done, "--budget 41", "40 candidate")


def test_no_workspace_or_several(tmp_path: Path) -> None:
    _refused(_run("select", folder=tmp_path), "no workspace", "dnrpipe prepare")
    for name in ("a", "b"):
        Workspace.create(tmp_path / f"{name}.dnr", Source(path="x", sha256="0"))
    _refused(_run("select", folder=tmp_path), "several", "a.dnr, b.dnr", "-w")


@pytest.mark.parametrize("command", ["select", "raytrace-selected", "finetune", "evaluate", "render"])
def test_a_stage_before_its_input_names_the_command_to_run(workspace: Workspace, command: str) -> None:
    _refused(_run(command, folder=workspace.root.parent), "dnrpipe prepare")


def test_a_newer_workspace_is_refused(workspace: Workspace) -> None:
    path = workspace.root / "manifest.json"
    data = json.loads(path.read_text()) | {"schema": SCHEMA + 1}
    path.write_text(json.dumps(data))
    _refused(_run("status", folder=workspace.root.parent), "newer", "upgrade")


@pytest.mark.parametrize("text", ["", "{", "[]", '{"schema": 1}', '{"schema": "one"}'])
def test_a_damaged_manifest_is_refused(workspace: Workspace, text: str) -> None:
    (workspace.root / "manifest.json").write_text(text)
    _refused(_run("status", folder=workspace.root.parent), "damaged")


def test_two_processes_on_one_workspace(workspace: Workspace) -> None:
    with locked(workspace.root, "select"):
        done = _run("prepare", folder=workspace.root.parent)
        _refused(done, "dnrpipe select", str(os.getpid()))
    assert not (workspace.root / ".lock-owner").exists()


def test_a_folder_that_is_no_workspace_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "a.blend").write_bytes(b"BLENDER-v300")
    (tmp_path / "a.dnr").mkdir()
    (tmp_path / "a.dnr" / "precious.txt").write_text("keep me")
    _refused(_run("prepare", "a.blend", folder=tmp_path), "not a dnrpipe workspace", "-w")
    assert (tmp_path / "a.dnr" / "precious.txt").read_text() == "keep me"


def test_a_workspace_of_another_scene_with_the_same_name_is_not_taken_over(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "scene.blend").write_bytes(b"BLENDER-v300")
    Workspace.create(tmp_path / "scene.dnr", Source(path=str(tmp_path / "a" / "scene.blend"), sha256="0"))
    _refused(_run("prepare", "b/scene.blend", folder=tmp_path), "belongs to", "a/scene.blend", "-w")


def test_a_refused_scene_leaves_no_workspace(tmp_path: Path) -> None:
    (tmp_path / "a.blend").write_text("not a scene")
    _refused(_run("prepare", "a.blend", folder=tmp_path), "a.blend", "not a Blender file")
    assert not (tmp_path / "a.dnr").exists()


def test_a_refused_scene_leaves_an_older_workspace_as_it_was(workspace: Workspace) -> None:
    workspace.finish_stage("prepare", fingerprint="f", output="o", seconds=1.0, detail={"views": {"train": 3}})
    before = (workspace.root / "manifest.json").read_text()
    bad = workspace.root.parent / "bad.blend"
    bad.write_text("not a scene")
    _refused(_run("prepare", "bad.blend", "-w", "scene.dnr", folder=bad.parent), "not a Blender file")
    assert (workspace.root / "manifest.json").read_text() == before


def test_preparing_again_mends_a_damaged_manifest(workspace: Workspace) -> None:
    (workspace.root / "manifest.json").write_text("{")
    done = _run("prepare", "scene.blend", folder=workspace.root.parent)  # goes on to open the scene, which is none
    assert "manifest" not in done.stderr
    assert (workspace.root / "manifest.json.damaged").exists()
    assert Workspace.open(workspace.root).manifest.source.path.endswith("scene.blend")


def test_nan_in_a_camera_file_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "a.blend").write_bytes(b"BLENDER-v300")
    frame = {"transform_matrix": [[float("nan")] * 4] * 4, "fl_x": 50.0, "w": 64, "h": 64}
    (tmp_path / "nan.json").write_text(json.dumps({"frames": [frame]}))
    _refused(_run("prepare", "a.blend", "--cameras", "nan.json", folder=tmp_path), "nan.json", "NaN")
    assert not (tmp_path / "a.dnr").exists()


def test_work_done_without_weights_is_stale_once_they_are_here(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from dnrpipe.stages.pipeline import weights_cached

    monkeypatch.setenv("DNRPIPE_CACHE", str(tmp_path / "cache"))
    assert not weights_cached()
    (tmp_path / "cache" / "weights").mkdir(parents=True)
    (tmp_path / "cache" / "weights" / "weights.json").write_text("{}")
    assert weights_cached()


def test_broken_camera_file(tmp_path: Path) -> None:
    (tmp_path / "a.blend").write_bytes(b"BLENDER-v300")
    _refused(_run("prepare", "a.blend", "--cameras", "none.json", folder=tmp_path), "none.json")


def test_status_of_a_fresh_workspace(workspace: Workspace) -> None:
    done = _run("status", "--json", folder=workspace.root)
    assert done.returncode == 0, done.stderr
    stages = json.loads(done.stdout)["stages"]
    assert [row["state"] for row in stages] == ["missing"] * 5
    assert "next: dnrpipe prepare" in _run("status", folder=workspace.root).stdout


def test_help_is_cheap_and_has_examples(tmp_path: Path) -> None:
    code = (
        "import sys; from dnrpipe.cli import _main; code = _main(['prepare', '--help']);"
        "heavy = {'torch', 'bpy', 'mitsuba', 'numpy', 'OpenEXR', 'matplotlib'} & set(sys.modules);"
        "print(sorted(heavy)); sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert "Examples:" in done.stdout
    assert done.stdout.strip().endswith("[]"), done.stdout


def test_commands_that_train_nothing_load_no_torch() -> None:
    """It takes one to three seconds; so do Blender and Mitsuba, which have processes of their own."""
    code = (
        "import sys; import dnrpipe.stages.session, dnrpipe.stages.shots.make_shot;"
        "print(sorted({'torch', 'bpy', 'mitsuba'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_manifest_round_trip(workspace: Workspace) -> None:
    workspace.finish_stage("prepare", fingerprint="f", output="o", seconds=1.5, detail={"views": {"train": 3}})
    again = Workspace.open(workspace.root)
    assert again.manifest == workspace.manifest
    assert isinstance(again.manifest, Manifest)


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 KiB."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip("mounting a small tmpfs needs root")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_is_one_line(tiny_disk: Path) -> None:
    (tiny_disk / "a.blend").write_bytes(b"BLENDER-v300")
    (tiny_disk / "ballast").write_bytes(b"0" * 61440)
    _refused(_run("prepare", "a.blend", folder=tiny_disk), "disk is full")
    assert not list((tiny_disk / "a.dnr").glob("manifest*"))


def test_a_read_only_workspace_is_one_line(tiny_disk: Path) -> None:
    (tiny_disk / "a.blend").write_bytes(b"BLENDER-v300")
    subprocess.run(["mount", "-o", "remount,ro", str(tiny_disk)], check=True)
    _refused(_run("prepare", "a.blend", folder=tiny_disk), "cannot be written", "-w")


@pytest.fixture(scope="module")
def patchy_blend(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene with a lost image on a matt cube, a lamp and hair."""
    path = tmp_path_factory.mktemp("patchy") / "patchy.blend"
    code = f"""
import bpy
bpy.ops.wm.read_factory_settings()
material = bpy.data.objects["Cube"].data.materials[0]
image = material.node_tree.nodes.new("ShaderNodeTexImage")
image.image = bpy.data.images.new("lost", 4, 4)
image.image.source = "FILE"
image.image.filepath = "/nowhere/lost.png"
material.node_tree.links.new(image.outputs[0], material.node_tree.nodes["Principled BSDF"].inputs["Base Color"])
bpy.ops.wm.save_as_mainfile(filepath={str(path)!r})
"""
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=120)
    return path


def test_inspect_says_what_is_there_and_what_is_missing(patchy_blend: Path) -> None:
    folder = patchy_blend.parent
    before = sorted(folder.iterdir())
    done = _run("inspect", patchy_blend.name, "--json", folder=folder)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["census"]["materials"]["Material"]["objects"] == ["Cube"]
    assert found["exact"]["lights"] == ["Light"] and found["exact"]["materials"] == []
    assert any("lost" in row["feature"] for row in found["findings"]["missing"])
    assert {e["name"] for e in found["effects"] if e["on"]} >= {"indirect", "view-dependence"}
    assert sorted(folder.iterdir()) == before
    text = _run("inspect", patchy_blend.name, folder=folder).stdout
    assert "'Light'" in text and "lost" in text and "indirect light" in text


def test_strict_refuses_what_is_missing_and_leaves_nothing(patchy_blend: Path) -> None:
    done = _run("prepare", patchy_blend.name, "--strict", folder=patchy_blend.parent)
    _refused(done, "lost", "--strict")
    assert not (patchy_blend.parent / "patchy.dnr").exists()


def test_effects_refuses_a_name_that_is_none_and_a_workspace_without_scene(workspace: Workspace) -> None:
    _refused(_run("effects", "--disable", "fog", folder=workspace.root), "fog", "volumes")
    _refused(_run("effects", folder=workspace.root), "prepare has not run")

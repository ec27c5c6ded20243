"""How `dnrpipe shot` takes hold of a workspace: its preset, its cameras, where it runs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dnrpipe.core.errors import UserError
from dnrpipe.core.workspace import StageRecord, Workspace
from dnrpipe.stages.session import Session
from dnrpipe.stages.shot_scene import require_same_scene
from dnrpipe.stages.shots import make_shot

OPTIONS = {"as_json": True, "quiet": True, "force": False, "preset": None, "workspace": None}


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.blend"
    path.write_bytes(b"BLENDER-v300")
    return path


def hold(scene: Path | None, *assignments: str, command: str = "shot", **options: Any) -> Session:
    """A session, opened and closed."""
    given = {**OPTIONS, "assignments": assignments, **options}
    with Session(command, given, scene, {}) as session:
        return session


def prepared(session: Session) -> Workspace:
    """The session's workspace with stage prepare done."""
    detail = {"views": {"train": 2}}
    record = StageRecord(fingerprint="", output="", finished=0.0, seconds=0.0, detail=detail)
    session.workspace.manifest.stages["prepare"] = record
    session.workspace.save()
    return session.workspace


def test_a_shot_that_is_refused_at_first_is_standard_all_the_same(scene: Path, tmp_path: Path) -> None:
    root = str(tmp_path / "scene.shot.dnr")
    assert hold(scene, workspace=root).settings.preset == "standard"
    assert Workspace.open(Path(root)).manifest.preset is None, "nothing was done, as after --camera Typo"
    again = hold(scene, workspace=root)
    assert again.settings.preset == "standard"
    prepared(again)
    assert hold(scene, workspace=root).settings.preset == "standard"
    assert hold(scene, workspace=root, preset="paper").settings.preset == "paper"


def test_a_draft_workspace_stays_draft(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a bare `dnrpipe shot` finds it."""
    root = tmp_path / "scene.dnr"
    workspace = prepared(hold(scene, workspace=str(root), command="prepare"))
    assert workspace.manifest.preset is None
    assert hold(scene, workspace=str(root)).settings.preset == "draft"
    monkeypatch.chdir(tmp_path)
    assert hold(None).settings.preset == "draft"
    monkeypatch.setenv("DNRPIPE_WORKSPACE", str(root))
    assert hold(None).settings.preset == "draft"


def test_a_shot_whose_folder_is_gone_is_made_again(scene: Path, tmp_path: Path) -> None:
    """`rm -r scene.dnr/shots`, or a workspace that lies elsewhere now."""
    root = str(tmp_path / "scene.dnr")
    session = hold(scene, workspace=root)
    source = str(session.workspace.root / "shots" / "wide" / "candidates.json")
    session.adopt({"cameras": {"source": source}})
    assert hold(scene, workspace=root).settings.cameras.source == source
    with pytest.raises(UserError, match=r"candidates\.json"):  # other commands take the cameras that are there
        hold(scene, workspace=root, command="run")


def test_a_shot_has_a_workspace_of_its_own_name_and_file(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert hold(scene).workspace.root.name == "scene.shot.dnr"
    other = tmp_path / "other" / scene.name
    other.parent.mkdir()
    other.write_bytes(b"BLENDER-v301 other")
    with pytest.raises(UserError, match=r"scene\.shot\.dnr: belongs to .*; name another workspace with -w"):
        hold(other)


def test_a_scene_file_that_has_changed_is_not_mixed_with_what_was_prepared(scene: Path, tmp_path: Path) -> None:
    root = tmp_path / "scene.dnr"
    workspace = prepared(hold(scene, workspace=str(root)))
    require_same_scene(workspace)
    scene.write_bytes(b"BLENDER-v301 edited")
    with pytest.raises(UserError, match=r"scene.blend: has changed.*dnrpipe shot"):
        require_same_scene(hold(None, workspace=str(root)).workspace)
    require_same_scene(hold(scene, workspace=str(root)).workspace)  # named, it is taken over
    scene.unlink()
    with pytest.raises(UserError, match="is gone"):
        require_same_scene(workspace)


def test_settings_that_a_shot_finds_keep_where_it_runs(scene: Path, tmp_path: Path) -> None:
    session = hold(scene, "executor.engine=ray", workspace=str(tmp_path / "scene.dnr"))
    session.adopt({"cameras": {"width": 64}})
    assert session.settings.executor.engine == "ray" and session.settings.cameras.width == 64
    assert "executor" not in session.workspace.manifest.overrides


@pytest.mark.parametrize(
    ("bounced", "lost", "lights"),
    [
        (0.1, False, [(1024, 64), (1024, 16)]),
        (0.6, False, [(1024, 128), (1024, 32)]),
        (0.1, True, [(2048, 32), (2048, 16)]),
    ],
)
def test_light_is_chosen_for_each_shot(
    bounced: float,
    lost: bool,
    lights: list[tuple[int, int]],
    scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = SimpleNamespace(pilot=SimpleNamespace(beyond=lambda depth: bounced))
    monkeypatch.setattr(make_shot, "resolve_plan", lambda run: plan)
    summary = SimpleNamespace(atlas=SimpleNamespace(loses_most=lost))
    monkeypatch.setattr(make_shot, "read_summary", lambda folder: summary)
    root = str(tmp_path / "scene.dnr")
    session = hold(scene, workspace=root)
    view = SimpleNamespace(width=1280, height=720)
    frames: Any = [SimpleNamespace(view=view, moving=())] * 240
    found = []
    for count in (240, 1):
        session.adopt({})  # as `prepare_for` does
        make_shot.choose_light(session, frames[:count])
        base = session.settings.base
        found.append((base.light_size, base.light_spp))
        assert base.light_where == "seen"
    assert found == lights and session.workspace.manifest.overrides == {}
    (tmp_path / "scene.dnr" / "dnrpipe.toml").write_text('[base]\nlight_size = 512\nlight_where = "everywhere"\n')
    session = hold(scene, workspace=root)
    make_shot.choose_light(session, frames)
    base = session.settings.base
    assert (base.light_size, base.light_where) == (512, "everywhere"), "the user's, wherever it is written"

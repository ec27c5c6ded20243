"""Files on their way to a node and back, without a cluster: what is sent, where it lies, what comes back."""

from __future__ import annotations

from pathlib import Path

import pytest

from dnrpipe.workers.shipping import Mirror, moved, packed, packs_of, receive


@pytest.fixture
def root(tmp_path: Path) -> Path:
    workspace = tmp_path / "scene.dnr"
    for name in ("scene/scene.xml", "scene/scene-1a2b.xml", "scene/meshes/a.ply", "base/light.npz", "logs/x.log"):
        (workspace / name).parent.mkdir(parents=True, exist_ok=True)
        (workspace / name).write_text(name)
    (workspace / "costs.jsonl").write_text("one\n")
    return workspace


@pytest.mark.parametrize("bundle", ["scene.xml", "scene-1a2b.xml"])
def test_a_bundle_is_its_folder(root: Path, bundle: str) -> None:
    """Also one of the bundles without what is left out; what the task writes is not read."""
    common = {"bundle": str(root / "scene" / bundle), "variant": "llvm_ad_rgb"}
    task = {"light": str(root / "base" / "light.npz"), "output": str(root / "raytraced" / "train" / "0.exr")}
    found = {pack.path: (pack.folder, pack.kept) for pack in packs_of(common, task, [root])}
    assert found == {str(root / "scene"): (True, True), str(root / "base" / "light.npz"): (False, False)}
    assert not packs_of(common, task, [root / "elsewhere"])  # nothing outside of the roots


def test_what_is_read_lies_there_and_what_is_written_comes_back(root: Path, tmp_path: Path) -> None:
    mirror = Mirror(tmp_path / "node" / "packs")
    fetched = []

    def place() -> None:
        for pack in packs_of({}, {"workspace": str(root)}, [root]):
            mirror.place(pack, lambda pack=pack: fetched.append(pack) or packed(pack))

    place()
    place()
    assert len(fetched) == 1
    assert mirror.here(str(root / "scene" / "meshes" / "a.ply")).read_text() == "scene/meshes/a.ply"
    assert not mirror.here(str(root / "logs")).exists()
    before = mirror.state()
    with mirror.here(str(root / "costs.jsonl")).open("a") as file:
        file.write("two\n")
    mirror.here(str(root / "new")).mkdir()
    mirror.here(str(root / "new" / "made.exr")).write_bytes(b"made")
    mirror.here(str(root / "base" / "light.npz")).unlink()
    written, removed = mirror.changes(before)
    assert written == {str(root / "costs.jsonl"): b"one\ntwo\n", str(root / "new" / "made.exr"): b"made"}
    assert removed == [str(root / "base" / "light.npz")]
    # A second try on this node begins with what the driver has, not with what the first try left.
    place()
    assert mirror.here(str(root / "costs.jsonl")).read_text() == "one\n" and len(fetched) == 1
    receive(written, removed, [root])
    assert (root / "costs.jsonl").read_text() == "one\ntwo\n" and not (root / "base" / "light.npz").exists()
    with pytest.raises(ValueError, match="was not given"):
        receive({"/etc/passwd": b""}, [], [root])


def test_a_worker_that_died_leaves_no_mirror(tmp_path: Path) -> None:
    first = Mirror(tmp_path / "packs")
    second = Mirror(tmp_path / "packs")
    assert first.folder.exists() and second.folder.exists()  # both live
    first.lock.release()  # as the death of its process does
    third = Mirror(tmp_path / "packs")
    assert not first.folder.exists() and second.folder.exists()
    for mirror in (second, third):
        mirror.close()
        assert not mirror.folder.exists()


def test_strings_are_moved_wherever_they_are() -> None:
    assert moved({"a": ["/x/1", 2], "b": {"c": "/x"}}, lambda text: text.replace("/x", "/y")) == {
        "a": ["/y/1", 2],
        "b": {"c": "/y"},
    }

"""Files made to do harm: huge headers, paths that lead outside, code in data. Refused in one line, nothing executed."""

from __future__ import annotations

import ast
import json
import resource
import struct
import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from tests.scene_records import scene_census, scene_summary

from dnrpipe.core.cameras import read_camera_file
from dnrpipe.core.errors import UserError
from dnrpipe.core.scene_files import read_census, read_selection, read_summary
from dnrpipe.core.settings import CameraSettings
from dnrpipe.core.workspace import Manifest, Source, Workspace
from dnrpipe.stages.pipeline import owner_of
from dnrtrain.contract import ContractError, DamagedFile, SceneFrame, View, file_name, parse_transforms, write_cameras
from dnrtrain.display import DisplayTransform
from dnrtrain.exr import read_exr, write_exr
from dnrtrain.records import Record

REPO = Path(__file__).resolve().parents[1]
EYE = tuple(tuple(row) for row in np.eye(4).tolist())
VIEW = View(name="a", width=8, height=8, fl_x=8, fl_y=8, cx=4, cy=4, c2w=EYE)


def test_mutated_files_of_every_format() -> None:
    """A hundred mutations each of EXR, cameras, manifest, weights, archives, PNG …: read, or refused in one line."""
    command = [sys.executable, "-m", "tools.faults.fuzz", "--count", "100", "--json"]
    done = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=False, timeout=600)
    assert done.stdout, done.stderr
    answer = json.loads(done.stdout)
    assert len(answer["targets"]) >= 13
    assert {kind: row["errors"] for kind, row in answer["targets"].items() if row["escaped"]} == {}
    assert all(row["refused"] > 0 for row in answer["targets"].values())  # the mutations do harm
    assert answer["peak_mb"] < 1500
    assert done.returncode == 0


def test_the_fuzz_can_fail(tmp_path: Path) -> None:
    from tools.faults.fuzz import Target, fuzz

    careless = Target("a.json", b'{"views": ["a"]}', lambda path: json.loads(path.read_text())["views"][0], text=True)
    assert fuzz("careless", careless, tmp_path, 50, 0)["escaped"] > 10


@pytest.mark.parametrize(
    ("name", "record", "read"),
    [("summary.json", scene_summary(), read_summary), ("census.json", scene_census(), read_census)],
)
def test_mutated_records_of_a_scene(tmp_path: Path, name: str, record: Record, read: Callable[[Path], Record]) -> None:
    from tools.faults.fuzz import Target, fuzz

    target = Target(name, json.dumps(record.data()).encode(), lambda path: read(path.parent), text=True)
    row = fuzz(name, target, tmp_path, 300, 0)
    assert row["escaped"] == 0, row["errors"]
    assert row["refused"] > 100


@pytest.mark.parametrize("header", [b"no array at all", b"\x93NUMPY\x01\x00\x10\x00{'descr': (\x00,\n     "])
def test_archives_whose_arrays_have_no_header(tmp_path: Path, header: bytes) -> None:
    """numpy then gives bytes, or the errors of Python's parser."""
    from dnrpipe.blender.geometry.frozen import load_geometry
    from dnrpipe.raytrace.light_worker import read_light

    for name, read in (("header", load_geometry), ("light", read_light)):
        path = tmp_path / f"{name}.npz"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(f"{name}.npy", header)
        with pytest.raises(UserError, match=path.name) as refused:
            read(path)
        assert "\n" not in str(refused.value)


def test_an_error_is_one_line_whatever_it_quotes() -> None:
    assert str(UserError("unknown preset 'a\nb'")) == "unknown preset 'a b'"
    assert str(ContractError("view 'a\r\nb'")) == "view 'a b'"


@pytest.mark.parametrize("side", [65536, 99999, 2**31 - 1])
def test_an_exr_header_that_promises_too_much(tmp_path: Path, side: int) -> None:
    """600 bytes that say 17 gigapixels: refused before anything is allocated."""
    path = tmp_path / "bomb.exr"
    write_exr(path, {"R": np.zeros((4, 4))}, {})
    data = path.read_bytes()
    place = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    path.write_bytes(data[:place] + struct.pack("<4i", 0, 0, side - 1, side - 1) + data[place + 16 :])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DamagedFile) as raised:
        read_exr(path)
    assert str(path) in str(raised.value) and "\n" not in str(raised.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KiB


def test_a_display_transform_that_unpacks_to_gigabytes(tmp_path: Path) -> None:
    """A zip of zeros: 130 KB that would be 134 MB."""
    with (tmp_path / "display.npz").open("wb") as file:
        np.savez_compressed(file, lut=np.zeros((224, 224, 224, 3), np.float32), max=np.float32(16), k=np.float32(50))
    assert (tmp_path / "display.npz").stat().st_size < 200_000
    frame = SceneFrame(near=1, far=2, center=(0, 0, 0), radius=1, display_lut="display.npz")
    with pytest.raises(DamagedFile, match="no display transform"):
        DisplayTransform(frame, tmp_path)


OUTSIDE = ["../../etc/passwd", "/etc/passwd", "..", ".", "...", ".hidden", "a/../../b", "..\\..\\b", "a\x00b", "\n"]


@pytest.mark.parametrize("text", OUTSIDE)
def test_view_names_of_camera_files_stay_inside(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cameras.json"
    frame = {"file_path": text, "w": 8, "h": 8, "fl_x": 8, "transform_matrix": EYE}
    path.write_text(json.dumps({"frames": [frame, frame]}))
    views = parse_transforms(path)
    workspace = Workspace(tmp_path / "a.dnr", Manifest(source=Source(path="/a", sha256="0")))  # pyright: ignore[reportCallIssue]
    for view in views:
        for made in (workspace.passes("train", view.name), workspace.raytraced("test", view.name)):
            assert made.resolve().is_relative_to(workspace.root.resolve()) and not made.name.startswith(".")
    assert len({view.name for view in views}) == 2
    assert file_name(text) == views[0].name or "/" in text


@pytest.mark.parametrize("name", ["../display.npz", "/etc/passwd", "a/b.npz", "..", ".npz"])
def test_the_display_transform_lies_beside_its_frame(name: str) -> None:
    with pytest.raises(ValidationError):
        SceneFrame(near=1, far=2, center=(0, 0, 0), radius=1, display_lut=name)


@pytest.mark.parametrize("names", [["../../a"], ["a", "b"], [1], "a", None, [["a"]]])
def test_a_selection_names_candidates_only(tmp_path: Path, names: object) -> None:
    workspace = Workspace(tmp_path, Manifest(source=Source(path="/a", sha256="0")))  # pyright: ignore[reportCallIssue]
    write_cameras(workspace.cameras("train"), [VIEW], "train")
    workspace.selection.write_text(json.dumps({"views": names}))
    with pytest.raises(DamagedFile):
        read_selection(workspace)


def test_only_files_of_stages_are_ever_thrown_away(tmp_path: Path) -> None:
    """Mending deletes damaged files: never outside the workspace, through no link, and nothing that no stage wrote."""
    workspace = Workspace(tmp_path / "a.dnr", Manifest(source=Source(path="/a", sha256="0")))  # pyright: ignore[reportCallIssue]
    (workspace.root / "passes").mkdir(parents=True)
    (tmp_path / "mine.exr").touch()
    (workspace.root / "passes" / "link.exr").symlink_to(tmp_path / "mine.exr")
    inside = owner_of(workspace.root / "passes" / "train" / "a.exr", workspace)
    assert inside is not None and inside.name == "prepare"
    for path in ("passes/link.exr", "passes/../../mine.exr", "manifest.json", "notes.txt", "../b.dnr/passes/a.exr"):
        assert owner_of(workspace.root / path, workspace) is None, path


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"camera_angle_x": 0}, "between 0 and pi"),
        ({"camera_angle_x": 7}, "between 0 and pi"),
        ({"w": 10**400}, "too large"),
        ({"w": 1e9}, "16384"),
        ({"cx": float("nan")}, "finite"),
        ({"transform_matrix": [[1e308] * 4] * 4}, "rotation"),
        ({"transform_matrix": "identity"}, "frame 0"),
    ],
)
def test_cameras_beyond_all_bounds(tmp_path: Path, change: dict[str, object], word: str) -> None:
    path = tmp_path / "cameras.json"
    frame = {"file_path": "a", "w": 8, "h": 8, "camera_angle_x": 1.0, "transform_matrix": EYE, **change}
    path.write_text(json.dumps({"frames": [frame]}))
    with pytest.raises((UserError, ValueError), match=word) as raised:
        read_camera_file(path, CameraSettings())
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"frames":' * 100_000, "1" * 100_000, "\x00"])
def test_json_that_is_none(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"cameras\.json"):
        parse_transforms(path)
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(UserError, match=r"manifest\.json"):
        Workspace.open(tmp_path)


def test_no_reader_executes_what_it_reads() -> None:
    """No pickle but the one restricted to numpy; numpy and torch are told so at every call."""
    for path in [*(REPO / "pipeline").rglob("*.py"), *(REPO / "trainer").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {alias.name for alias in node.names} | {getattr(node, "module", None)}
                banned = names & {"pickle", "shelve", "marshal", "dill", "joblib"}
                assert not banned or path.name == "weights.py", f"{path}: {banned}"
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "load":
                owner = ast.unparse(node.func.value)
                options = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
                if owner == "np":
                    assert options.get("allow_pickle") == "False", f"{path}:{node.lineno}"
                if owner == "torch":
                    assert options.get("weights_only") == "True", f"{path}:{node.lineno}"
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("eval", "exec"), f"{path}:{node.lineno}"


PHONE = """
import socket
socket.create_connection(("127.0.0.1", {port}), timeout=5).close()
open({marker!r}, "w").close()
"""


@pytest.mark.slow
def test_a_blend_can_neither_write_nor_phone_home(tmp_path: Path) -> None:
    """A script that wants to run on opening and a Python driver: `inspect` and `prepare` run neither, and say so."""
    import socket

    server = socket.create_server(("127.0.0.1", 0))
    calls: list[object] = []

    def answer() -> None:
        while True:
            try:
                calls.append(server.accept())
            except OSError:
                return

    threading.Thread(target=answer, daemon=True).start()
    marker, port = str(tmp_path / "executed"), server.getsockname()[1]
    script = PHONE.format(port=port, marker=marker)
    build = f"""
import bpy
bpy.ops.wm.read_factory_settings()
text = bpy.data.texts.new("on_load.py")
text.write({script!r})
text.use_module = True
driver = bpy.data.objects["Cube"].driver_add("location", 0).driver
driver.expression = "exec(" + repr({script!r}) + ") or 1"
bpy.ops.wm.save_as_mainfile(filepath={str(tmp_path / "evil.blend")!r})
"""
    subprocess.run([sys.executable, "-c", build], check=True, capture_output=True, timeout=120)
    Path(marker).unlink(missing_ok=True)
    calls.clear()
    # The trap works: Blender with scripts on springs it.
    sprung = f"import bpy; bpy.ops.wm.open_mainfile(filepath={str(tmp_path / 'evil.blend')!r}, use_scripts=True)"
    subprocess.run([sys.executable, "-c", sprung], capture_output=True, timeout=120, check=False)
    assert Path(marker).exists() and calls
    Path(marker).unlink()
    calls.clear()
    command = [sys.executable, "-m", "dnrpipe.cli", "inspect", "evil.blend"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert "on_load.py" in done.stdout + done.stderr
    assert not Path(marker).exists() and not calls
    server.close()

"""Any file opens, or says in one line why not; whatever is missing is named."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from dnrpipe.blender.findings import Findings  # noqa: E402
from dnrpipe.blender.inspection import Worker  # noqa: E402
from dnrpipe.blender.prepare import prepare  # noqa: E402
from dnrpipe.blender.reading.framing import framing_pose  # noqa: E402
from dnrpipe.blender.reading.light import studio_radiance  # noqa: E402
from dnrpipe.blender.reading.loading import load_scene  # noqa: E402
from dnrpipe.blender.reading.missing import missing_files  # noqa: E402
from dnrpipe.blender.reading.names import find_material  # noqa: E402
from dnrpipe.blender.reading.opening import open_scene  # noqa: E402
from dnrpipe.blender.reading.packing import pack_everything, save_blend  # noqa: E402
from dnrpipe.blender.tasks import InspectAnswer, InspectTask  # noqa: E402
from dnrpipe.core.errors import UserError  # noqa: E402
from dnrpipe.core.scene_files import read_summary, scene_fingerprint  # noqa: E402
from dnrpipe.effects.plan import plan_effects  # noqa: E402


def _neighbour(name: str) -> Any:
    """A module beside this one (pytest's importlib mode leaves tests/ out of sys.path)."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


nasty_scenes = _neighbour("nasty_scenes")
OPENS, REFUSED = nasty_scenes.OPENS, nasty_scenes.REFUSED


@pytest.mark.parametrize("name", OPENS)
def test_opens_and_says_what_it_did(name: str, tmp_path: Path) -> None:
    builder, said = OPENS[name]
    loaded = load_scene(builder(tmp_path))
    assert all("\n" not in line for line in loaded.warnings)
    text = "\n".join(loaded.warnings)
    for words in said:
        assert words in text, text
    "\n".join(loaded.warnings).encode("utf-8")  # no surrogates: terminals and JSON readers choke on them
    meshes = loaded.frozen.meshes
    assert meshes and all(np.isfinite(mesh.positions).all() for mesh in meshes)
    assert np.isfinite(loaded.bounds.radius) and loaded.bounds.radius > 0
    assert loaded.scene.camera.type == "CAMERA"
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("name", REFUSED)
def test_refuses_in_one_line(name: str, tmp_path: Path) -> None:
    builder, said = REFUSED[name]
    path = builder(tmp_path)
    with pytest.raises(UserError) as raised:
        load_scene(path)
    message = str(raised.value)
    assert said in message and str(path) in message and "\n" not in message


@pytest.mark.parametrize("name", ["lights only", "volume only", "points only"])
def test_a_file_without_a_surface_can_be_inspected(name: str, tmp_path: Path) -> None:
    """There is nothing to convert, but what it holds can be said."""
    builder, said = REFUSED[name]
    task = InspectTask(source=builder(tmp_path), folder=tmp_path / "bundle", bake_size=64)
    answer = Worker({})(task.data())
    found = InspectAnswer.model_validate(json.loads(json.dumps(answer)))
    assert said in found.warnings[0]
    assert sum(found.census.objects.values()) >= 1 and found.census.triangles == 0
    assert plan_effects(found.census, {}).effects


@pytest.mark.parametrize("name", ["awkward names", "broken transforms", "not finite"])
def test_converts(name: str, tmp_path: Path) -> None:
    """The whole conversion of what is hardest on file names, JSON and XML."""
    path = OPENS[name][0](tmp_path)
    summary = prepare(path, tmp_path / "scene")
    assert read_summary(tmp_path / "scene") == summary
    bundle = tmp_path / "scene"
    assert (bundle / "scene.xml").read_text(encoding="utf-8").count("<shape") >= 1
    names = [file.name for file in (bundle / "meshes").iterdir()]
    assert len({name.lower() for name in names}) == len(names)  # also where case does not count
    assert (bundle / "source.blend").is_file()


def test_strict_names_all_that_is_missing(tmp_path: Path) -> None:
    path = nasty_scenes.missing_everything(tmp_path)
    with pytest.raises(UserError) as raised:
        open_scene(path, strict=True)
    message = str(raised.value)
    for name in ("gone.png", "library.blend", "smoke.vdb", "--strict", str(path)):
        assert name in message
    assert "\n" not in message
    assert open_scene(nasty_scenes.bare(tmp_path), strict=True) == []


def test_findings_name_what_is_missing(tmp_path: Path) -> None:
    loaded = load_scene(nasty_scenes.missing_everything(tmp_path))
    features = {finding.feature for finding in loaded.findings if finding.kind == "missing"}
    assert {"linked library 'library.blend'", "volume 'smoke'", "linked object 'linked [library.blend]'"} <= features


def test_scene_is_out_of_date_when_a_missing_file_turns_up(tmp_path: Path) -> None:
    prepare(nasty_scenes.missing_everything(tmp_path), tmp_path / "scene")
    source = SimpleNamespace(sha256="of the scene file")
    workspace: Any = SimpleNamespace(scene=tmp_path / "scene", manifest=SimpleNamespace(source=source))
    before = scene_fingerprint(workspace)
    assert scene_fingerprint(workspace) == before
    (tmp_path / "gone").mkdir()
    (tmp_path / "gone" / "gone.png").write_bytes(b"found again")
    assert scene_fingerprint(workspace) != before


def test_only_the_lost_tile_is_missing(tmp_path: Path) -> None:
    load_scene(nasty_scenes.half_udim(tmp_path))
    assert [reference.path.name for reference in missing_files()] == ["tile.1002.png"]


def test_same_names_stay_apart(tmp_path: Path) -> None:
    meshes = load_scene(nasty_scenes.same_names(tmp_path)).frozen.meshes
    colours = set()
    for mesh in meshes:
        material = find_material(str(mesh.materials[0]))
        assert material is not None
        colours.add(tuple(material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value)[:3])
    assert colours == {(1, 0, 0), (0, 1, 0), (0, 0, 1)}
    assert len({mesh.object_id for mesh in meshes}) == 3


def test_overrides_count(tmp_path: Path) -> None:
    [mesh] = load_scene(nasty_scenes.overridden(tmp_path)).frozen.meshes
    assert mesh.positions[:, 2].min() == pytest.approx(7)


def test_source_blend_stands_alone(tmp_path: Path) -> None:
    """Libraries of libraries are packed: it opens without them, elsewhere."""
    loaded = load_scene(nasty_scenes.chained(tmp_path / "a"))
    triangles = loaded.frozen.meshes[0].triangles
    assert pack_everything() == []
    save_blend(tmp_path / "b.blend")
    for library in (tmp_path / "a" / "libs").iterdir():
        library.unlink()
    again = load_scene(tmp_path / "b.blend")
    assert again.frozen.meshes[0].triangles == triangles
    open_scene(nasty_scenes.chained(tmp_path / "c", relative=False))
    [warning] = pack_everything()
    assert "first.blend" in warning and "absolute path" in warning


def test_framing_camera_sees_everything(tmp_path: Path) -> None:
    loaded = load_scene(nasty_scenes.bare(tmp_path))
    camera = loaded.scene.camera
    points = loaded.frozen.meshes[0].positions.astype(np.float64)
    inverse = np.linalg.inv(np.array(camera.matrix_world))
    seen = points @ inverse[:3, :3].T + inverse[:3, 3]
    scene = loaded.scene
    width, height = scene.render.resolution_x, scene.render.resolution_y
    focal = camera.data.lens / camera.data.sensor_width * max(width, height)
    assert (seen[:, 2] < 0).all()
    assert (np.abs(seen[:, 0] / -seen[:, 2] * focal) < width / 2).all()
    assert (np.abs(seen[:, 1] / -seen[:, 2] * focal) < height / 2).all()
    pose = framing_pose(np.zeros(3), 2.0)
    assert pose[:3, 3] == pytest.approx(2 * pose[:3, 2]) and np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_own_light_is_kept_and_none_is_replaced(tmp_path: Path) -> None:
    dark = load_scene(nasty_scenes.bare(tmp_path))
    assert not dark.has_light and dark.scene.world.name == "dnrpipe.studio"
    default = load_scene(nasty_scenes.default_world(tmp_path))
    assert not default.has_light and default.scene.world.name == "dnrpipe.studio"
    nasty_scenes.default_world(tmp_path)
    bpy.data.worlds["World"].node_tree.nodes["Background"].inputs["Strength"].default_value = 3
    coloured = load_scene(nasty_scenes.save(tmp_path / "world.blend"))
    assert coloured.has_light and coloured.scene.world.name == "World"
    nasty_scenes.empty()
    nasty_scenes.cube()
    nasty_scenes.link("sun", bpy.data.lights.new("sun", "SUN"))
    lit = load_scene(nasty_scenes.save(tmp_path / "lit.blend"))
    assert lit.has_light and lit.scene.world is None


def test_studio_is_neutral_and_calibrated() -> None:
    """A white floor has radiance 1; light comes from above; no texel is dark or far too bright."""
    width, height = 128, 64
    radiance = studio_radiance(width, height)
    theta = np.pi * ((np.arange(height) + 0.5) / height - 0.5)
    weight = np.maximum(np.sin(theta), 0) * np.cos(theta) * (2 * np.pi / width) * (np.pi / height)
    assert (radiance * weight[:, None]).sum() / np.pi == pytest.approx(1, rel=1e-4)
    assert radiance[height // 2 :].mean() > radiance[: height // 2].mean()
    assert radiance.min() > 0.1 and radiance.max() < 10


def test_numbers_become_a_new_nodes(tmp_path: Path) -> None:
    load_scene(nasty_scenes.not_finite(tmp_path))
    principled = bpy.data.materials["not finite"].node_tree.nodes["Principled BSDF"]
    assert principled.inputs["IOR"].default_value == 1.5 and principled.inputs["Roughness"].default_value == 0.5
    assert list(principled.inputs["Base Color"].default_value) == pytest.approx([0.8, 0.8, 0.8, 1])


def test_findings_take_any_text() -> None:
    findings = Findings()
    findings.add("missing", "image 'x'", "not found: \udcfcbel.png")
    assert next(iter(findings)).note == "not found: \\xfcbel.png"

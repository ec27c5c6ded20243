"""Any file goes through the whole conversion; whatever is left out or approximated is named."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from tests import nasty_images, nasty_materials, nasty_objects  # noqa: E402

from dnrpipe.blender.baking import bake  # noqa: E402
from dnrpipe.blender.geometry import atlas  # noqa: E402
from dnrpipe.blender.geometry.frozen import load_geometry  # noqa: E402
from dnrpipe.blender.inspection import inspect  # noqa: E402
from dnrpipe.blender.lighting import world_images  # noqa: E402
from dnrpipe.blender.prepare import prepare  # noqa: E402
from dnrpipe.blender.tasks import BakeCommon, BakeOptions, BakeTask, InspectTask, PendingBakes  # noqa: E402
from dnrpipe.core.scene_records import SceneSummary  # noqa: E402

CONVERTS = nasty_materials.CONVERTS | nasty_images.CONVERTS | nasty_objects.CONVERTS

SLOW = {"sky", "many slots", "alpha modes", "deep parents"}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planar charts and small pictures of worlds: packing by shape takes a second per file, and is tested elsewhere."""
    monkeypatch.setattr(atlas, "SMART_MESHES", 0)
    monkeypatch.setattr(world_images, "SIZE", (64, 32))
    monkeypatch.setattr(world_images, "SAMPLES", 1)


def refuse(text: str) -> Any:
    raise AssertionError(f"{text} in a JSON file")


def said_of(folder: Path, warnings: list[str]) -> str:
    """Warnings and findings as one text; checks the files on the way."""
    files = {
        name: json.loads((folder / name).read_text(), parse_constant=refuse) for name in ("frame.json", "summary.json")
    }
    assert files
    census = json.loads((folder / "census.json").read_text(), parse_constant=refuse)
    rows = [
        f"{row['kind']}: {row['feature']} (object '{row['object']}', material '{row['material']}'): {row['note']}"
        for row in census["findings"]
    ]
    assert all("\n" not in line for line in warnings)
    return "\n".join([*warnings, *rows])


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.robustness) if name in SLOW else name for name in CONVERTS]
)
def test_converts_and_says_what_it_did(name: str, tmp_path: Path) -> None:
    builder, words = CONVERTS[name]
    scene = tmp_path / "scene"
    summary = prepare(builder(tmp_path), scene)
    assert isinstance(summary, SceneSummary)
    text = said_of(scene, summary.warnings)
    for word in words:
        assert word in text, text
    text.encode("utf-8")
    meshes = load_geometry(scene / "geometry.npz")
    assert meshes and all(np.isfinite(mesh.positions).all() for mesh in meshes)
    root = ET.parse(scene / "scene.xml").getroot()
    numbers = [part for element in root.iter() for part in element.get("value", "").split()]
    assert not {"nan", "inf", "-inf"} & set(numbers)


def test_what_the_viewport_hides_is_where_renders_see_it(tmp_path: Path) -> None:
    """Blender evaluates for scripts what the viewport shows; lamps and cameras elsewhere stayed at the origin."""
    summary = prepare(nasty_objects.hidden_in_viewport(tmp_path), tmp_path / "scene")
    assert isinstance(summary, SceneSummary)
    root = ET.parse(tmp_path / "scene" / "scene.xml").getroot()
    lamps = {element.get("id", ""): element for element in root.iter("shape") if element.get("type") == "sphere"}
    names = ("eye", "screen", "parents_too", "collection", "collection_by_eye", "driven", "instanced")
    assert sorted(lamps) == sorted(f"light-{name}" for name in names)
    radiance = {}
    for name, lamp in lamps.items():
        center, colour = lamp.find("point"), lamp.find(".//rgb")
        assert center is not None and colour is not None
        assert [float(center.get(axis, "")) for axis in "xyz"] == pytest.approx([11, 2, 3]), name
        radiance[name] = float(colour.get("value", "").split()[0])
    assert radiance["light-driven"] == pytest.approx(10 * radiance["light-eye"], rel=1e-4)  # 100 W, and 10
    places = {camera.name: [row[3] for row in camera.c2w[:3]] for camera in summary.cameras}
    assert places["camera"] == pytest.approx([11, 2, 3]) == places["excluded"]


def with_bakes(path: Path, folder: Path) -> SceneSummary:
    """The whole conversion, with everything baked that is not computed."""
    options = BakeOptions(folder=folder / "bakes", size=64)
    options.folder.mkdir(parents=True)
    made = prepare(path, folder / "scene", bakes=options)
    if isinstance(made, PendingBakes):
        common = BakeCommon(
            source=path,
            frame=made.frame,
            geometry=folder / "scene" / "geometry.npz",
            folder=options.folder,
            size=options.size,
            threads=1,
        )
        worker = bake.Worker(common.data())
        for layer in made.layers:
            worker(BakeTask(layer=layer, output=options.folder).data())
        made = prepare(path, folder / "scene", bakes=options)
    assert isinstance(made, SceneSummary)
    return made


@pytest.mark.parametrize(
    "name", ["foreign texture", "typed groups", "zones", "many outputs", "attributes", "one-dimensional"]
)
def test_converts_with_bakes(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bake, "SAMPLES", 1)
    builder, words = CONVERTS[name]
    summary = with_bakes(builder(tmp_path), tmp_path)
    text = said_of(tmp_path / "scene", summary.warnings)
    for word in words:
        assert word in text, text


def test_what_is_baked_in_magenta_is_named(tmp_path: Path) -> None:
    summary = with_bakes(nasty_images.sequences(tmp_path), tmp_path)
    text = said_of(tmp_path / "scene", summary.warnings)
    for word in ("frame_0002.png'; magenta", "frame_0090.png'; magenta", "movie.mp4'; magenta", "animated image"):
        assert word in text, text
    assert "frame_0007.png'; magenta" not in text  # that one is there


@pytest.mark.robustness
@pytest.mark.parametrize("name", [name for name in CONVERTS if name not in {"sequences", "changed", "alpha modes"}])
def test_converts_with_bakes_too(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    test_converts_with_bakes(name, tmp_path, monkeypatch)


@pytest.mark.robustness
@pytest.mark.parametrize("name", nasty_materials.SWEEPS)
def test_every_node_is_baked(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bake, "SAMPLES", 1)
    with_bakes(nasty_materials.SWEEPS[name][0](tmp_path), tmp_path)


@pytest.mark.robustness
@pytest.mark.parametrize("name", nasty_materials.SWEEPS)
def test_every_node_in_every_place(name: str, tmp_path: Path) -> None:
    path = nasty_materials.SWEEPS[name][0](tmp_path)
    prepare(path, tmp_path / "scene")
    inspect(InspectTask(source=path, folder=tmp_path / "bundle", bake_size=64))

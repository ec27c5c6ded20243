"""What the scene builders share, and that the second half of the benchmark scenes has the effects it is there for."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from dnrpipe.blender.reading.opening import open_scene  # noqa: E402

FOLDER = Path(__file__).resolve().parent.parent / "blender_scenes"


@pytest.fixture
def builders(monkeypatch: pytest.MonkeyPatch) -> Any:
    """(solids, gems): the builders' own modules, which they import from their folder."""
    monkeypatch.syspath_prepend(str(FOLDER))
    import gems
    import solids

    return solids, gems


def volume(shape: Any) -> float:
    """Signed volume: positive where all faces wind outward and the body is closed."""
    total = 0.0
    for face in shape.faces:
        corners = shape.points[list(face)]
        for b, c in pairwise(corners[1:]):
            total += float(corners[0] @ np.cross(b, c)) / 6
    return total


def open_edges(shape: Any) -> int:
    """Edges that are not walked in both directions, vertices at one place counting as one."""
    _, merged = np.unique(shape.points.round(9), axis=0, return_inverse=True)
    walked = {(merged[a], merged[b]) for f in shape.faces for a, b in zip(f, (*f[1:], f[0]), strict=True)}
    return sum((b, a) not in walked for a, b in walked)


def test_solids_are_closed_and_face_outward(builders: Any) -> None:
    solids, _ = builders
    line = np.array([[0, 0, 0], [0, 0, 0.5], [0, 0, 1.0]])
    circle = solids.loop_spline([(np.cos(a), np.sin(a), 0) for a in np.arange(8) * np.pi / 4], 6)
    for shape, wanted, within in (
        (solids.box((1, 2, 3)), 6.0, 1e-9),
        (solids.box((1, 2, 3), bevel=0.1), 5.885, 1e-2),
        (solids.ball(1.0, 24, 32), 4 / 3 * np.pi, 0.08),
        (solids.tube(line, 0.5, 32), np.pi / 4, 0.02),
        (solids.tube(circle, 0.1, 12, closed=True), 2 * np.pi**2 * 0.01, 0.02),
        (solids.extruded([(0, 0), (2, 0), (2, 1), (1, 0.4), (0, 1)], 1.0), 1.4, 1e-9),
    ):
        assert volume(shape) == pytest.approx(wanted, abs=within)
        assert open_edges(shape) == 0
        assert len(shape.uv) == sum(map(len, shape.faces)) and np.isfinite(shape.uv).all()


def test_cut_stones_have_the_facets_and_angles_of_their_cut(builders: Any) -> None:
    _, gems = builders
    stone = gems.brilliant(1.0)
    assert open_edges(stone) == 0 and volume(stone) > 0.5
    # Table, 8 bezels, 8 stars, 16 upper and 16 lower halves, 8 pavilion mains, 16 girdle facets, culet.
    assert len(stone.faces) == 74
    assert np.ptp(stone.points[:, 0]) == pytest.approx(2.0, rel=0.02)
    tilts = []
    for face in stone.faces:
        corners = stone.points[list(face)]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        tilts.append(np.degrees(np.arccos(normal[2] / np.linalg.norm(normal))))
    assert np.sum(np.isclose(tilts, 34.5, atol=0.2)) == 8
    assert np.sum(np.isclose(tilts, 180 - 40.75, atol=0.2)) == 8
    step = gems.emerald_cut(0.2, 0.15)
    assert open_edges(step) == 0 and volume(step) > 0


def inputs(material: Any) -> dict[str, Any]:
    shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    return {socket.name: socket.default_value for socket in shader.inputs if hasattr(socket, "default_value")}


def test_bricks_are_thousands_of_instances_of_few_meshes() -> None:
    open_scene(FOLDER / "bricks.blend")
    names = [i.object.data.name for i in bpy.context.evaluated_depsgraph_get().object_instances if i.is_instance]
    assert len(names) > 2000 and len(set(names)) < 150
    assert bpy.data.images["fingerprints"].users > 8


def test_materials_cover_mirror_to_rough_metal_plastic_glass_coat_and_cloth() -> None:
    open_scene(FOLDER / "materials.blend")
    found = {
        m.name: inputs(m) for m in bpy.data.materials if any(n.type == "BSDF_PRINCIPLED" for n in m.node_tree.nodes)
    }
    metals = {name: values["Roughness"] for name, values in found.items() if values["Metallic"] == 1.0}
    assert min(metals.values()) == 0 and max(metals.values()) >= 0.5
    assert {"Clear glass", "Amber glass"} <= {n for n, v in found.items() if v["Transmission Weight"] > 0.9}
    assert found["Car paint"]["Coat Weight"] == 1 and found["Woven cloth"]["Sheen Weight"] > 0.5
    glass = [n for m in bpy.data.materials for n in m.node_tree.nodes if n.type == "BSDF_GLASS"]
    assert sorted(round(n.inputs["Roughness"].default_value, 2) for n in glass) == [0.0, 0.25]


def test_microphone_is_thin_wires_and_a_live_curve() -> None:
    open_scene(FOLDER / "microphone.blend")
    assert bpy.data.objects["Cable"].type == "CURVE"
    grille = bpy.data.objects["Grille"].data
    edges = np.array(
        [(grille.vertices[a].co - grille.vertices[b].co).length for a, b in (e.vertices for e in grille.edges)]
    )
    assert len(grille.polygons) > 10_000 and np.quantile(edges, 0.4) < 0.006


def test_ship_swims_in_absorbing_water() -> None:
    open_scene(FOLDER / "ship.blend")
    water = bpy.data.materials["Sea water"]
    assert any(n.type == "VOLUME_ABSORPTION" for n in water.node_tree.nodes)
    assert inputs(water)["Transmission Weight"] == 1 and inputs(water)["IOR"] == pytest.approx(1.33)
    surface, hull = bpy.data.objects["Water"], bpy.data.objects["Hull"]
    low, high = (np.array(hull.bound_box)[:, 2].min(), np.array(hull.bound_box)[:, 2].max())
    assert low < np.array(surface.bound_box)[:, 2].max() < high
    assert not bpy.data.objects["Sail 2.1"].modifiers and len(bpy.data.objects["Hull"].data.materials) == 4


def test_jewels_are_lit_by_small_lamps_through_flat_shaded_glass() -> None:
    open_scene(FOLDER / "jewels.blend")
    assert all(light.shadow_soft_size <= 0.03 for light in bpy.data.lights)
    stones = {
        o.name for o in bpy.data.objects if o.type == "MESH" and inputs(o.data.materials[0])["Transmission Weight"] == 1
    }
    assert len(stones) > 12
    assert not any(p.use_smooth for p in bpy.data.objects["Ruby"].data.polygons)
    indices = {round(inputs(m)["IOR"], 2) for m in bpy.data.materials if inputs(m)["Transmission Weight"] == 1}
    assert {1.52, 1.77, 2.42} <= indices
    pearls = {o.data.name for o in bpy.data.objects if o.name.startswith("Pearl ")}
    assert len(pearls) == 1


@pytest.mark.parametrize(
    "name",
    ["materials", *(pytest.param(n, marks=pytest.mark.robustness) for n in ("bricks", "microphone", "ship", "jewels"))],
)
def test_script_builds_the_committed_scene(name: str, tmp_path: Path) -> None:
    built = tmp_path / f"{name}.blend"
    command = [sys.executable, str(FOLDER / f"build_{name}.py"), str(built)]
    subprocess.run(command, check=True, capture_output=True, timeout=200)

    def contents(path: Path) -> dict[str, tuple[int, float]]:
        open_scene(path)
        found = {}
        for mesh in bpy.data.meshes:
            points = np.empty(3 * len(mesh.vertices), np.float32)
            mesh.vertices.foreach_get("co", points)
            found[mesh.name] = (len(mesh.polygons), float(np.abs(points).sum()))
        return found

    ours, committed = contents(built), contents(FOLDER / f"{name}.blend")
    assert ours.keys() == committed.keys()
    for key, (faces, total) in ours.items():
        assert faces == committed[key][0]
        assert total == pytest.approx(committed[key][1], rel=1e-4)

"""The committed benchmark scenes: small, self-contained, fit for a dome of cameras, each with its own effects, and
what their scripts build."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from dnrpipe.blender.cameras import camera_animation, scene_cameras  # noqa: E402
from dnrpipe.blender.reading.opening import open_scene  # noqa: E402

FOLDER = Path(__file__).resolve().parent.parent / "blender_scenes"
BENCHMARKS = (
    "bricks",
    "drums",
    "foliage",
    "food",
    "furniture",
    "interior",
    "jewels",
    "materials",
    "microphone",
    "ship",
)
SLOW_TO_BUILD = ("drums", "food", "furniture", "interior")


def evaluated() -> Iterator[tuple[Any, Any, np.ndarray]]:
    """(instance's object, its evaluated mesh, world positions [N, 3]) of everything that renders."""
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        obj = instance.object
        if obj.type != "MESH" or obj.hide_render:
            continue
        mesh = obj.data
        positions = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", positions)
        matrix = np.array(instance.matrix_world)
        yield obj, mesh, positions.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]


def triangles(mesh: Any) -> int:
    return len(mesh.loops) - 2 * len(mesh.polygons)


def nodes(kind: str) -> set[str]:
    """Names of the materials that use a node of this type."""
    return {m.name for m in bpy.data.materials if m.use_nodes and any(n.type == kind for n in m.node_tree.nodes)}


def inputs_above(socket: str, value: float) -> set[str]:
    """Names of the materials whose Principled BSDF has a constant above ``value`` there."""
    found = set()
    for made in bpy.data.materials:
        for node in made.node_tree.nodes if made.use_nodes else ():
            if node.type == "BSDF_PRINCIPLED" and node.inputs[socket].default_value > value:
                found.add(made.name)
    return found


@pytest.mark.parametrize("name", BENCHMARKS)
def test_is_small_self_contained_and_fits_a_dome(name: str) -> None:
    path = FOLDER / f"{name}.blend"
    assert path.stat().st_size < 3_000_000
    assert open_scene(path) == []
    assert bpy.data.images and all(image.packed_file for image in bpy.data.images if image.users)
    assert not bpy.data.libraries and not bpy.data.texts

    scene = bpy.context.scene
    assert scene.render.engine == "CYCLES" and scene.render.film_transparent
    (camera,) = scene_cameras(scene)
    assert camera.active and camera.type == "PERSP"
    background = scene.world.node_tree.nodes["Background"]
    lit = bool(background.inputs["Color"].links) or max(background.inputs["Color"].default_value[:3]) > 0
    assert lit and background.inputs["Strength"].default_value > 0

    count, corners = 0, []
    for obj, mesh, positions in evaluated():
        if not mesh.polygons:
            continue
        count += triangles(mesh)
        corners.append((positions.min(0), positions.max(0)))
        assert mesh.uv_layers, f"{obj.name} has no UVs"
        uv = np.empty(2 * len(mesh.loops), np.float32)
        mesh.uv_layers.active.data.foreach_get("uv", uv)
        assert np.isfinite(uv).all() and np.ptp(uv) > 0, f"the UVs of {obj.name} are a point"
        assert mesh.materials and all(mesh.materials), f"{obj.name} has a surface without a material"
    assert count >= 5_000
    low, high = np.min([c[0] for c in corners], 0), np.max([c[1] for c in corners], 0)
    assert 0.7 < np.linalg.norm(high - low) / 2 < 2.5
    assert np.abs((low + high) / 2)[:2].max() < 0.35


def test_each_scene_has_the_effects_it_is_there_for() -> None:
    open_scene(FOLDER / "furniture.blend")
    assert nodes("TEX_VORONOI") == {"Leather"} and nodes("BUMP") == {"Leather"}
    assert {"Damask", "Kilim", "Rug"} <= nodes("NORMAL_MAP") and "Damask" in inputs_above("Sheen Weight", 0.1)

    open_scene(FOLDER / "drums.blend")
    assert {"Chrome", "Cymbal bronze", "Hammered steel"} <= inputs_above("Metallic", 0.9)
    assert "Red sparkle" in inputs_above("Coat Weight", 0.9) and "Cymbal bronze" in nodes("NORMAL_MAP")
    lugs = [obj for obj in bpy.data.objects if obj.name.startswith("Kick lug")]
    assert len(lugs) == 10 and len({obj.data.name for obj in lugs}) == 1

    open_scene(FOLDER / "foliage.blend")
    assert nodes("BSDF_TRANSPARENT") == nodes("BSDF_TRANSLUCENT") == {"Fig leaves"}
    assert {"Terracotta", "Soil", "Flagstones"} <= nodes("VALTORGB")
    leaves = bpy.data.images["leaves"]
    alpha = np.array(leaves.pixels)[3::4]
    assert 0.2 < np.mean(alpha > 0.9) < 0.7 and np.mean((alpha > 0.05) & (alpha < 0.95)) < 0.08
    assert sum(obj.data.name.startswith("Twig") for obj in bpy.data.objects if obj.type == "MESH") > 80

    open_scene(FOLDER / "food.blend")
    assert {"Bun", "Sausage", "Tomato", "Ketchup"} <= inputs_above("Subsurface Weight", 0.2)
    assert {"Bun", "Sausage", "Painted porcelain", "Printed paper"} <= nodes("TEX_IMAGE")

    open_scene(FOLDER / "interior.blend")
    assert nodes("TEX_BRICK") == {"Brickwork"} and "Bulb" in inputs_above("Emission Strength", 10)
    assert sorted(obj.data.type for obj in bpy.data.objects if obj.type == "LIGHT") == ["AREA", "POINT", "POINT"]
    assert bpy.context.scene.view_settings.view_transform == "AgX"
    path = np.array([frame.c2w for frame in camera_animation(bpy.context.scene)])
    assert len(path) == 120
    # It drives through the room: inside the walls, never through one.
    steps = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    assert steps.sum() > 2.0 and steps.max() < 0.1
    assert np.abs(path[:, 0, 3]).max() < 1.05 and path[:, 1, 3].max() < 0.6


@pytest.mark.parametrize(
    "name", ["foliage", *(pytest.param(name, marks=pytest.mark.robustness) for name in SLOW_TO_BUILD)]
)
def test_script_builds_the_committed_scene(name: str, tmp_path: Path) -> None:
    built = tmp_path / f"{name}.blend"
    script = FOLDER / f"build_{name}.py"
    done = subprocess.run([sys.executable, str(script), str(built)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr

    def contents(path: Path) -> tuple[list[set[str]], dict[str, tuple[int, np.ndarray]]]:
        open_scene(path)
        kinds = (bpy.data.objects, bpy.data.materials, bpy.data.images, bpy.data.lights)
        shapes: dict[str, tuple[int, np.ndarray]] = {}
        for obj, mesh, positions in evaluated():
            # Instances of one object have the same name: their triangles and means add up.
            number, mean = shapes.get(obj.name, (0, np.zeros(3)))
            shapes[obj.name] = (number + triangles(mesh), mean + positions.mean(0))
        return [{block.name for block in kind if block.users} for kind in kinds], shapes

    (names, ours), (committed_names, committed) = contents(built), contents(FOLDER / f"{name}.blend")
    assert names == committed_names and ours.keys() == committed.keys()
    for key, (number, mean) in ours.items():
        assert number == committed[key][0], key
        assert mean == pytest.approx(committed[key][1], abs=1e-3), key

"""The committed demo scene: small, self-contained, varied, and what its script builds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from dnrpipe.blender.baking.pending import convert_materials  # noqa: E402
from dnrpipe.blender.bundle.display import export_display  # noqa: E402
from dnrpipe.blender.bundle.export import bounding_sphere, export_bundle  # noqa: E402
from dnrpipe.blender.census import take_census  # noqa: E402
from dnrpipe.blender.findings import Findings  # noqa: E402
from dnrpipe.blender.geometry.freeze import freeze_scene  # noqa: E402
from dnrpipe.blender.reading.opening import open_scene  # noqa: E402

FOLDER = Path(__file__).resolve().parent.parent / "blender_scenes"
DEMO = FOLDER / "demo.blend"


def test_is_small_and_self_contained() -> None:
    assert DEMO.stat().st_size < 3_000_000
    assert open_scene(DEMO) == []
    assert bpy.data.images and all(image.packed_file for image in bpy.data.images if image.users)
    assert not bpy.data.libraries and not bpy.data.texts


def test_has_what_a_demo_needs(tmp_path: Path) -> None:
    open_scene(DEMO)
    scene = bpy.context.scene
    findings = Findings()
    meshes = freeze_scene(scene).meshes
    census = take_census(scene, findings, meshes)
    assert census.objects["MESH"] >= 6 and scene.camera is not None
    assert census.world and census.world.kind == "hdri" and not census.lights
    assert census.transmission == ["Glass"] and "Brass" in census.metals
    assert census.normal_maps and not census.procedural_textures
    assert max(census.triangles_by_object.values()) > 10_000
    assert export_display(scene, tmp_path)["display_lut"] is None
    center, radius = bounding_sphere(meshes)
    assert radius < 2.1 and np.hypot(center[0], center[1]) < 0.1
    export_bundle(meshes, convert_materials(meshes, tmp_path, findings, None))
    # Nothing in it is beyond the converter: rough metal's energy is made up for, no more.
    assert {(f.kind, f.feature) for f in findings} <= {("approximated", "rough metal")}


@pytest.mark.slow
def test_script_builds_the_committed_scene(tmp_path: Path) -> None:
    built = tmp_path / "demo.blend"
    subprocess.run([sys.executable, str(FOLDER / "build_demo.py"), str(built)], check=True, timeout=120)

    def contents(path: Path) -> dict[str, tuple[int, float]]:
        open_scene(path)
        return {m.name: (m.triangles, float(m.positions.sum())) for m in freeze_scene(bpy.context.scene).meshes}

    ours, committed = contents(built), contents(DEMO)
    assert ours.keys() == committed.keys()
    for name, (triangles, total) in ours.items():
        assert triangles == committed[name][0]
        assert total == pytest.approx(committed[name][1], rel=1e-4, abs=0.5)

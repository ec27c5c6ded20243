"""Coverage, mask and ray-traced alpha agree: cut-outs, hidden objects, instances, hair."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dnrtrain.exr import read_exr

SCRIPT = Path(__file__).parent / "geometry_scene.py"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    pytest.importorskip("bpy")
    from dnrpipe.raytrace.variants import choose_variant

    environment = choose_variant("llvm_ad_rgb").environment
    folder = tmp_path_factory.mktemp("cutouts")
    import os

    for step in ("prepare", "passes", "trace"):
        subprocess.run(
            [sys.executable, str(SCRIPT), step, str(folder)], check=True, env={**os.environ, **environment}, timeout=300
        )
    channels, _ = read_exr(folder / "view.exr")
    return {
        "folder": folder,
        "report": json.loads((folder / "report.json").read_text()),
        "passes": channels,
        "alpha": np.load(folder / "trace.npz")["alpha"],
    }


def test_thousand_instances_share_one_mesh(scene: dict[str, Any]) -> None:
    meshes = scene["report"]["meshes"]
    assert meshes["pebble"][:2] == [12, 64**2]
    assert "4,097 instances" in str(scene["report"]["findings"])


def test_coverage_is_the_alpha_of_the_ray_tracer(scene: dict[str, Any]) -> None:
    coverage = scene["passes"]["coverage"]
    difference = np.abs(coverage - scene["alpha"])
    assert 0.2 < coverage.mean() < 0.8
    assert difference.mean() < 0.01 and np.quantile(difference, 0.995) < 0.2


def test_mask_sees_through_holes_and_what_is_not_there(scene: dict[str, Any]) -> None:
    passes, ids = scene["passes"], {name: mesh[2] for name, mesh in scene["report"]["meshes"].items()}
    seen = set(np.unique(passes["object.Id"]).astype(int))
    assert seen == {0, ids["ball"], ids["head"], ids["pebble"], ids["sheet"]}
    clear = (passes["coverage"] < 0.1) | (passes["coverage"] > 0.9)
    assert ((passes["mask"] > 0.5) == (passes["coverage"] > 0.5))[clear].mean() > 0.998
    # The ball behind the sheet, through its holes: farther away than the sheet around.
    ball, sheet = (passes["object.Id"] == ids[name] for name in ("ball", "sheet"))
    assert passes["depth.Z"][ball].min() > np.median(passes["depth.Z"][sheet])
    assert (passes["mask"][ball] == 1).all()


def test_strands_are_a_shape_of_their_own(scene: dict[str, Any]) -> None:
    from dnrpipe.effects.bundle import bundle_facts

    assert bundle_facts(scene["folder"] / "scene.xml")["hair"] == ["hair-head_0001"]
    assert "40 strands" in str(scene["report"]["findings"])

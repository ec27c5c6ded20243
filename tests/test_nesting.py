"""Nested BSDFs, each in a process of its own: compiled by LLVM, and one ray at a time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.nesting_scene import GLASS, LEAVES, WRAPPERS

SCRIPT = Path(__file__).with_name("nesting_scene.py")
ONE_SIDED = ("dnr_principled", "roughconductor")
"""Leaves that stand in ``twosided``, as the conversion writes them."""
PRODUCTION = ("mask", "dnr_normal", "twosided", "dnr_principled")
PAIRS = [
    (outer, inner, "twosided", "dnr_principled")
    for outer in WRAPPERS[:-1]
    for inner in WRAPPERS[:-1]
    if (outer, inner) != PRODUCTION[:2]
]
SINGLE = [
    (wrapper, *(("twosided",) if leaf in ONE_SIDED else ()), leaf) for wrapper in WRAPPERS[:-1] for leaf in LEAVES
]


def rendered(variant: str, folder: Path, names: tuple[str, ...]) -> dict[str, Any]:
    from dnrpipe.raytrace.variants import choose_variant

    folder.mkdir()
    command = [sys.executable, str(SCRIPT), variant, str(folder), *names]
    environment = {**os.environ, **choose_variant("llvm_ad_rgb").environment}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout[done.stdout.index("{") :])  # Mitsuba warns on stdout


@pytest.mark.parametrize(
    "names",
    [PRODUCTION, *(pytest.param(names, marks=pytest.mark.robustness) for names in (*PAIRS, *SINGLE))],
    ids=" > ".join,
)
def test_nested_bsdfs_compile_and_agree(names: tuple[str, ...], tmp_path: Path, mitsuba_variant: str) -> None:
    if mitsuba_variant.startswith("scalar"):
        pytest.skip("no LLVM here")
    compiled, scalar = (
        rendered("llvm_ad_rgb", tmp_path / "llvm", names),
        rendered("scalar_rgb", tmp_path / "one", names),
    )
    assert compiled["lost"] == scalar["lost"] == 0
    assert compiled["path"] == pytest.approx(scalar["path"], rel=0.05) and compiled["path"] > 0.01
    if names[-1] not in GLASS:  # nothing is there to throw a caustic
        assert compiled["path-without-caustics"] == pytest.approx(compiled["path"], rel=0.02)
    # Dr.Jit writes a function twice that is called both through a table and without.
    assert compiled["kernels"] > 0 and compiled["direct"] == []

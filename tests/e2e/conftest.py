"""One tiny finished workspace that the end-to-end tests share (they never change it)."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

# importlib mode puts no test folder on sys.path; the harness is loaded by path, once.
_spec = importlib.util.spec_from_file_location("e2e_harness", Path(__file__).with_name("harness.py"))
assert _spec and _spec.loader
harness = importlib.util.module_from_spec(_spec)
sys.modules["e2e_harness"] = harness
_spec.loader.exec_module(harness)


@pytest.fixture(scope="session")
def tiny(made_once: Callable[[str, Callable[[Path], object]], Path], demo_blend: Path) -> Path:
    """The demo scene through all stages at 64², one command after the other."""

    def build(folder: Path) -> None:
        harness.run("prepare", str(demo_blend), folder=folder)
        for stage in harness.STAGES[1:]:
            harness.run(stage, folder=folder)

    return made_once("tiny", build) / "demo.dnr"

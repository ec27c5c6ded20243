"""The measurement of peak memory (tools/faults/memory.py) notices what it is there for; a small sample of its steps."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from tools.faults import memory

from dnrtrain.contract import GBUFFER_CHANNELS, RASTER_CHANNELS
from dnrtrain.exr import read_exr

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
# Multiplied as a bytearray: bytes that are made first would lie beside their copy for a moment, 400 MiB in all.
CHILD = "import time; block = bytearray(b'x') * (200 << 20); time.sleep({seconds})"
PARENT = """
import subprocess, sys
block = bytearray(b"x") * (200 << 20)
subprocess.run([sys.executable, "-c", {child!r}])
"""


def test_memory_of_children_counts_and_the_bound_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process of 200 MiB and its child of 200 MiB: measured together, and killed at 0.3 GiB within seconds."""
    for seconds, bound in ((1, 2.0), (60, 0.3)):
        parent = PARENT.format(child=CHILD.format(seconds=seconds))
        monkeypatch.setitem(memory.BOUNDS, "selection", bound)
        reading = memory.measure("selection", [sys.executable, "-c", parent], {}, 50)
        if seconds == 1:
            assert reading.problem == "" and 0.39 < reading.gib < 0.6
        else:
            assert reading.problem == "more than 0.3 GiB" and reading.seconds < 30


def test_a_step_that_fails_or_hangs_is_a_problem() -> None:
    failing = memory.measure("selection", [sys.executable, "-c", "raise SystemExit('no such scene')"], {}, 60)
    assert failing.problem == "exit code 1: no such scene"
    hanging = memory.measure("selection", [sys.executable, "-c", "import time; time.sleep(60)"], {}, 1)
    assert hanging.problem == "more than 1 s" and hanging.seconds < 20


def test_written_candidates_are_chosen_from_and_read(tmp_path: Path) -> None:
    """Files as the pipeline writes them: every rule chooses, and the trainer reads them."""
    memory.write_passes(tmp_path / "candidates", 40)
    channels, _ = read_exr(next((tmp_path / "candidates").iterdir()))
    assert set(channels) == {*GBUFFER_CHANNELS, *RASTER_CHANNELS}
    assert channels["mask"].sum() > 50
    inside = channels["mask"] > 0
    length = np.sqrt(sum(channels[f"normal.{axis}"] ** 2 for axis in "XYZ"))
    assert np.abs(length[inside] - 1).max() < 1e-4
    memory.choose(tmp_path, 40)
    memory.read_all(tmp_path, 40)

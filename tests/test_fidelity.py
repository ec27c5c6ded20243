"""The fidelity harness: three scenes end to end, and that its verdict can be "no"."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def measure(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT))
    pytest.importorskip("torch")
    from tools.fidelity import measure

    return measure


def _pair(rng: np.random.Generator, value: float, sigma: float) -> list[np.ndarray]:
    pictures = [np.full((48, 48, 4), value, np.float32) for _ in range(2)]
    for picture in pictures:
        picture[..., :3] += rng.normal(0, sigma, (48, 48, 3)).astype(np.float32)
        picture[..., 3] = 1
    return pictures


def test_noise_alone_is_recognised_and_five_percent_are_not(measure: Any) -> None:
    rng = np.random.default_rng(0)
    reference = _pair(rng, 0.4, 0.02)
    same = measure.compare(reference, _pair(rng, 0.4, 0.01))
    assert same.psnr == pytest.approx(same.floor, abs=0.5) and same.rmse < 0.01
    assert measure.holds("exact", same)
    brighter = measure.compare(reference, _pair(rng, 0.42, 0.01))
    assert brighter.energy == pytest.approx(1.05, abs=2e-3) and brighter.rmse == pytest.approx(0.05, abs=5e-3)
    assert measure.holds("exact", brighter) is False and measure.holds("baked", brighter) is False
    assert measure.holds("approximated", brighter) is None


def test_the_weakest_finding_is_the_claim(measure: Any) -> None:
    assert measure.claim_of([]) == "exact"
    assert measure.claim_of([{"kind": "exact"}, {"kind": "baked"}]) == "baked"
    assert measure.claim_of([{"kind": "baked"}, {"kind": "ignored"}]) == "approximated"


def test_the_code_that_renders_hang_on_is_there() -> None:
    from tools.fidelity import ours

    assert len({ours.code_hash(part) for part in (ours.CONVERSION, ours.TRACING, ours.PLUGINS)}) == 3


@pytest.mark.slow
def test_three_scenes_hold_what_the_conversion_claims(tmp_path: Path) -> None:
    pytest.importorskip("bpy")
    pytest.importorskip("mitsuba")
    names = ["area_square", "glossy_node", "image_mapping"]
    options = ["--cache", str(tmp_path), "--cycles-spp", "24", "--spp", "48", "--docs", str(tmp_path / "docs")]
    done = subprocess.run(
        [sys.executable, "-m", "tools.fidelity", "--only", *names, *options],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    records = {name: json.loads((tmp_path / "results" / f"{name}.json").read_text()) for name in names}
    for record in records.values():
        assert record["error"] is None and record["claim"] == "exact", record["findings"]
        assert abs(record["measured"]["energy"] - 1) < 0.02
        assert record["measured"]["psnr"] > 30  # few samples: the floor is 33 to 40 dB
    # A wrong formula must show: radiance P / 4A is a factor pi / 4 too dark.
    assert records["area_square"]["formulas"]["area_quarter"]["energy"] == pytest.approx(np.pi / 4, abs=0.01)
    text = (tmp_path / "docs" / "fidelity.md").read_text()
    assert "area radiance P/4A" in text and all(record["title"] in text for record in records.values())
    assert len(list((tmp_path / "docs" / "images").glob("fidelity-*.jpg"))) == 3

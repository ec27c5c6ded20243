"""What `make demo` promises: the demo scene at the draft preset reaches its quality, and costs nothing twice."""

from __future__ import annotations

import json
import resource
import subprocess
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from e2e_harness import command, image

from dnrpipe.export.browser import find_chromium, open_page

pytestmark = [pytest.mark.slow, pytest.mark.e2e]


def _dnrpipe(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(command(*arguments), cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done


SHORT = (
    *("select.budget=5", "cameras.train=20", "cameras.test=2", "raytrace.evaluation_spp=192"),
    *("base.light_size=512", "base.light_spp=16", "finetune.step2.epochs=25"),
)
"""A fifth of the draft preset's views and of its paths of light, a tenth of its steps: what every run can wait for."""


@pytest.fixture(scope="module", params=["short", pytest.param("whole", marks=pytest.mark.robustness)])
def demo(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, demo_blend: Path) -> Path:
    folder = tmp_path_factory.mktemp(request.param)
    chosen = SHORT if request.param == "short" else ("select.budget=25",)
    settings = [part for setting in chosen for part in ("--set", setting)]
    _dnrpipe("run", str(demo_blend), "--quiet", *settings, folder=folder)
    return folder / "demo.dnr"


@pytest.mark.timeout(1200)
def test_held_out_quality(demo: Path) -> None:
    metrics = json.loads((demo / "evaluation" / "metrics.json").read_text())
    whole = demo.parent.name.startswith("whole")
    assert len(metrics["views"]) == (12 if whole else 2)
    mean = metrics["mean"]
    print({key: round(value, 4) for key, value in mean.items() if value is not None})
    assert mean["psnr"] >= (33.5 if whole else 33.2)
    assert mean["ssim"] >= 0.975
    assert mean["psnr_base"] < mean["psnr_shipped"] < mean["psnr"]
    rungs = metrics["baseline"]  # path tracing with a denoiser: more samples are better, and take longer
    assert [rung["spp"] for rung in rungs] == [1, 4, 16, 64]
    for less, more in pairwise(rungs):
        assert more["psnr"] > less["psnr"]
    assert rungs[-1]["seconds"] > 2 * rungs[0]["seconds"]
    # A picture of the scene, not of a mean colour: it beats the best constant inside the mask by far.
    for view in metrics["views"]:
        truth = image(demo / "evaluation" / f"{view['name']}.truth.png")
        prediction = image(demo / "evaluation" / f"{view['name']}.prediction.png")
        inside = (truth < 0.99).any(-1)
        constant = ((truth[inside] - truth[inside].mean(0)) ** 2).mean()
        assert ((truth - prediction)[inside] ** 2).mean() < 0.08 * constant


def test_again_does_nothing(demo: Path, demo_blend: Path) -> None:
    before = _children_seconds()
    done = _dnrpipe("run", str(demo_blend), folder=demo.parent)
    assert _children_seconds() - before < 10
    assert done.stdout.count("up to date") == 5


def _children_seconds() -> float:
    """Processor time of all commands so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_the_report_draws_in_a_browser(demo: Path, tmp_path: Path) -> None:
    if find_chromium() is None:
        pytest.skip("no Chromium is installed")
    page = demo / "report" / "report.html"
    text = page.read_text(encoding="utf-8")
    assert "http://" not in text.replace("http://www.w3.org", "")
    assert "https://" not in text
    assert "Path tracing with a denoiser" in text
    with open_page(page.as_uri(), width=1200, height=1600) as (drawn, _):
        drawn.screenshot(path=tmp_path / "report.png")
        dom = drawn.content()
    picture = image(tmp_path / "report.png")[..., :3]
    # Colourful: the scene's pictures are on it, not only text on a ground.
    assert (np.ptp(picture, axis=-1) > 0.2).mean() > 0.01
    mean = json.loads((demo / "evaluation" / "metrics.json").read_text())["mean"]
    assert f"{mean['psnr']:.2f}" in dom

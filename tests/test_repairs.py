"""What is not finite is replaced, counted and said: never silently."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dnrpipe.core.console import Console
from dnrpipe.core.settings import Settings
from dnrpipe.core.workspace import Source, Workspace
from dnrpipe.raytrace.engine import masked, masked_channels
from dnrpipe.raytrace.noise import half_noise
from dnrpipe.raytrace.pictures import repair
from dnrpipe.stages.base_images import BaseRenderer, bake_light
from dnrpipe.stages.effect_plan import run_pilots
from dnrpipe.stages.stage import Run
from dnrpipe.workers import view_tasks
from dnrpipe.workers.placement import HERE
from dnrpipe.workers.task_list import TaskResult
from dnrpipe.workers.view_tasks import warn_of_repairs
from dnrtrain.contract import ContractError, View
from dnrtrain.exr import read_exr, write_exr


def picture(value: float = 0.5) -> np.ndarray:
    return np.full((4, 5, 4), value)


def test_nan_from_an_integrator_is_traced_again() -> None:
    """Two pixels of one half are NaN, one of the other infinite; other seeds give good ones."""
    half_a, half_b = picture(), picture()
    half_a[0, 0, 1] = half_a[3, 4, 0] = np.nan
    half_b[2, 2, 2] = np.inf
    seeds: list[tuple[int, int]] = []

    def again(attempt: int, index: int) -> np.ndarray:
        seeds.append((attempt, index))
        return picture(0.25)

    assert repair((half_a, half_b), again) == (3, 0)
    assert half_a[0, 0, 1] == half_a[3, 4, 0] == 0.25 and half_b[2, 2, 2] == 0.25
    assert (half_a == 0.5).sum() == 4 * 5 * 4 - 2 * 4  # whole pixels are replaced, others stay
    assert seeds == [(0, 0), (0, 1)]


def test_what_stays_nan_is_masked_and_counted() -> None:
    bad = picture()
    bad[1, 1] = np.nan
    assert repair((bad, picture()), lambda attempt, index: picture(np.nan)) == (0, 1)
    assert (bad[1, 1] == 0).all() and np.isfinite(bad).all()


@pytest.mark.parametrize("scale", [0.0, 1e-40, 1e8])
def test_noise_of_extreme_pictures(scale: float) -> None:
    noise = half_noise(picture(scale), picture(scale))
    assert noise.relative == noise.rmse == 0.0


def test_repairs_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks = []
    for name, metadata in (("7", {"repaired": 12, "masked": 0}), ("8", {"repaired": 0}), ("9", {"masked": 2}),
                           ("10", {"guides_masked": 3})):  # fmt: skip
        path = tmp_path / "train" / f"{name}.exr"
        write_exr(path, {"R": np.zeros((2, 2))}, metadata)
        tasks.append({"view": {}, "output": str(path)})
    warn_of_repairs(tasks, Console(quiet=True))
    said = capsys.readouterr().err
    assert "repaired: 12 pixels in view train/7" in said and "2 more set to zero" in said and "train/8" not in said
    assert "repaired: 3 pixels of the denoiser's guides in view train/10" in said


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_masked_pixels_are_counted(bad: float) -> None:
    """Whole pixels, of a picture and of channels; good pictures come back as they are, HDR sums and all."""
    image = picture().astype(np.float32)
    assert masked(image) == (image, 0)
    image[1, 2, 3] = image[1, 2, 0] = image[0, 0, 1] = bad
    clean, lost = masked(image)
    assert lost == 2 and clean.dtype == np.float32
    assert (clean[1, 2] == 0).all() and (clean[0, 0] == 0).all() and (clean == 0.5).sum() == 4 * 5 * 4 - 2 * 4
    channels = {name: image[..., i] for i, name in enumerate("RGBA")}
    found, lost = masked_channels(channels)
    assert lost == 2 and all((found[name] == clean[..., i]).all() for i, name in enumerate("RGBA"))
    bright = {"R": np.full((4, 5), 3e38, np.float32)}  # its sum is infinite, its pixels are not
    found, lost = masked_channels(bright)
    assert lost == 0 and (found["R"] == bright["R"]).all()


def test_pilot_pictures_that_are_not_finite_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the pilot's worker, and said by the command that asked it."""
    from dnrpipe.raytrace import pilot

    bad = picture()
    bad[0, 0, 0] = np.nan

    class Poisoned:
        mi, variant, compiled = SimpleNamespace(set_variant=lambda name: None), "v", True

        def integrator(self, *_: object) -> tuple[None, str]:
            return None, "path"

        def sensor(self, *_: object) -> None:
            return None

        def frame(self, *_: object) -> tuple[np.ndarray, int]:
            return bad.copy(), 1

    worker: Any = object.__new__(pilot.Worker)
    worker.engines, worker.masked = {"v": Poisoned()}, 7
    view = {"name": "v", "width": 5, "height": 4, "fl_x": 5, "fl_y": 5, "cx": 2, "cy": 2, "c2w": np.eye(4).tolist()}
    config = {"bundle": "b", "variant": "v", "integrator": "path", "max_depth": 4}
    task = {"kind": "compare", "with_effect": config, "without_effect": config, "views": [{"view": view}], "spp": 1}
    answer = worker(task)
    assert answer["masked"] == 6  # one pixel of two warm-up frames and two halves of two configurations
    assert answer["error"]["mean"] == 0
    monkeypatch.setattr(view_tasks, "run_tasks", lambda *_, **__: [TaskResult(task, answer)])
    choice: Any = SimpleNamespace(environment={})
    run: Any = SimpleNamespace(console=Console(quiet=True), place=HERE)
    assert run_pilots([task], choice, run, "pilot", tmp_path / "log") == [answer]
    assert "repaired: 6 pixels of pilot pictures were not finite" in capsys.readouterr().err


def test_light_that_is_not_finite_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The baker's count reaches the terminal and the ledger."""
    task = {"output": str(tmp_path / "light.npz"), "fingerprint": "f", "size": 16, "spp": 4, "gather": False}
    result = {"seconds": 1.0, "cpu_seconds": 1.0, "peak_mb": 1.0, "texels": 9, "lost": 12, "gathered": False}
    monkeypatch.setattr(view_tasks, "run_tasks", lambda *_, **__: [TaskResult(task, result)])
    workspace = Workspace.create(tmp_path / "a.dnr", Source(path="a.blend", sha256=""))
    run = Run(workspace, Settings(), Console(quiet=True), "raytrace", "r")
    bake_light(run, BaseRenderer({"bundle": "b", "variant": "v"}, {}, task, "f"))
    assert "repaired: 12 samples of the baked light were not finite" in capsys.readouterr().err
    assert workspace.ledger.read()[0].detail["lost"] == 12


def test_baked_texels_that_are_not_finite_are_counted() -> None:
    pytest.importorskip("bpy")
    from dnrpipe.blender.baking.bake import _complete

    size = 4
    pixels = np.arange(size * size * 3, dtype=np.float32).reshape(-1, 3)
    texels = np.arange(size * size)
    values, lost = _complete(pixels, texels, size)
    assert lost == 0 and (values == pixels).all()
    pixels[5, 1], pixels[10] = np.nan, np.inf
    values, lost = _complete(pixels, texels, size)
    assert lost == 2 and np.isfinite(values).all()
    assert any((values[5] == pixels[i]).all() for i in (4, 6, 1, 9))


def test_path_tracing_in_the_live_view_counts_what_is_not_finite() -> None:
    """A NaN pixel is black in the mean that is shown, and told with the picture it was traced for."""
    pytest.importorskip("torch")
    from dnrpipe.service import live_frames

    bad = picture().astype(np.float32)
    bad[1, 1, 0] = np.nan
    worker: Any = object.__new__(live_frames.Worker)
    worker.traced, worker.repaired = None, 0
    worker.display = SimpleNamespace(over_white=lambda colour, alpha: colour)
    worker.frames = lambda size: SimpleNamespace(path=lambda *_, seed: bad if seed == 1 else picture())
    eye = tuple(tuple(float(x) for x in row) for row in np.eye(4))
    view = View(name="v", width=5, height=4, fl_x=5, fl_y=5, cx=2.5, cy=2, c2w=eye)
    shown, count = worker._reference(view, 1)
    assert (count, worker.repaired) == (1, 1) and shown[1, 1, 0] == 0
    worker.repaired = 0
    shown, count = worker._reference(view, 1)
    assert (count, worker.repaired) == (2, 0) and shown[1, 1, 0] == 0.25


def test_a_file_never_holds_a_hidden_nan(tmp_path: Path) -> None:
    with pytest.raises(ContractError, match="1 non-finite"):
        write_exr(tmp_path / "a.exr", {"R": np.array([[0.0, np.nan]])}, {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("value", [1e8, 1e-40, 3e38, -0.0])
def test_extreme_numbers_survive_a_file(tmp_path: Path, value: float) -> None:
    pixels = np.full((3, 3), value, np.float32)
    write_exr(tmp_path / "a.exr", {"R": pixels}, {})
    assert read_exr(tmp_path / "a.exr")[0]["R"].tobytes() == pixels.tobytes()


def test_textures_that_are_not_finite_are_a_finding() -> None:
    pytest.importorskip("bpy")
    from dnrpipe.blender.findings import Findings
    from dnrpipe.blender.shading.textures import finite_texels

    findings = Findings()
    texels = np.ones((4, 4, 3), np.float32)
    assert finite_texels(texels, "image 'a'", findings) is texels and len(findings) == 0
    texels[0, 0, 0], texels[2, 1, 2] = np.nan, np.inf
    fixed = finite_texels(texels, "image 'a'", findings)
    assert np.isfinite(fixed).all() and fixed[0, 0, 0] == 0 and fixed[2, 1, 2] > 1e4
    assert "2 texels" in next(iter(findings)).note

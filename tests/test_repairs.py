"""What is not finite is replaced, counted and said: never silently."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dnrpipe.console import Console
from dnrpipe.raytrace.noise import half_noise
from dnrpipe.raytrace.pictures import repair
from dnrpipe.tasks import warn_repairs
from dnrtrain.contract import ContractError
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
    for name, metadata in (("7", {"repaired": 12, "masked": 0}), ("8", {"repaired": 0}), ("9", {"masked": 2})):
        path = tmp_path / "train" / f"{name}.exr"
        write_exr(path, {"R": np.zeros((2, 2))}, metadata)
        tasks.append({"view": {}, "output": str(path)})
    warn_repairs(tasks, Console(quiet=True))
    said = capsys.readouterr().err
    assert "repaired: 12 pixels in view train/7" in said and "2 more set to zero" in said and "train/8" not in said


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
    assert "2 texels" in findings.to_list()[0]["note"]

"""The denoiser: nearer to a clean render, alpha and bits kept, nonsense refused; gutters of lightmaps."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from tests.scene_records import sphere_summary

from dnrpipe.core.cameras import make_cameras
from dnrpipe.core.errors import UserError
from dnrpipe.core.images import read_rgba
from dnrpipe.core.settings import CameraSettings
from dnrpipe.raytrace.denoise import denoise, filled
from dnrpipe.raytrace.variants import choose_variant
from dnrpipe.workers.task_list import TaskResult, run_tasks

SUMMARY = sphere_summary((0.0, 0.0, 0.0), 1.2)
BUNDLE = """<scene version="3.0.0">
  <integrator type="path"/>
  <emitter type="constant"/>
  <shape type="sphere"><transform name="to_world"><scale value="0.7"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.2, 0.1"/></bsdf></shape>
  <shape type="disk"><transform name="to_world"><scale value="1.5"/><translate z="-0.7"/></transform>
    <bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.3, 0.5, 0.4"/></bsdf></bsdf></shape>
</scene>"""


@pytest.fixture(scope="module")
def renders(tmp_path_factory: pytest.TempPathFactory) -> tuple[np.ndarray, np.ndarray]:
    """(noisy, clean) RGBA of a red ball on a green plate under an even sky, 96x64."""
    folder = tmp_path_factory.mktemp("scene")
    (folder / "scene.xml").write_text(BUNDLE)
    view = make_cameras(SUMMARY, CameraSettings(train=1, val=0, test=0, width=96, height=64))["train"][0]
    choice = choose_variant()
    tasks = [
        {
            "view": view.model_dump(mode="json"),
            "output": str(folder / f"{spp}.exr"),
            "spp": spp,
            "max_depth": 4,
            "seed": seed,
            "fingerprint": "f",
        }
        for seed, spp in enumerate((4, 2048))
    ]
    common = {"bundle": str(folder / "scene.xml"), "variant": choice.variant, "threads": 1}
    outcomes = run_tasks(
        "dnrpipe.raytrace.tracer", common, tasks, workers=1, log=folder / "log", environment=choice.environment
    )
    assert all(o.result for o in outcomes if isinstance(o, TaskResult))
    noisy, clean = (read_rgba(folder / f"{spp}.exr") for spp in (4, 2048))
    return noisy, clean


def _rmse(image: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean((image[..., :3] - truth[..., :3]) ** 2)))


def _flat(shape: tuple[int, int], value: tuple[float, float, float]) -> np.ndarray:
    return np.broadcast_to(np.array(value, dtype=np.float32), (*shape, 3)).copy()


def test_a_noisy_render_comes_nearer_to_the_clean_one(renders: tuple[np.ndarray, np.ndarray]) -> None:
    noisy, clean = renders
    before = _rmse(noisy, clean)
    for quality in ("high", "fast"):
        assert _rmse(denoise(noisy, quality=quality), clean) < 0.6 * before
    # Blurring is not denoising: the mean stays.
    assert denoise(noisy)[..., :3].mean() == pytest.approx(noisy[..., :3].mean(), rel=0.02)


def test_auxiliary_images_keep_what_colour_alone_would_blur() -> None:
    """A stripe pattern buried in noise: the denoiser finds it where the albedo shows it."""
    rng = np.random.default_rng(0)
    stripes = np.where(np.arange(96) % 6 < 3, 0.2, 0.8)[None, :, None] * np.ones((96, 96, 3))
    noisy = (stripes * rng.gamma(0.4, 2.5, stripes.shape)).astype(np.float32)
    normal = _flat((96, 96), (0, 0, 1))
    plain, guided = denoise(noisy), denoise(noisy, stripes, normal)
    assert _rmse(guided, stripes) < 0.5 * _rmse(plain, stripes)
    assert not np.array_equal(guided, denoise(noisy, stripes, normal, clean=False))


def test_alpha_and_the_input_stay_as_they_are(renders: tuple[np.ndarray, np.ndarray]) -> None:
    noisy = renders[0]
    before = noisy.copy()
    first = denoise(noisy)
    kept = first.copy()
    assert first.shape == noisy.shape
    assert np.array_equal(first[..., 3], noisy[..., 3].astype(np.float32))
    assert np.array_equal(noisy, before)
    denoise(noisy * 2)  # the same filter again must not write into what it gave before
    assert np.array_equal(first, kept)


def test_the_same_bits_whatever_the_number_of_threads(renders: tuple[np.ndarray, np.ndarray]) -> None:
    noisy = renders[0]
    alone = denoise(noisy, threads=1)
    assert np.array_equal(alone, denoise(noisy, threads=1))
    assert all(np.array_equal(alone, denoise(noisy, threads=count)) for count in (2, 4))


def test_nonsense_is_refused_with_the_place() -> None:
    good = np.ones((8, 9, 3), np.float32)
    for value in (np.nan, np.inf):
        bad = good.copy()
        bad[3, 5, 1] = value
        with pytest.raises(ValueError, match="image: not finite in 1 of 72 pixels, the first in row 3, column 5"):
            denoise(bad)
        with pytest.raises(ValueError, match="normal: not finite"):
            denoise(good, good, bad)
    with pytest.raises(ValueError, match=r"image: has shape \(8, 9\)"):
        denoise(good[..., 0])
    with pytest.raises(ValueError, match="albedo: is 9x7, expected 9x8 pixels"):
        denoise(good, good[:7])
    with pytest.raises(ValueError, match="needs the albedo"):
        denoise(good, None, good)
    with pytest.raises(ValueError, match="quality: is 'best'"):
        denoise(good, quality="best")  # pyright: ignore[reportArgumentType]


def test_a_missing_denoiser_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    with pytest.raises(UserError, match="pip install 'dnrpipe"):
        denoise(np.ones((8, 8, 3), np.float32), threads=3)  # a device that no other test made


def test_a_lightmap_loses_noise_and_its_charts_keep_their_rims() -> None:
    """Charts of even light on black: with the mask, rims come out as bright as the middle."""
    rng = np.random.default_rng(2)
    valid = np.zeros((96, 96), bool)
    valid[8:40, 8:88] = valid[56:88, 20:60] = True
    light = np.where(valid[..., None], 2.0 * rng.gamma(2.0, 0.5, (96, 96, 3)), 0.0)
    result = denoise(filled(light, valid))
    assert _rmse(result[valid][None], np.full((1, 1, 3), 2.0)) < 0.2 * _rmse(
        light[valid][None], np.full((1, 1, 3), 2.0)
    )
    rim = valid & ~(np.roll(valid, 2, 0) & np.roll(valid, -2, 0) & np.roll(valid, 2, 1) & np.roll(valid, -2, 1))
    assert result[rim].mean() == pytest.approx(2.0, rel=0.05)


SIDES = st.integers(1, 9)


@settings(max_examples=60, deadline=None)
@given(arrays.arrays(bool, st.tuples(SIDES, SIDES)), st.integers(0, 2**16))
def test_filling_keeps_known_texels_and_stays_between_them(valid: np.ndarray, seed: int) -> None:
    light = np.random.default_rng(seed).uniform(1, 2, (*valid.shape, 3)).astype(np.float32)
    result = filled(light, valid)
    assert np.array_equal(result[valid], light[valid])
    if valid.any():
        tolerance = 1e-5
        assert (result >= light[valid].min(axis=0) - tolerance).all()
        assert (result <= light[valid].max(axis=0) + tolerance).all()
    else:
        assert not result.any()


def test_nothing_here_needs_more_than_the_render_extra() -> None:
    """What the code imports is what pyproject's extra installs."""
    import tomllib

    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    assert any(line.startswith("mitsuba-oidn") for line in project["project"]["optional-dependencies"]["render"])

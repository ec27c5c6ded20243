"""Estimates of noise: unbiased, with an honest error of their own; amounts; samples on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dnrpipe.core.units import parse_seconds, parse_share
from dnrpipe.raytrace.noise import GROUPS, denoised_error, group_noise, half_noise
from dnrpipe.raytrace.samples import Facts, Samples, read_facts, read_samples
from dnrpipe.raytrace.statistics import display

SIDE = 48


def _truth() -> np.ndarray:
    """A picture with dark and bright parts, in and out of the straight part of the curve, with an edge of alpha."""
    rows, columns = np.mgrid[0:SIDE, 0:SIDE] / SIDE
    picture = np.stack(
        [0.05 + 0.6 * rows, 0.1 + 0.5 * columns, 0.2 + 0.3 * rows * columns, np.ones_like(rows)], axis=-1
    )
    picture[:, : SIDE // 4] = 0.0
    return picture


def _groups(rng: np.random.Generator, size: float, count: int = GROUPS) -> np.ndarray:
    """Gaussian noise that grows with the light, as that of path tracing does."""
    truth = _truth()
    noise = rng.normal(0, size, (count, *truth.shape)) * (truth + 0.01) * truth[..., 3:]
    noise[..., 3] = 0
    return truth + noise


def _true_error(groups: np.ndarray) -> float:
    difference = display(groups.mean(axis=0)) - display(_truth())
    return float(np.sqrt(np.mean(difference**2)))


def test_the_estimate_is_unbiased_and_its_error_is_its_scatter() -> None:
    """t-test over seeds on mean squares, where unbiasedness is defined; scatter of the estimate against its error."""
    rng = np.random.default_rng(1)
    rows = []
    for _ in range(60):
        groups = _groups(rng, 0.15)
        noise = group_noise(groups)
        rows.append((noise.rmse**2, _true_error(groups) ** 2, noise.relative, noise.error))
    estimated, true, relative, error = np.array(rows).T
    difference = estimated - true
    t = difference.mean() / (difference.std(ddof=1) / np.sqrt(len(rows)))
    assert abs(t) < 3.5
    assert estimated.mean() == pytest.approx(true.mean(), rel=0.02)
    assert error.mean() == pytest.approx(relative.std(ddof=1), rel=0.35)


def test_half_buffers_agree_with_the_groups_and_their_error_is_a_bound() -> None:
    rng = np.random.default_rng(2)
    halves = [half_noise(*_groups(rng, 0.1, 2)) for _ in range(40)]
    many = [group_noise(_groups(rng, 0.2)) for _ in range(40)]  # eight groups at 0.2 are as noisy as two at 0.1
    assert np.mean([n.rmse for n in halves]) == pytest.approx(np.mean([n.rmse for n in many]), rel=0.02)
    assert np.mean([n.error for n in halves]) > np.std([n.relative for n in halves], ddof=1)


def test_single_bright_samples_in_the_dark() -> None:
    """Rare bright samples: two halves see half of the error, eight groups nearly all of it."""
    rng = np.random.default_rng(3)
    two, eight, true = [], [], []
    for _ in range(20):
        groups = np.tile([0.0, 0.0, 0.0, 1.0], (GROUPS, SIDE, SIDE, 1))
        groups[..., :3] += np.where(rng.random((GROUPS, SIDE, SIDE, 1)) < 0.002, 2.0, 0.0)
        mean = np.array([0.004, 0.004, 0.004, 1.0])
        true.append(np.sqrt(np.mean((display(groups.mean(axis=0)) - display(mean)) ** 2)))
        two.append(half_noise(groups[::2].mean(axis=0), groups[1::2].mean(axis=0)).rmse)
        eight.append(group_noise(groups).rmse)
    assert np.mean(two) < 0.75 * np.mean(true)
    assert np.mean(eight) == pytest.approx(np.mean(true), rel=0.15)


def test_no_noise_is_none_and_bad_shapes_are_refused() -> None:
    still = np.stack([_truth()] * GROUPS)
    assert group_noise(still).relative < 1e-12
    assert half_noise(still[0], still[1]).relative == 0
    for shape in ((3, 8, 8, 4), (2, 8, 8, 4), (8, 8, 8, 3), (8, 8, 4)):
        with pytest.raises(ValueError, match="groups: has shape"):
            group_noise(np.zeros(shape))


def test_the_error_of_a_denoiser_is_found_without_a_reference() -> None:
    """A "denoiser" that darkens by 3% and leaves some noise: its whole error, though the other samples are noisy."""
    rng = np.random.default_rng(4)
    found, true = [], []
    for _ in range(40):
        groups = _groups(rng, 0.2)
        denoised = _truth() * [0.97, 0.97, 0.97, 1.0] + 0.1 * (groups[::2].mean(axis=0) - _truth())
        mean, error = denoised_error(denoised, groups[1::2])
        found.append((mean, error))
        true.append(np.mean((display(denoised) - display(_truth())) ** 2))
    means, errors = np.array(found).T
    assert abs(means.mean() - np.mean(true)) < 4 * means.std(ddof=1) / np.sqrt(len(means)) + 0.05 * np.mean(true)
    assert 0.5 * means.std(ddof=1) < errors.mean() < 3 * means.std(ddof=1)


def test_samples_add_up_and_survive_the_disk(tmp_path: Path) -> None:
    """Any way of cutting samples into passes has the same mean; a torn or foreign file counts as none."""
    rng = np.random.default_rng(5)
    parts = rng.random((3, GROUPS, 6, 5, 4))
    path = tmp_path / "deep" / "0001.npz"
    samples = read_samples(path, "print", 6, 5)
    sizes = (8, 24, 16)
    for part, size in zip(parts, sizes, strict=True):
        samples = read_samples(path, "print", 6, 5)
        samples.add(part, size)
        samples.save(path)
    whole = np.average(parts, axis=0, weights=sizes)
    found = read_samples(path, "print", 6, 5)
    assert np.allclose(found.groups, whole, atol=1e-6)
    assert np.array_equal(found.groups, samples.groups)  # what is in memory is what is on disk
    assert (found.facts.spp, found.facts.passes) == (48, 3)
    assert np.allclose(np.mean(found.halves, axis=0), found.mean)
    assert read_facts(path, "other") == Facts("other")
    assert read_samples(path, "print", 6, 6).facts.spp == 0
    path.write_bytes(path.read_bytes()[:-200])
    assert read_facts(path, "print") == Facts("print")
    assert isinstance(read_samples(path, "print", 6, 5), Samples)


@given(st.floats(1e-6, 0.99))
def test_shares_are_read_as_percent_and_as_fraction(share: float) -> None:
    assert parse_share(f"{100 * share:.9f}%") == pytest.approx(share, rel=1e-2, abs=1e-10)
    assert parse_share(repr(float(f"{share:.9f}"))) == pytest.approx(share, rel=1e-2, abs=1e-9)


@given(st.integers(0, 99), st.integers(0, 99), st.integers(1, 99))
def test_times_are_sums_of_their_parts(hours: int, minutes: int, seconds: int) -> None:
    assert parse_seconds(f"{hours}h{minutes}m{seconds}s") == 3600 * hours + 60 * minutes + seconds
    assert parse_seconds(f"{minutes}min {seconds} s") == 60 * minutes + seconds


@pytest.mark.parametrize("text", ["0", "0%", "100%", "1", "-1%", "%", "x", "", "nan", "1%%", "1 percent"])
def test_what_is_no_share_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected a share"):
        parse_share(text)


@pytest.mark.parametrize("text", ["0", "0s", "-5s", "s", "x", "", "10 minutes", "1m1h", "nan", "inf"])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected a time"):
        parse_seconds(text)

"""What candidates see: cells, pixels, directions, duplicates; what a selection leaves uncovered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import synthetic

from dnrtrain.contract import ContractError, View
from dnrtrain.selector.explain import coverage_of, sentences
from dnrtrain.selector.geometry import direction_bins
from dnrtrain.selector.visibility import SurfaceVisibility, collect, look_at, read_visibility

SIDE, GRID = 24, 16


def visibility_of(views: list[View], grid: int = GRID) -> SurfaceVisibility:
    return collect((look_at(synthetic.gbuffer(view), view, grid) for view in views), grid)


@pytest.fixture(scope="module")
def views() -> list[View]:
    return synthetic.dome(8, SIDE)


@pytest.fixture(scope="module")
def seen(views: list[View]) -> SurfaceVisibility:
    return visibility_of(views)


def test_cells_pixels_and_directions(views: list[View], seen: SurfaceVisibility) -> None:
    """Against a loop over pixels, and the true position of the surface."""
    view, channels = views[3], synthetic.gbuffer(views[3])
    expected: dict[int, list[np.ndarray]] = {}
    for y, x in np.argwhere(channels["mask"] > 0):
        place = np.array([channels[f"position.{axis}"][y, x] for axis in "XYZ"])
        towards = view.position - place
        cell = int(channels["uv.V"][y, x] * GRID) * GRID + int(channels["uv.U"][y, x] * GRID)
        expected.setdefault(cell, []).append(towards / np.linalg.norm(towards))
    part = seen.of(3)
    assert seen.cells[part].tolist() == sorted(expected)
    for cell, pixels, view_directions in zip(
        seen.cells[part], seen.pixels[part], seen.view_directions[part], strict=True
    ):
        mean = np.mean(expected[int(cell)], axis=0)
        assert pixels * SIDE * SIDE == pytest.approx(len(expected[int(cell)]))
        assert np.allclose(view_directions, mean / np.linalg.norm(mean), atol=1e-4)
    assert seen.seen[3] == pytest.approx((channels["mask"] > 0).mean())
    assert seen.seen[3] == pytest.approx(seen.pixels[part].sum(), rel=1e-5)


def test_files_are_read_one_by_one_and_give_the_same(
    views: list[View], seen: SurfaceVisibility, tmp_path: Path
) -> None:
    files, _ = synthetic.write_scene(tmp_path, views)
    ticks: list[int] = []
    read = read_visibility(files, views, grid=GRID, tick=lambda: ticks.append(1))
    assert len(ticks) == len(views)
    assert read.cells.tolist() == seen.cells.tolist() and np.allclose(read.pixels, seen.pixels)
    with pytest.raises(ContractError, match="must agree"):
        read_visibility(files[1:], views)
    with pytest.raises(ContractError, match="its camera 48x24"):
        read_visibility(files[:1], [views[0].model_copy(update={"width": 48})])


def test_large_images_are_thinned_out() -> None:
    small, large = synthetic.dome(1, 200)[0], synthetic.dome(1, 600)[0]
    hits = [synthetic.intersect(np.broadcast_to(v.position, (*v.ray_directions().shape[:2], 3)), v.ray_directions())
            for v in (small, large)]  # fmt: skip
    maps = [{"mask": hit.mask * 1.0, "uv.U": hit.uv[..., 0], "uv.V": hit.uv[..., 1]} for hit in hits]
    ones = [look_at(channels, view, GRID) for channels, view in zip(maps, (small, large), strict=True)]
    assert ones[0].seen == pytest.approx(ones[1].seen, abs=0.01)
    common = np.intersect1d(ones[0].cells, ones[1].cells)
    assert len(common) > 0.9 * len(ones[0].cells)
    shares = [one.pixels[np.isin(one.cells, common)] for one in ones]
    assert np.abs(shares[0] - shares[1]).max() < 2e-3


def test_pictures_tell_duplicates(views: list[View]) -> None:
    found = visibility_of([views[0], views[1], views[0].model_copy(update={"name": "again"})])
    assert found.pictures[0] == found.pictures[2] != found.pictures[1]


def test_a_view_that_sees_nothing(views: list[View]) -> None:
    away = synthetic.look_at(views[0].position, SIDE, "away")
    matrix = away.matrix.copy()
    matrix[:3, [0, 2]] *= -1.0  # turned about its own up axis
    away = away.model_copy(update={"c2w": tuple(tuple(float(v) for v in row) for row in matrix)})
    found = visibility_of([views[0], away])
    assert found.seen[1] == 0.0 and found.of(1).start == found.of(1).stop
    coverage = coverage_of(found, [1, 0])
    assert coverage.uncovered[0] == pytest.approx(1.0)
    assert coverage.uncovered[1] == pytest.approx(0.0, abs=1e-6)
    assert "sees nothing new" in sentences(coverage)[0] and "100.0%" in sentences(coverage)[1]


def test_taking_views_takes_what_they_see(seen: SurfaceVisibility) -> None:
    order = np.array([5, 0, 5])
    taken = seen.take(order)
    for place, view in enumerate(order):
        assert taken.cells[taken.of(place)].tolist() == seen.cells[seen.of(view)].tolist()
        assert np.array_equal(taken.view_directions[taken.of(place)], seen.view_directions[seen.of(view)])
    assert taken.pictures.tolist() == seen.pictures[order].tolist()


def test_directions_cover_the_sphere() -> None:
    axes, random = direction_bins(), np.random.default_rng(0).normal(size=(2000, 3))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    assert np.allclose(np.linalg.norm(axes, axis=1), 1.0, atol=1e-6)
    assert np.degrees(np.arccos((random @ axes.T).max(axis=1))).max() < 35


def test_coverage_against_a_loop(seen: SurfaceVisibility) -> None:
    """Shares and angles as a loop over all visibility of all candidates finds them."""
    chosen = [4, 1]
    best: dict[int, list[np.ndarray]] = {}
    for view in chosen:
        for cell, view_directions in zip(seen.cells[seen.of(view)], seen.view_directions[seen.of(view)], strict=True):
            best.setdefault(int(cell), []).append(view_directions)
    missed, angle, covered = 0.0, 0.0, 0.0
    for cell, pixels, view_directions in zip(seen.cells, seen.pixels, seen.view_directions, strict=True):
        if int(cell) not in best:
            missed += float(pixels)
            continue
        covered += float(pixels)
        cosine = max(float(other @ view_directions) for other in best[int(cell)])
        angle += float(pixels) * np.degrees(np.arccos(min(1.0, cosine)))
    coverage = coverage_of(seen, chosen)
    assert coverage.uncovered[-1] == pytest.approx(missed / (missed + covered), abs=1e-5)
    assert coverage.angles[-1] == pytest.approx(angle / covered, abs=0.05)
    assert coverage.uncovered == sorted(coverage.uncovered, reverse=True)
    whole = coverage_of(seen, range(len(seen)))
    assert whole.uncovered[-1] == pytest.approx(0.0, abs=1e-6) and whole.angles[-1] == pytest.approx(0.0, abs=0.05)

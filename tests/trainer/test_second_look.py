"""A second look: expected errors from traced views, and views that go where they are."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import synthetic
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import Scene
from dnrtrain.contract import ContractError
from dnrtrain.dataset import ViewSet
from dnrtrain.selector.demand import demand_of, service
from dnrtrain.selector.exchange import second_look
from dnrtrain.selector.protocol import Candidates
from dnrtrain.selector.remaining import CellErrors, cell_errors, cells_of, residuals
from dnrtrain.selector.sightings import collect, look_at

SIDE, GRID = 16, 8


@pytest.fixture(scope="module")
def pool() -> Candidates:
    """12 views on a dome; 12 repeats 0."""
    dome = synthetic.dome(12, SIDE)
    views = [*dome, dome[0]]
    return Candidates(
        np.stack([view.position for view in views]),
        np.stack([-view.matrix[:3, 2] for view in views]),
        collect((look_at(synthetic.gbuffer(view), view, GRID) for view in views), GRID),
    )


def even(value: float = 1.0) -> CellErrors:
    return CellErrors(GRID, value, np.full(GRID * GRID, value))


def with_target(views: ViewSet, target: torch.Tensor) -> ViewSet:
    return dataclasses.replace(views, tensors=dataclasses.replace(views.tensors, target=target))


def test_cells_are_those_of_the_sightings(scene: Scene) -> None:
    """The same pixels in the same cells as the selectors see them."""
    cells = cells_of(scene.traced, GRID)
    for index, view in enumerate(synthetic.dome(len(scene.traced), scene.traced.size[0])):
        seen = look_at(synthetic.gbuffer(view), view, GRID)
        found, count = np.unique(cells[index][cells[index] >= 0], return_counts=True)
        assert found.tolist() == seen.cells.tolist()
        assert count / cells[index].size == pytest.approx(seen.pixels)


def test_what_is_wrong_alike_from_everywhere_is_learned(scene: Scene) -> None:
    """Constant residuals are left out but for κ; residuals of one view's own stay."""
    views = scene.traced
    tensors = views.tensors
    assert tensors.target is not None
    size, hit = len(views), tensors.mask.expand_as(tensors.target)
    constant = cell_errors(with_target(views, 0.5 * hit), GRID)
    flicker = 0.5 * hit * torch.tensor([1.0, -1.0] * size)[:size].view(-1, 1, 1, 1)
    changing = cell_errors(with_target(views, flicker), GRID)
    assert constant.mean < 0.05 * 0.25 < 0.25 < changing.mean
    assert cell_errors(with_target(views, 0.0 * hit), GRID).mean == 0.0
    with pytest.raises(ContractError, match="without targets"):
        residuals(dataclasses.replace(views, tensors=dataclasses.replace(tensors, target=None)))


def test_errors_stand_where_the_highlight_is(scene: Scene) -> None:
    """A raster base leaves shadow and highlight: the sphere's lit side is worse than the mean."""
    errors = cell_errors(scene.traced, GRID)
    seen = np.unique(cells_of(scene.traced, GRID))[1:]
    assert errors.mean > 0 and errors.relative(seen).max() > 1.5 > 0.5 > errors.relative(seen).min()


@given(st.lists(st.integers(0, 12), min_size=1, max_size=6, unique=True), st.integers(1, 6), st.permutations(range(13)))
@settings(max_examples=30, deadline=None)
def test_it_completes_what_is_kept(pool: Candidates, kept: list[int], more: int, order: list[int]) -> None:
    """New views only, no duplicate of a kept one, the same for any order of the candidates."""
    choice = second_look(pool, kept, len(kept) + more, even())
    assert len(set(choice.views)) == len(choice.views) == len(choice.gains) == len(choice.why) == more
    assert not set(choice.views) & set(kept)
    if more + len(kept) <= 11:
        assert len({view % 12 for view in [*kept, *choice.views]}) == more + len({view % 12 for view in kept})
    left = choice.details["remaining_error"]
    assert len(left) == more + 1 and all(a >= b - 1e-9 for a, b in itertools.pairwise(left))
    place = np.argsort(order)
    shuffled = second_look(pool.take(np.array(order)), [int(place[view]) for view in kept], len(kept) + more, even())
    assert [order[view] % 12 for view in shuffled.views] == [view % 12 for view in choice.views]


def test_errors_attract(pool: Candidates) -> None:
    """All error in what one view alone serves best: that view is next."""
    sightings = pool.sightings
    assert sightings is not None
    demand = demand_of(sightings)
    kept, hits = [0], 0
    for wanted in range(1, 12):
        cells = np.full(GRID * GRID, 1e-6)
        lead = service(sightings, demand, wanted) - np.max(
            [service(sightings, demand, view) for view in range(12) if view != wanted], axis=0
        )
        cells[demand.cells[lead > 0.1]] = 1.0
        if (lead > 0.1).any():
            errors = CellErrors(GRID, float(cells.mean()), cells)
            plain, drawn = (second_look(pool, kept, 2, found) for found in (even(), errors))

            def served(view: int, errors: CellErrors = errors) -> float:
                return float(service(sightings, demand, view) @ errors.reweighted(demand).weights)

            assert served(drawn.views[0]) >= served(plain.views[0]) - 1e-6
            hits += drawn.views != plain.views
    assert hits


def test_nonsense_is_refused(pool: Candidates) -> None:
    for kept, budget in (([], 3), ([0, 1], 2)):
        with pytest.raises(ContractError, match="second look"):
            second_look(pool, kept, budget, even())
    with pytest.raises(ContractError, match="choose 1 to 13"):
        second_look(pool, [0], 14, even())
    with pytest.raises(ContractError, match="second look"):
        second_look(Candidates(pool.positions, pool.directions), [0], 3, even())

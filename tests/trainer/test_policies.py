"""Policies that need no training: what each optimises, and what all of them promise."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import synthetic
from hypothesis import given, settings
from hypothesis import strategies as st

from dnrtrain.contract import ContractError, View
from dnrtrain.selector.greedy import lazy_greedy
from dnrtrain.selector.medoids import Facilities, KMedoidsPolicy, build, camera_problem, swap
from dnrtrain.selector.names import NAMES, TRAINED_NAMES, UNTRAINED_NAMES
from dnrtrain.selector.policies import UNTRAINED, untrained
from dnrtrain.selector.protocol import Candidates
from dnrtrain.selector.visibility import SurfaceVisibility, collect, look_at

SIDE, GRID = 16, 8
DETERMINISTIC = ("auto", "coverage", "kmedoids")


def turned_away(view: View) -> View:
    matrix = view.matrix.copy()
    matrix[:3, [0, 2]] *= -1.0
    return view.model_copy(update={"c2w": tuple(tuple(float(v) for v in row) for row in matrix)})


def candidates_of(views: list[View]) -> Candidates:
    return Candidates(
        np.stack([view.position for view in views]),
        np.stack([-view.matrix[:3, 2] for view in views]),
        collect((look_at(synthetic.gbuffer(view), view, GRID) for view in views), GRID),
    )


@pytest.fixture(scope="module")
def pool() -> Candidates:
    """12 views on a dome; 12 and 13 repeat 0 and 5; 14 and 15 see nothing."""
    dome = synthetic.dome(12, SIDE)
    return candidates_of([*dome, dome[0], dome[5], turned_away(dome[1]), turned_away(dome[2])])


TWIN = {12: 0, 13: 5}


def kinds(views: list[int]) -> set[int]:
    return {TWIN.get(view, view) for view in views}


def test_every_name_has_its_policy() -> None:
    assert tuple(UNTRAINED) == UNTRAINED_NAMES
    assert all(untrained(name) is None for name in TRAINED_NAMES)
    assert set(NAMES) == {*UNTRAINED_NAMES, *TRAINED_NAMES}
    with pytest.raises(ContractError, match=r"unknown policy .best.*auto"):
        untrained("best")


@given(st.sampled_from(UNTRAINED_NAMES), st.integers(1, 16), st.integers(0, 5))
@settings(max_examples=60, deadline=None)
def test_distinct_views_and_a_reason_for_each(pool: Candidates, name: str, budget: int, seed: int) -> None:
    choice = UNTRAINED[name].choose(pool, budget, seed)
    assert len(choice.views) == len(set(choice.views)) == len(choice.gains) == len(choice.why) == budget
    assert set(choice.views) <= set(range(16)) and all(choice.why)
    assert np.isfinite(choice.gains).all() and min(choice.gains) >= 0
    again = UNTRAINED[name].choose(pool, budget, seed)
    assert again == choice


@pytest.mark.parametrize("name", UNTRAINED_NAMES)
def test_progress_is_told_where_there_is_work(pool: Candidates, name: str) -> None:
    weighed: list[int] = []
    UNTRAINED[name].choose(pool, 5, 0, weighed.append)
    assert (sum(weighed) >= 12) == (UNTRAINED[name].effort > 0)


@pytest.mark.parametrize("name", UNTRAINED_NAMES)
def test_budgets_out_of_range_are_refused(pool: Candidates, name: str) -> None:
    for budget in (0, 17):
        with pytest.raises(ContractError, match="choose 1 to 16"):
            UNTRAINED[name].choose(pool, budget, 0)


@given(st.sampled_from(DETERMINISTIC), st.integers(1, 16), st.permutations(range(16)), st.integers(0, 3))
@settings(max_examples=60, deadline=None)
def test_order_and_seed_do_not_matter(pool: Candidates, name: str, budget: int, order: list[int], seed: int) -> None:
    """The same set, in the same order of choice; of duplicates either."""
    straight = UNTRAINED[name].choose(pool, budget, 0)
    shuffled = UNTRAINED[name].choose(pool.take(np.array(order)), budget, seed)
    found = [order[view] for view in shuffled.views]
    assert [TWIN.get(view, view) for view in found] == [TWIN.get(view, view) for view in straight.views]
    assert shuffled.gains == straight.gains


@pytest.mark.parametrize("name", DETERMINISTIC)
def test_duplicates_and_empty_views_come_last(pool: Candidates, name: str) -> None:
    for budget in range(1, 17):
        views = UNTRAINED[name].choose(pool, budget, 0).views
        assert len(kinds(views)) == max(min(budget, 12), budget - 2)
        assert not {14, 15} & set(views[:14])
    whole = UNTRAINED[name].choose(pool, 16, 0)
    assert set(whole.views) == set(range(16))
    assert whole.why[12] == whole.why[13] == "a duplicate: all else was chosen"
    assert (whole.details["duplicates"], whole.details["see_nothing"]) == (2, 2)


@pytest.mark.parametrize("name", DETERMINISTIC)
def test_pools_that_see_nothing_or_are_all_the_same(name: str) -> None:
    view = synthetic.dome(1, SIDE)[0]
    same = candidates_of([view] * 4)
    assert sorted(UNTRAINED[name].choose(same, 4, 0).views) == [0, 1, 2, 3]
    empty = candidates_of([turned_away(v) for v in synthetic.dome(5, SIDE)])
    assert len(set(UNTRAINED[name].choose(empty, 3, 0).views)) == 3


def test_without_surface_visibility(pool: Candidates) -> None:
    poses = Candidates(pool.positions, pool.directions)
    assert len(set(UNTRAINED["kmedoids"].choose(poses, 4, 0).views)) == 4
    with pytest.raises(ContractError, match="'coverage' needs the surface visibility"):
        UNTRAINED["coverage"].choose(poses, 4, 0)


def cameras_at_random(seed: int, count: int) -> Facilities:
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return camera_problem(Candidates(random.normal(size=(count, 3)), directions))


def test_k_medoids_is_close_to_the_best_of_all_subsets() -> None:
    ratios = []
    for seed in range(30):
        problem = cameras_at_random(seed, 9)
        best = min(problem.cost(subset) for subset in itertools.combinations(range(9), 3))
        ratios.append(problem.cost(swap(problem, build(problem, 3)[0])) / best)
    assert min(ratios) >= 1 - 1e-6 and np.mean(ratios) < 1.01


@given(st.integers(0, 1000), st.integers(4, 9), st.integers(1, 4))
@settings(max_examples=40, deadline=None)
def test_swaps_end_where_no_single_one_pays(seed: int, count: int, budget: int) -> None:
    """Never worse than BUILD; every exchange of one view, tried by itself, costs as much or more."""
    problem = cameras_at_random(seed, count)
    start, _ = build(problem, budget)
    found = swap(problem, start)
    cost = problem.cost(found)
    assert cost <= problem.cost(start) + 1e-6
    for out, into in itertools.product(range(budget), set(range(count)) - set(found)):
        other = [*found[:out], into, *found[out + 1 :]]
        assert problem.cost(other) >= cost * (1 - 1e-4) - 1e-6


def test_k_medoids_finds_the_clusters() -> None:
    random = np.random.default_rng(0)
    centres = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0]], float)
    positions = np.concatenate(
        [centre + 0.1 * random.normal(size=(n, 3)) for centre, n in zip(centres, (9, 4, 6), strict=True)]
    )
    choice = KMedoidsPolicy().choose(Candidates(positions, np.tile([0.0, 0.0, 1.0], (19, 1))), 3, 0)
    assert sorted((view >= 9) + (view >= 13) for view in choice.views) == [0, 1, 2]
    assert choice.gains == sorted(choice.gains, reverse=True)


@given(st.integers(0, 1000), st.integers(1, 6))
@settings(max_examples=40, deadline=None)
def test_lazy_greedy_is_greedy(seed: int, budget: int) -> None:
    sets = [set(s) for s in np.random.default_rng(seed).integers(0, 20, (8, 5)).tolist()]
    covered: set[int] = set()
    order, gains = lazy_greedy(8, budget, lambda i: float(len(sets[i] - covered)), lambda i: covered.update(sets[i]))
    known: set[int] = set()
    for element, gain in zip(order, gains, strict=True):
        free = [i for i in range(8) if i not in order[: order.index(element)]]
        assert gain == max(len(sets[i] - known) for i in free) == len(sets[element] - known)
        known |= sets[element]


def seen(cells: list[int], view_directions: tuple[float, float, float], picture: int) -> SurfaceVisibility:
    share = np.full(len(cells), 0.5 / len(cells), np.float32)
    towards = np.tile(np.array(view_directions, np.float32), (len(cells), 1))
    start, half = np.array([0, len(cells)]), np.array([0.5], np.float32)
    return SurfaceVisibility(
        GRID, start, np.array(cells, np.int32), share, towards, half, np.array([picture], np.uint64)
    )


def test_what_is_seen_counts_where_poses_say_nothing() -> None:
    """Four cameras around a block at corners of a square: three look at its front, one at its back."""
    looks = [seen([1, 2, 3], (1, 0, 0), 1), seen([1, 2, 3], (1, 0, 0.01), 2),
             seen([1, 2, 3], (1, 0.01, 0), 3), seen([4, 5, 6], (-1, 0, 0), 4)]  # fmt: skip
    corners = np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]], float)
    candidates = Candidates(corners, np.tile([0.0, 0.0, -1.0], (4, 1)), collect(looks, GRID))
    choice = UNTRAINED["coverage"].choose(candidates, 2, 0)
    assert 3 in choice.views
    assert choice.details["uncovered"] == pytest.approx(0.0, abs=1e-6)


def test_coverage_prefers_new_sides_to_more_of_the_same() -> None:
    looks = [seen([1, 2], (1, 0, 0), 1), seen([1, 2], (0.999, 0.0447, 0), 2), seen([1, 2], (-1, 0, 0), 3)]
    places = np.array([[1, 0, 0], [1, 0.1, 0], [-1, 0, 0]], float)
    candidates = Candidates(places, -places, collect(looks, GRID))
    choice = UNTRAINED["coverage"].choose(candidates, 3, 0)
    assert 2 in choice.views[:2] and choice.gains[2] < choice.gains[1]
    assert choice.details["coverage"] == pytest.approx(1.0)


def test_auto_is_the_rule_that_measured_best(pool: Candidates) -> None:
    assert UNTRAINED["auto"].choose(pool, 4, 0) == UNTRAINED["coverage"].choose(pool, 4, 0)

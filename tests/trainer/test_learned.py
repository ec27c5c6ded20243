"""The surrogate of texture training, and the selector that learns on it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dnrtrain import checkpoint
from dnrtrain.contract import ContractError
from dnrtrain.selector.doptimal import harmonics
from dnrtrain.selector.dqn import ValueNetwork, load_network, rollout, save_network, train
from dnrtrain.selector.environment import FEATURES, Environment, exchange, in_order
from dnrtrain.selector.learned import DqnPolicy
from dnrtrain.selector.names import SHIPPED_WEIGHTS
from dnrtrain.selector.protocol import Candidates
from dnrtrain.selector.sightings import collect, look_at
from dnrtrain.selector.surrogate import RIDGE, Surrogate

SIDE, GRID, COUNT = 16, 8, 14


@pytest.fixture(scope="module")
def pool() -> Candidates:
    """Views on a dome, with raster colour."""
    views = synthetic.dome(COUNT, SIDE)
    looks = (look_at({**synthetic.gbuffer(v), **synthetic.render(v, raytraced=True)}, v, GRID) for v in views)
    return Candidates(
        np.stack([view.position for view in views]),
        np.stack([-view.matrix[:3, 2] for view in views]),
        collect(looks, GRID),
    )


def surrogate_of(pool: Candidates) -> Surrogate:
    assert pool.sightings is not None
    return Surrogate(pool.sightings)


def by_hand(pool: Candidates, chosen: list[int]) -> float:
    """The definition, cell by cell, with numpy's solver."""
    s = pool.sightings
    assert s is not None
    pixels = s.pixels / np.median(s.pixels)
    colours = s.colours - (s.pixels @ s.colours) / s.pixels.sum()
    view = np.repeat(np.arange(len(s)), np.diff(s.start))
    prior = RIDGE * np.diag([0.1, *[1.0] * 8])
    error = 0.0
    for cell in np.unique(s.cells):
        there = s.cells == cell
        used = there & np.isin(view, chosen)
        h, p = harmonics(s.toward[used]).astype(float), pixels[used]
        weights = np.linalg.solve(prior + (h.T * p) @ h, (h.T * p) @ colours[used])
        wrong = np.square(harmonics(s.toward[there]) @ weights - colours[there]).mean(axis=1)
        share = pixels[there] / np.array([pixels[view == v].sum() for v in view[there]])
        error += float(wrong @ share) / len(s)
    return error


@given(st.lists(st.integers(0, COUNT - 1), max_size=6, unique=True))
@settings(max_examples=20, deadline=None)
def test_the_surrogate_is_ridge_regression(pool: Candidates, chosen: list[int]) -> None:
    surrogate = surrogate_of(pool)
    assert surrogate.run(chosen) == pytest.approx(by_hand(pool, chosen), rel=1e-5)
    assert surrogate.run(chosen[::-1]) == pytest.approx(by_hand(pool, chosen), rel=1e-5)
    assert float(surrogate.errors.mean()) == pytest.approx(surrogate.error, rel=1e-6)


@given(st.permutations(range(COUNT)))
@settings(max_examples=10, deadline=None)
def test_gains_are_exact_and_views_can_be_forgotten(pool: Candidates, order: list[int]) -> None:
    surrogate = surrogate_of(pool)
    for view in order[:5]:
        expected = surrogate.gain(view)
        assert surrogate.add(view) == pytest.approx(expected, abs=1e-12)
    before = surrogate.error
    surrogate.add(order[5])
    surrogate.remove(order[5])
    assert surrogate.error == pytest.approx(before, rel=1e-6) and surrogate.chosen == order[:5]


def test_all_views_teach_nearly_all(pool: Candidates) -> None:
    surrogate = surrogate_of(pool)
    nothing = surrogate.run([])
    assert surrogate.run(list(range(COUNT))) < 0.1 * nothing


def test_an_empty_pool_is_refused(pool: Candidates) -> None:
    nothing = collect([], GRID)
    with pytest.raises(ContractError, match="no candidate sees anything"):
        Surrogate(nothing)
    with pytest.raises(ContractError, match="needs the candidates' sightings"):
        Environment(Candidates(pool.positions, pool.directions), 3)


def test_features_tell_what_a_view_adds(pool: Candidates) -> None:
    environment = Environment(pool, 4)
    first = environment.features()
    assert first.shape == (COUNT, len(FEATURES)) and np.isfinite(first).all()
    name = {feature: index for index, feature in enumerate(FEATURES)}
    assert (first[:, name["unseen"]] == pytest.approx(1.0)) and not first[:, name["taken"]].any()
    reward = environment.step(3)
    after = environment.features()
    assert reward == pytest.approx(1.0 - environment.surrogate.error / environment.start)
    assert after[3, name["unseen"]] == 0.0 == after[3, name["distance"]]
    assert after[3, name["new error"]] < np.median(after[:, name["new error"]])
    assert after[:, name["taken"]] == pytest.approx(0.25)


def test_learning_lowers_the_error_and_repeats(pool: Candidates) -> None:
    """Against an untrained network's roll-out and the mean of random selections, on its own pool."""
    environment = Environment(pool, 4)
    trained, history = train([environment], episodes=30, seed=0)
    learned = environment.surrogate.run(rollout(environment, trained))
    random = [
        environment.surrogate.run([int(v) for v in np.random.default_rng(seed).permutation(COUNT)[:4]])
        for seed in range(20)
    ]
    assert learned < np.mean(random) and np.isfinite(history).all()
    again, _ = train([Environment(pool, 4)], episodes=30, seed=0)
    assert all(torch.equal(a, b) for a, b in zip(trained.parameters(), again.parameters(), strict=True))


def test_exchanges_never_hurt(pool: Candidates) -> None:
    environment = Environment(pool, 4)
    start = [0, 1, 2, 3]
    before = environment.surrogate.run(start)
    found = exchange(environment, start)
    assert len(set(found)) == 4 and environment.surrogate.run(found) < before
    environment.surrogate.reset()
    assert sorted(in_order(environment, found)) == sorted(found)


def test_the_guard_answers_the_best(pool: Candidates) -> None:
    details = DqnPolicy().choose(pool, 4, 0).details
    errors = details["guard"]["errors"]
    assert set(errors) == {"exchange", "exchange, improved", "kmedoids", "coverage", "learned"}
    assert errors[details["guard"]["chosen"]] == min(errors.values())
    assert details["remaining_error"][-1] == pytest.approx(min(errors.values()), rel=1e-6)


def test_large_pools_are_thinned(pool: Candidates, monkeypatch: pytest.MonkeyPatch) -> None:
    import dnrtrain.selector.learned as learned

    monkeypatch.setattr(learned, "POOL", 6)
    choice = DqnPolicy().choose(pool, 4, 0)
    assert len(set(choice.views)) == 4 and max(choice.views) < COUNT


def test_weights_are_kept_whole(tmp_path: Path) -> None:
    network = ValueNetwork(3)
    torch.nn.init.normal_(network.value.weight)
    save_network(tmp_path / "w.safetensors", network, {"scenes": ["a"]})
    read, info = load_network(tmp_path / "w.safetensors")
    probe = torch.rand(5, len(FEATURES))
    assert torch.equal(read(probe), network(probe)) and info["scenes"] == ["a"]
    for path, said in ((tmp_path / "none", "or damaged"), (SHIPPED_WEIGHTS.with_name("pool.py"), "damaged")):
        with pytest.raises(ContractError, match=said):
            load_network(path)
    checkpoint.save(tmp_path / "old.safetensors", network.state_dict(), {"features": ["age"]})
    with pytest.raises(ContractError, match="other features"):
        load_network(tmp_path / "old.safetensors")

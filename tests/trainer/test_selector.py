"""Selection: baselines, masking, TD targets, and that the agent can learn."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dnrtrain.contract import ContractError
from dnrtrain.selector.agent import (
    RewardScale,
    best_action,
    epsilon_at,
    epsilon_greedy,
    follow,
    reward_of,
    td_target,
)
from dnrtrain.selector.policies import UNTRAINED, FarthestPolicy
from dnrtrain.selector.protocol import Candidates
from dnrtrain.selector.qnetwork import QNetwork


def ring(count: int) -> Candidates:
    angle = 2 * np.pi * np.arange(count) / count
    positions = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], 1)
    return Candidates(positions, -positions)


@pytest.mark.parametrize("name", ["random", "farthest"])
def test_baselines_choose_distinct_views_by_seed(name: str) -> None:
    policy = UNTRAINED[name]
    for budget in (1, 7, 20):
        chosen = policy.choose(ring(20), budget, seed=3).views
        assert len(chosen) == len(set(chosen)) == budget and set(chosen) <= set(range(20))
        assert chosen == policy.choose(ring(20), budget, seed=3).views
    assert len({tuple(policy.choose(ring(20), 5, seed).views) for seed in range(8)}) > 1
    for budget in (0, 21):
        with pytest.raises(ContractError, match="budget"):
            policy.choose(ring(20), budget, seed=0)


def test_farthest_spreads() -> None:
    chosen = sorted(FarthestPolicy().choose(ring(16), 4, seed=5).views)
    assert np.diff(chosen).tolist() == [4, 4, 4]


def test_farthest_tells_directions_apart_and_survives_coincident_cameras() -> None:
    place = np.zeros((6, 3))
    directions = np.eye(3)[[0, 0, 0, 1, 1, 2]]
    chosen = FarthestPolicy().choose(Candidates(place, directions), 3, seed=0).views
    assert len({tuple(directions[i]) for i in chosen}) == 3
    assert sorted(FarthestPolicy().choose(Candidates(place, directions), 6, seed=0).views) == list(range(6))


def test_actions_are_masked_in_the_random_draw_and_in_the_maximum() -> None:
    values = torch.tensor([5.0, 4.0, 3.0, 2.0])
    selected = torch.tensor([True, False, True, False])
    assert best_action(values, selected) == 1
    random = np.random.default_rng(0)
    drawn = {epsilon_greedy(values, selected, 1.0, random) for _ in range(50)}
    assert drawn == {1, 3}
    assert {epsilon_greedy(values, selected, 0.0, random) for _ in range(20)} == {1}


class FixedValues(torch.nn.Module):
    def __init__(self, values: list[float]) -> None:
        super().__init__()
        self.values = torch.tensor(values)

    def forward(self, selected: torch.Tensor, observation: torch.Tensor) -> torch.Tensor:
        return self.values


def test_td_target() -> None:
    """Equation 3: r + γ max over unselected actions; the reward alone at the end."""
    selected = torch.tensor([True, False, False])
    fast, slow = FixedValues([9.0, 1.0, 2.0]), FixedValues([7.0, 4.0, 3.0])
    nothing = torch.zeros(0)
    target = td_target(fast, slow, 0.5, 0.9, selected, nothing, False)  # type: ignore[arg-type]
    assert target == pytest.approx(0.5 + 0.9 * 3.0)
    assert td_target(fast, slow, 0.5, 0.9, selected, nothing, True) == 0.5  # type: ignore[arg-type]


def test_epsilon_decays_from_start_to_end() -> None:
    values = [epsilon_at(epoch, 10, 0.9, 0.05) for epoch in range(10)]
    assert values[0] == pytest.approx(0.9) and values[-1] == pytest.approx(0.05)
    assert values == sorted(values, reverse=True)
    assert epsilon_at(0, 1, 0.9, 0.05) == pytest.approx(0.05)


def test_rewards() -> None:
    scale = RewardScale()
    assert scale.reward(0.4) == 0.0 and scale.mean == pytest.approx(0.4)
    assert scale.reward(0.2) == pytest.approx(0.5) and scale.mean == pytest.approx(0.39)
    assert scale.reward(float("nan")) == 0.0 and scale.mean == pytest.approx(0.39)
    assert reward_of("neg-loss", 0.5, None, None) == 0.5 and reward_of("pos-loss", 0.5, None, None) == -0.5
    assert reward_of("improvement", 0.0, 0.4, 0.3) == pytest.approx(0.25)


def test_observation_is_detached_and_embeddings_are_averaged() -> None:
    network = QNetwork(views=5, channels=16, embedding=8, seed=0)
    texture = torch.rand(1, 16, 100, 40, requires_grad=True)
    observation = network.encode(texture)
    assert observation.shape == (1, 16, 64, 40) and not observation.requires_grad
    with torch.no_grad():
        network.value.weight.normal_()
        both = torch.tensor([True, True, False, False, False])
        before = network(both, observation)
        mean = network.camera[:2].mean(0).clone()
        network.camera[:2] = mean
        assert torch.allclose(network(both, observation), before, atol=1e-5)
        assert not torch.allclose(network(torch.tensor([False, False, True, True, False]), observation), before)


def test_the_slow_network_follows() -> None:
    network, slow = (QNetwork(4, 16, 8, seed) for seed in (0, 1))
    gap = (slow.camera - network.camera).abs().max()
    follow(slow, network, keep=0.5)
    assert torch.allclose((slow.camera - network.camera).abs().max(), gap / 2, atol=1e-5)


def test_the_agent_learns_which_views_pay() -> None:
    """A bandit in the selector's clothes: views 3 and 7 are rewarded; after training both are chosen."""
    views, budget = 10, 3
    network, slow = (QNetwork(views, 12, 16, seed=0) for _ in range(2))
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    random = np.random.default_rng(0)
    observation = torch.zeros(1, 12, 8, 8)
    for episode in range(300):
        selected = torch.zeros(views, dtype=torch.bool)
        selected[int(random.integers(views))] = True
        for taken in range(1, budget):
            values = network(selected, observation)
            action = epsilon_greedy(values.detach(), selected, max(0.1, 1 - episode / 150), random)
            selected = selected.clone()
            selected[action] = True
            reward = 1.0 if action in (3, 7) else 0.0
            target = td_target(network, slow, reward, 0.9, selected, observation, taken == budget - 1)
            loss = (values[action] - target).square()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            follow(slow, network)
    for first in (0, 5, 9):
        selected = torch.zeros(views, dtype=torch.bool)
        selected[first] = True
        for _ in range(2):
            action = best_action(network(selected, observation).detach(), selected)
            selected[action] = True
        assert bool(selected[3]) and bool(selected[7])

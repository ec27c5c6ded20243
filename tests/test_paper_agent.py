"""The agent of row `paper` on a bandit: it learns which views pay, and its divergence is noticed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from dnrpipe.core.settings import resolve
from dnrpipe.studies.ablation.rows import ROWS, settings_of
from dnrtrain.schedule import EpochBook, adam, guarded_step, learning_rate
from dnrtrain.selector.protocol import Candidates
from dnrtrain.settings import Step1Settings
from dnrtrain.walker import Walker


def paper_step1(**changes: Any) -> Step1Settings:
    settings = settings_of(ROWS["paper"], resolve("paper-128", {}, environment={}), {})
    return settings.select.step1.model_copy(update=changes)


def walked(losses: np.ndarray, budget: int, settings: Step1Settings) -> Iterator[tuple[Walker, list[int]]]:
    """Epoch by epoch: the agent, and what it would choose, where each view always has its own loss and its own T."""
    count = len(losses)
    random = np.random.default_rng(1)
    textures = torch.from_numpy(random.normal(0, 0.1, (count, 1, 16, 4, 4)).astype(np.float32))
    positions = random.normal(size=(count, 3))
    walker = Walker(Candidates(positions, -positions), 16, settings, budget=budget, seed=0, device="cpu")
    optimiser = adam([walker.agent], settings.learning_rate, "cpu")
    episodes = -(-count // budget)
    taken = 0

    def look(view: int) -> tuple[Tensor, Tensor]:
        return torch.tensor(losses[view]), textures[view]

    def step(loss: Tensor) -> bool:
        nonlocal taken
        steps = settings.epochs * episodes * budget
        rate = learning_rate(taken, steps, settings.learning_rate, settings.learning_rate_end)
        taken += 1
        return guarded_step(optimiser, loss, rate) if loss.requires_grad else True  # of the renderer alone: no weights

    for epoch in range(settings.epochs):
        book = EpochBook()
        for episode in range(episodes):
            walker.episode(epoch, episode, look, step, book)
        yield walker, walker.roll_out(look).views


@pytest.mark.parametrize(("count", "level"), [(40, 0.0005), (100, 0.0108)])
def test_it_goes_most_of_the_way_from_random_views_to_the_best(count: int, level: float) -> None:
    """At the row's own schedule, 25 of 40 and 25 of 100; at the losses of an early and of a late renderer."""
    losses = level * np.random.default_rng(count).lognormal(0.0, 0.45, count)
    chosen: list[int] = []
    for walker, views in walked(losses, 25, paper_step1()):
        assert walker.trouble() is None
        chosen = views
    best = np.sort(losses)[:25].mean()
    share = (losses.mean() - losses[chosen].mean()) / (losses.mean() - best)
    print(f"25 of {count}: random {losses.mean():.5f}, best {best:.5f}, agent {losses[chosen].mean():.5f}: {share:.0%}")
    assert share >= 0.7


def test_values_that_overshoot_are_no_divergence() -> None:
    walker, _ = next(walked(np.full(40, 0.01), 25, paper_step1(epochs=1)))
    allowed = walker.largest_reward * sum(walker.settings.gamma**k for k in range(24))
    for share, diverged in ((10.0, False), (100.0, True)):
        walker.largest_value = share * allowed
        assert (walker.trouble() is not None) == diverged


def test_values_beyond_what_rewards_allow_are_divergence() -> None:
    """Without discount the maximum feeds on its own errors, and the values leave any range."""
    losses = 0.01 * np.random.default_rng(0).lognormal(0.0, 0.45, 40)
    settings = paper_step1(gamma=1.0, learning_rate=0.05, learning_rate_end=0.05, epochs=6)
    found = [walker.trouble() for walker, _ in walked(losses, 25, settings)]
    said = next(text for text in found if text)
    assert "values reach" in said and "allow" in said

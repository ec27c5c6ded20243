"""Q-learning on top of the Q-network: ε-greedy actions, TD targets, rewards. No training loop here."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from .qnetwork import QNetwork

TARGET_KEEP = 0.98
"""Share of itself that the slow network keeps per update; MVSelect's 0.99 suits ten times longer training."""

Reward = Literal["neg-loss", "pos-loss", "improvement", "improvement-own", "improvement-all"]


def best_action(values: Tensor, selected: Tensor) -> int:
    """Index of the highest value among views that are not selected yet."""
    return int(values.masked_fill(selected, -torch.inf).argmax())


def epsilon_greedy(values: Tensor, selected: Tensor, epsilon: float, random: np.random.Generator) -> int:
    """With probability ε a uniformly random *unselected* view, else the best one."""
    if random.random() < epsilon:
        free = np.flatnonzero(~selected.cpu().numpy())
        return int(random.choice(free))
    return best_action(values, selected)


@torch.no_grad()
def td_target(
    network: QNetwork,
    slow: QNetwork,
    reward: float,
    gamma: float,
    selected: Tensor,
    observation: Tensor,
    terminal: bool,
) -> float:
    """q_t of equation 3: r_{t+1} + γ max_a Q(s_{t+1}, a), or the reward alone at the episode's end.

    The maximum runs over views that are not selected in s_{t+1}: the others are no actions. With ``slow``
    the same as ``network`` this is the equation, literally. With γ near 1 it then diverges (values of +8 for
    rewards of −0.001: the maximum feeds on its own errors). Else the maximising action comes from
    ``network`` and its value from ``slow``, an exponential average of it (double Q-learning, van Hasselt et
    al. 2016; the average is MVSelect's).
    """
    if terminal:
        return reward
    values = network(selected, observation)
    worth = values if slow is network else slow(selected, observation)
    return reward + gamma * float(worth[best_action(values, selected)])


@torch.no_grad()
def follow(slow: QNetwork, network: QNetwork, keep: float = TARGET_KEEP) -> None:
    """slow ← keep · slow + (1 − keep) · network."""
    for target, source in zip(slow.parameters(), network.parameters(), strict=True):
        target.lerp_(source, 1.0 - keep)


def epsilon_at(epoch: int, epochs: int, start: float, end: float) -> float:
    """ε of an epoch (zero-based): cosine decay from ``start`` to ``end``, reached in the last epoch."""
    progress = epoch / (epochs - 1) if epochs > 1 else 1.0
    return end + 0.5 * (start - end) * (1.0 + float(np.cos(np.pi * progress)))


class RewardScale:
    """Running mean of the coarse loss: the yardstick of loss rewards.

    −L shrinks fifty-fold while the DNR converges. ``relative`` rewards are (mean − L) / mean: the same ranking of
    episodes (all have equal length, and the mean is common to all views), but of order one throughout training.
    ``raw`` keeps −L, the paper's.
    """

    KEEP = 0.95

    def __init__(self, mean: float | None = None, *, raw: bool = False) -> None:
        self.mean, self.raw = mean, raw

    def reward(self, loss: float) -> float:
        """−loss, or (mean − loss) / mean with the mean before this loss; then takes it in. Non-finite losses are 0."""
        if not np.isfinite(loss):  # its step is skipped, counted and said by the epoch
            return 0.0
        mean = loss if self.mean is None else self.mean
        self.mean = self.KEEP * mean + (1.0 - self.KEEP) * loss
        return -loss if self.raw else (mean - loss) / max(mean, 1e-8)


def reward_of(kind: Reward, loss: float, probe_before: float | None, probe_after: float | None) -> float:
    """Reward of taking a view into training.

    neg-loss     −L_DNRc on that view (the paper's choice), as `RewardScale` measures it: ``loss``
    pos-loss     the negative of that (the paper's comparison: hard views first)
    improvement, improvement-own, improvement-all
                 relative decrease by this step of the raster loss on a fixed set of probe views, on the view itself,
                 or on all candidates: the objective itself, at the price of rendering them after every step
    """
    if kind == "neg-loss":
        return loss
    if kind == "pos-loss":
        return -loss
    assert probe_before is not None and probe_after is not None
    return (probe_before - probe_after) / max(probe_before, 1e-8)

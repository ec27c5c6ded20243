"""Our learned selector: Q-values of single views from features, trained on the surrogate of texture training.

One network values any view of any pool: it sees what a view would add now (:data:`.environment.FEATURES`), not which
one it is, so its weights fit thousands of candidates and other scenes. It is trained where truth is cheap and exact, in
:mod:`.surrogate`: reward of a view is the decrease of the error on *all* rasterised candidates, as a share of the error
with no view, plus γ Φ(s') − Φ(s) of the cost of ``exchange``: potential shaping, which leaves the best policy as it is
(Ng et al. 1999). Double Q-learning (van Hasselt et al. 2016), masked actions, replay, an averaged target network.

:mod:`.learned` makes a policy of it: single views are exchanged while the surrogate's error falls, and whatever the
surrogate says is best is answered: learned, ``exchange`` (as it is, or with the same exchanges), ``kmedoids`` or
``coverage`` (``details["guard"]``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .. import checkpoint
from ..contract import ContractError
from ..model import initialise
from .agent import epsilon_at
from .environment import FEATURES, Environment

WIDTH = 32
GAMMA, KEEP, BATCH, REPLAY = 0.95, 0.98, 64, 4000
EPSILON = (0.9, 0.05)


class ValueNetwork(nn.Module):
    """Features [N, K] -> values [N]; the same weights for every view."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            self.first = nn.Linear(len(FEATURES), WIDTH)
            self.second = nn.Linear(WIDTH, WIDTH)
            self.value = nn.Linear(WIDTH, 1)
        initialise(self, torch.Generator().manual_seed(seed))
        nn.init.zeros_(self.value.weight)

    def forward(self, features: Tensor) -> Tensor:
        hidden = F.leaky_relu(self.second(F.leaky_relu(self.first(features), 0.2)), 0.2)
        return self.value(hidden)[..., 0]


@dataclass(frozen=True)
class Transition:
    """One step: the features of the view taken, its reward, and all next features [N, K] with those still free."""

    before: np.ndarray
    reward: float
    after: np.ndarray
    free: np.ndarray


def train(
    environments: Sequence[Environment],
    *,
    episodes: int,
    seed: int,
    network: ValueNetwork | None = None,
    tick: Callable[[], object] | None = None,
) -> tuple[ValueNetwork, list[float]]:
    """Double Q-learning over the environments in turn; -> the network and each episode's final error (1 = no view).

    network: trained on (default: a new one). tick: called after each episode.
    """
    random = np.random.default_rng([seed, 0x44])
    network = network or ValueNetwork(seed)
    slow = ValueNetwork(seed)
    slow.load_state_dict(network.state_dict())
    adam = torch.optim.Adam(network.parameters(), lr=1e-3)
    replay: list[Transition] = []
    history: list[float] = []
    for episode in range(episodes):
        environment = environments[episode % len(environments)]
        epsilon = epsilon_at(episode, episodes, *EPSILON)
        environment.reset()
        features = environment.features()
        for taken in range(environment.budget):
            free = np.flatnonzero(~environment.selected)
            view = int(random.choice(free)) if random.random() < epsilon else _best(network, features, free)
            before = environment.potential
            reward = environment.step(view)
            last = taken == environment.budget - 1
            reward += (0.0 if last else GAMMA * environment.potential) - before
            following = environment.features()
            ended = np.zeros(0, np.int64) if last else np.flatnonzero(~environment.selected)
            replay.append(Transition(features[view], reward, following, ended))
            features = following
            if len(replay) > REPLAY:
                replay.pop(0)
            _learn(network, slow, adam, [replay[int(i)] for i in random.integers(len(replay), size=BATCH)])
        history.append(environment.surrogate.error / environment.start)
        if tick is not None:
            tick()
    return network, history


def _learn(network: ValueNetwork, slow: ValueNetwork, adam: torch.optim.Optimizer, batch: list[Transition]) -> None:
    """One step of the smooth L1 temporal-difference loss; then the slow network follows."""
    following = torch.from_numpy(np.concatenate([one.after[one.free] for one in batch]))
    counts = [len(one.free) for one in batch]
    with torch.no_grad():
        ours, theirs = network(following).split(counts), slow(following).split(counts)
        ahead = torch.stack([b[a.argmax()] if len(a) else a.new_zeros(()) for a, b in zip(ours, theirs, strict=True)])
    target = torch.tensor([one.reward for one in batch], dtype=torch.float32) + GAMMA * ahead
    loss = F.smooth_l1_loss(network(torch.from_numpy(np.stack([one.before for one in batch]))), target)
    adam.zero_grad()
    loss.backward()
    adam.step()
    with torch.no_grad():
        for old, new in zip(slow.parameters(), network.parameters(), strict=True):
            old.lerp_(new, 1.0 - KEEP)


@torch.no_grad()
def _best(network: ValueNetwork, features: np.ndarray, free: np.ndarray) -> int:
    return int(free[int(network(torch.from_numpy(features[free])).argmax())])


def rollout(environment: Environment, network: ValueNetwork) -> list[int]:
    """The views of highest value, one after the other."""
    environment.reset()
    while len(environment.surrogate.chosen) < environment.budget:
        environment.step(_best(network, environment.features(), np.flatnonzero(~environment.selected)))
    return list(environment.surrogate.chosen)


def save_network(path: Path, network: ValueNetwork, info: dict[str, Any]) -> None:
    """Weights and ``info`` (JSON-able) in one safetensors file, atomically."""
    checkpoint.save(path, network.state_dict(), {**info, "features": list(FEATURES)})


def load_network(path: Path) -> tuple[ValueNetwork, dict[str, Any]]:
    """What :func:`save_network` wrote. Raises ContractError: no such file, damaged, or made for other features."""
    saved = checkpoint.load(path)
    if saved is None:
        raise ContractError(f"{path}: no weights of a selector, or damaged; make them with `dnrpipe train-selector`")
    if saved.info.get("features") != list(FEATURES):
        raise ContractError(f"{path}: weights for other features; make them again with `dnrpipe train-selector`")
    network = ValueNetwork(0)
    network.load_state_dict(saved.tensors)
    return network, saved.info

"""The paper's agent in step 1: it takes views one after the other, learns what each was worth, and at last chooses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from . import checkpoint
from .schedule import STEP1, EpochBook, step_random
from .selector.agent import RewardScale, best_action, epsilon_at, epsilon_greedy, follow, reward_of, td_target
from .selector.policies import FarthestPolicy
from .selector.protocol import Candidates, Choice
from .selector.qnetwork import QNetwork
from .settings import Step1Settings

PROBES = 4
"""Views whose loss the ``improvement`` reward watches."""
MARGIN = 30.0
"""An agent has diverged when its values leave the range that its rewards allow by more than this factor. They may lag
rewards that fall tenfold in the first epoch, and positive rewards (+L, the decrease of the error) overshoot, since the
maximum takes its own errors for worth: 8.5 times the range in the second epoch, 3 in the fourth, 1.3 in the eighth. One
that diverges reaches ten thousand times it."""

KEEP = 0.95
"""Share of itself that the unit of Q keeps per reward."""

Look = Callable[[int], tuple[Tensor, Tensor]]
"""A candidate -> (L_DNRc of the renderer on it, with its graph; T of the view, detached)."""
Step = Callable[[Tensor], bool]
"""One optimiser step on a loss -> whether it was taken."""


class Walker:
    """The agent: Q-network, its slow copy, the scale of rewards, and how large rewards and values have been.

    Its weights are trained by the caller, in one loss with the renderer's. With raw rewards Q is the network's output
    times ``unit``, the running mean of |r|: a step of Adam moves the output by some tenths whatever the rewards are,
    which would be ten times all of −L.

    Args:
        candidates: all N views.
        channels: of T.
        budget: views of an episode.
    """

    def __init__(
        self, candidates: Candidates, channels: int, settings: Step1Settings, *, budget: int, seed: int, device: str
    ) -> None:
        self.count, self.settings, self.budget, self.seed, self.device = len(candidates), settings, budget, seed, device
        shape = (self.count, channels, settings.embedding, seed + 1)
        self.agent, self.slow = QNetwork(*shape).to(device), QNetwork(*shape).to(device)
        self.probes: list[int] = []
        if settings.reward == "improvement":
            self.probes = FarthestPolicy().choose(candidates, min(PROBES, self.count), seed).views
        elif settings.reward == "improvement-all":
            self.probes = list(range(self.count))
        self.scale = RewardScale(raw=settings.reward_scale == "raw")
        self.unit: float | None = None
        self.largest_reward = self.largest_value = 0.0  # of the epoch

    def episode(self, epoch: int, episode: int, look: Look, step: Step, book: EpochBook) -> None:
        """Select ``budget`` views one after the other; each trains the renderer and the agent.

        L_step1 = λ_RL L_RL + λ_DNRc L_DNRc is stepped as one loss, a view at a time, L_RL in squares of the unit of Q.
        Rewards that watch what a step changes are known only after it: their L_RL is stepped by itself, by the same
        optimiser.

        Args:
            epoch: zero-based.
            episode: zero-based, of the epoch.
        """
        s, agent = self.settings, self.agent
        if episode == 0:
            # What it learned of earlier, larger rewards is no divergence: their running mean counts, too.
            self.largest_reward, self.largest_value = self.unit or 0.0, 0.0
        random = step_random(self.seed, STEP1, epoch, episode)
        epsilon = epsilon_at(epoch, s.epochs, s.epsilon_start, s.epsilon_end)
        selected = torch.zeros(self.count, dtype=torch.bool, device=self.device)
        view = int(random.integers(self.count))
        loss, texture = look(view)
        book.count(step(s.weight_dnr * loss))
        book.add(dnr=float(loss.detach()))
        self.scale.reward(float(loss.detach()))
        selected[view] = True
        probe = self._loss_on(self.probes, look)
        after_the_step = s.reward.startswith("improvement")
        for taken in range(1, self.budget):
            values = agent(selected, agent.encode(texture))
            view = epsilon_greedy(values.detach(), selected, epsilon, random)
            loss, texture = look(view)
            paid = float(loss.detach())
            own = self.scale.reward(paid)
            if after_the_step:
                book.count(step(s.weight_dnr * loss))
                before = paid if s.reward == "improvement-own" else probe
                probe = self._loss_on([view] if s.reward == "improvement-own" else self.probes, look)
                reward = reward_of(s.reward, own, before, probe)
            else:
                reward = reward_of(s.reward, own, None, None)
            selected = selected.clone()
            selected[view] = True
            slow = self.slow if s.q_target == "double" else agent
            last = taken == self.budget - 1
            unit = self._worth(reward)
            target = td_target(agent, slow, reward / unit, s.gamma, selected, agent.encode(texture), last)
            loss_rl = (values[view] - target).square()
            if after_the_step:
                book.skipped += not step(s.weight_rl * loss_rl)
            else:
                book.count(step(s.weight_dnr * loss + s.weight_rl * loss_rl))
            follow(self.slow, agent)
            value = unit * float(values[view].detach())
            self.largest_reward = max(self.largest_reward, abs(reward))
            self.largest_value = max(self.largest_value, abs(value))
            book.add(dnr=paid, rl=float(loss_rl.detach()), reward=reward, q=value)

    def trouble(self) -> str | None:
        """What shows that the agent diverged in the last epoch, in words; None when it did not.

        The value of M − 1 further views is Σ γ^k r: no policy makes it larger than max |r| times Σ γ^k.
        """
        horizon = sum(self.settings.gamma**k for k in range(self.budget - 1))
        allowed = MARGIN * self.largest_reward * horizon
        if self.largest_value <= allowed:
            return None
        return (
            f"the agent's values reach {self.largest_value:.3g}, where rewards of at most {self.largest_reward:.3g}"
            f" allow {allowed / MARGIN:.3g}"
        )

    def _worth(self, reward: float) -> float:
        """What an output of 1 is worth, once the reward is taken in."""
        if not self.scale.raw:
            return 1.0
        self.unit = abs(reward) if self.unit is None else KEEP * self.unit + (1.0 - KEEP) * abs(reward)
        return max(self.unit, 1e-8)

    @torch.no_grad()
    def _loss_on(self, views: list[int], look: Look) -> float | None:
        """Mean L_DNRc of some candidates; None of none."""
        return float(torch.stack([look(view)[0] for view in views]).mean()) if views else None

    @torch.no_grad()
    def roll_out(self, look: Look) -> Choice:
        """The trained agent's greedy choice."""
        random = step_random(self.seed, STEP1, -1, -1)
        order = [int(random.integers(self.count))]
        selected = torch.zeros(self.count, dtype=torch.bool, device=self.device)
        selected[order[0]] = True
        values: list[float] = []
        while len(order) < self.budget:
            q = self.agent(selected, self.agent.encode(look(order[-1])[1]))
            order.append(best_action(q, selected))
            selected[order[-1]] = True
            values.append((self.unit or 1.0) * float(q[order[-1]]))
        details: dict[str, Any] = {"reward": self.settings.reward, "measure": "action value when it was taken"}
        if values and np.isfinite(values).all():
            details["action_values"] = values
        # The reasons beside them name a value that is not finite; JSON cannot.
        finite = [value if np.isfinite(value) else 0.0 for value in values]
        why = ["drawn at random, as in every episode", *(f"highest action value: {value:.4f}" for value in values)]
        return Choice(order, [0.0, *finite], why, details)

    def parts(self) -> checkpoint.Parts:
        """Its parts of step 1's checkpoint."""
        return {"agent": self.agent.state_dict(), "slow": self.slow.state_dict()}

    def load(self, saved: checkpoint.State) -> None:
        """Go on from step 1's checkpoint."""
        self.scale = RewardScale(saved.progress.reward_mean, raw=self.settings.reward_scale == "raw")
        self.unit = saved.progress.reward_unit
        self.agent.load_state_dict(saved.parts["agent"])
        self.slow.load_state_dict(saved.parts["slow"])

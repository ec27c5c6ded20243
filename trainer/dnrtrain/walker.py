"""The paper's agent in step 1: it takes views one after the other, learns what each was worth, and at last chooses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from . import checkpoint
from .schedule import STEP1, EpochBook, adam, guarded_step, step_random
from .selector.agent import RewardScale, best_action, epsilon_at, epsilon_greedy, follow, reward_of, td_target
from .selector.policies import FarthestPolicy
from .selector.protocol import Candidates, Choice
from .selector.qnetwork import QNetwork
from .settings import Step1Settings
from .training_run import TrainingRun

PROBES = 4
"""Views whose loss the ``improvement`` reward watches."""


class Walker:
    """The agent: Q-network, its slow copy, their optimiser, the scale of rewards.

    Args:
        run: the training of the renderer on all candidates, which it is part of.
        budget: views of an episode.
    """

    def __init__(self, run: TrainingRun[Step1Settings], candidates: Candidates, budget: int) -> None:
        self.dnr, self.views, self.settings, self.budget = run.dnr, run.views, run.settings, budget
        self.seed, self.device, settings = run.seed, run.device, run.settings
        shape = (len(self.views), self.dnr.settings.texture_channels, settings.embedding, self.seed + 1)
        self.agent, self.slow = QNetwork(*shape).to(self.device), QNetwork(*shape).to(self.device)
        self.adam = adam([self.agent], settings.learning_rate, self.device)
        self.probes: list[int] = []
        if settings.reward == "improvement":
            self.probes = FarthestPolicy().choose(candidates, min(PROBES, len(self.views)), self.seed).views
        elif settings.reward == "improvement-all":
            self.probes = list(range(len(self.views)))
        self.scale = RewardScale(raw=settings.reward_scale == "raw")

    def episode(
        self,
        epoch: int,
        episode: int,
        train_view: Callable[[int], tuple[float, Tensor]],
        rate: Callable[[], float],
        book: EpochBook,
    ) -> None:
        """Select ``budget`` views one after the other; each trains the DNR and the agent.

        Args:
            epoch: zero-based.
            episode: zero-based, of the epoch.
            train_view: one DNR step on a view -> (its loss before the step, T of the view).
            rate: learning rate of the last step.
        """
        s, agent = self.settings, self.agent
        random = step_random(self.seed, STEP1, epoch, episode)
        epsilon = epsilon_at(epoch, s.epochs, s.epsilon_start, s.epsilon_end)
        selected = torch.zeros(len(self.views), dtype=torch.bool, device=self.device)
        view = int(random.integers(len(self.views)))
        loss, texture = train_view(view)
        self.scale.reward(loss)
        selected[view] = True
        probe = self._probe_loss()
        for taken in range(1, self.budget):
            values = agent(selected, agent.encode(texture))
            view = epsilon_greedy(values.detach(), selected, epsilon, random)
            loss, texture = train_view(view)
            if s.reward == "improvement-own":
                probe, after = loss, self._loss_on([view])
            else:
                after = self._probe_loss()
            reward = reward_of(s.reward, self.scale.reward(loss), probe, after)
            probe = after
            selected = selected.clone()
            selected[view] = True
            terminal = taken == self.budget - 1
            slow = self.slow if s.q_target == "double" else agent
            target = td_target(agent, slow, reward, s.gamma, selected, agent.encode(texture), terminal)
            loss_rl = (values[view] - target).square()
            if not guarded_step(self.adam, s.weight_rl * loss_rl, rate()):
                book.skipped += 1
            follow(self.slow, agent)
            book.add(rl=float(loss_rl.detach()), reward=reward, q=float(values[view].detach()))

    def _probe_loss(self) -> float | None:
        return self._loss_on(self.probes) if self.probes else None

    @torch.no_grad()
    def _loss_on(self, views: list[int]) -> float:
        """Mean L_DNRc of some candidates."""
        losses = []
        for view in views:
            batch = self.views.batch([view])
            assert batch.target is not None
            losses.append(F.mse_loss(self.dnr(batch).rgb, batch.target))
        return float(torch.stack(losses).mean())

    @torch.no_grad()
    def roll_out(self) -> Choice:
        """The trained agent's greedy choice."""
        random = step_random(self.seed, STEP1, -1, -1)
        order = [int(random.integers(len(self.views)))]
        selected = torch.zeros(len(self.views), dtype=torch.bool, device=self.device)
        selected[order[0]] = True
        values: list[float] = []
        while len(order) < self.budget:
            texture = self.dnr(self.views.batch([order[-1]])).texture
            q = self.agent(selected, self.agent.encode(texture))
            order.append(best_action(q, selected))
            selected[order[-1]] = True
            values.append(float(q[order[-1]]))
        details: dict[str, Any] = {"reward": self.settings.reward, "measure": "action value when it was taken"}
        if values and np.isfinite(values).all():
            details["action_values"] = values
        # The reasons beside them name a value that is not finite; JSON cannot.
        finite = [value if np.isfinite(value) else 0.0 for value in values]
        why = ["drawn at random, as in every episode", *(f"highest action value: {value:.4f}" for value in values)]
        return Choice(order, [0.0, *finite], why, details)

    def parts(self) -> checkpoint.Parts:
        """Its parts of step 1's checkpoint."""
        adam = checkpoint.optimiser_tensors(self.adam)
        return {"agent": self.agent.state_dict(), "slow": self.slow.state_dict(), "adam_agent": adam}

    def load(self, saved: checkpoint.State) -> None:
        """Go on from step 1's checkpoint."""
        self.scale = RewardScale(saved.progress.reward_mean, raw=self.settings.reward_scale == "raw")
        self.agent.load_state_dict(saved.parts["agent"])
        self.slow.load_state_dict(saved.parts["slow"])
        checkpoint.restore_optimiser(self.adam, saved.parts["adam_agent"])

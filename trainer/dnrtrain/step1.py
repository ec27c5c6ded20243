"""Step 1: the coarse DNR on rasterised images, and the view selector (paper equations 2 to 5).

With ``rl-paper`` an episode walks ``budget`` candidate views; every view taken is one training step of the DNR
and gives the agent its reward. With any other policy the DNR trains on all candidates in random order for the same
number of steps, without an agent: ``fisher`` asks the finished DNR, and for a policy that needs no training it is worth
its time where step 2 starts from its weights.

The joint loss 0.1·L_RL + 1.0·L_DNRc (equation 5) is stepped by two Adam optimisers: the observation is
detached, so the two gradients touch disjoint parameters and the sum splits exactly. L_RL = Σ_t (equation
4) is stepped term by term as the episode goes: one temporal-difference update per view taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from . import checkpoint
from .contract import ContractError, DamagedFile
from .dataset import ViewSet
from .events import Diverged, EpochEnd, Event, Note, Selected
from .model import DNR
from .precision import decide_bfloat16
from .schedule import (
    STEP1,
    EpochBook,
    Watch,
    adam,
    guarded_step,
    learning_rate,
    require_target,
    run_key,
    step_random,
    validate,
)
from .selector.agent import RewardScale, best_action, epsilon_at, epsilon_greedy, follow, reward_of, td_target
from .selector.baselines import FarthestPolicy
from .selector.fisher import choose_by_fisher
from .selector.names import full_name
from .selector.policies import untrained
from .selector.protocol import Candidates, Choice, check_budget
from .selector.qnetwork import QNetwork
from .selector.sightings import Sightings
from .settings import ModelSettings, Step1Settings

AGENTS = "rl-paper"
"""The policy whose agent learns while the renderer trains; others that step 1 trains for ask the finished renderer."""
PROBES = 4
"""Views whose loss the ``improvement`` reward watches."""


def run_step1(
    views: ViewSet,
    val: ViewSet | None,
    camera_positions: np.ndarray,
    model: ModelSettings,
    settings: Step1Settings,
    *,
    policy: str,
    budget: int,
    seed: int,
    device: str,
    checkpoints: Path,
    fingerprint: str,
    sightings: Sightings | None = None,
) -> Iterator[Event]:
    """Train the coarse DNR (and the selector); the last event is :class:`Selected`.

    Args:
        views: all N candidates, targets = rasterised images.
        val: validation views with rasterised targets, or None.
        model: of the whole run; step 1 trains its :meth:`~dnrtrain.settings.ModelSettings.coarse` part.
        camera_positions: centres of the candidates' cameras in world space, [N, 3].
        policy: a name of :mod:`.selector.policies`.
        budget: M, the number of views to select, 1 <= M <= N.
        checkpoints: this step's own folder; a run that was interrupted there with the same fingerprint
            and settings is continued after its last whole epoch, a finished one answers at once.
        sightings: what the candidates see, for policies that look at it.

    Raises:
        ContractError: budget out of range, unknown policy, views without targets.
    """
    if np.shape(camera_positions) != (len(views), 3):
        raise ContractError(f"{len(views)} views but camera positions of shape {np.shape(camera_positions)}")
    candidates = Candidates(np.asarray(camera_positions, np.float64), views.camera_directions, sightings)
    run = _Step1(views, val, candidates, model, settings, policy, budget, seed, device, checkpoints, fingerprint)
    yield from run.events()


class _Step1:
    """One run's state: networks, optimisers, books."""

    def __init__(
        self,
        views: ViewSet,
        val: ViewSet | None,
        candidates: Candidates,
        model: ModelSettings,
        settings: Step1Settings,
        policy: str,
        budget: int,
        seed: int,
        device: str,
        folder: Path,
        fingerprint: str,
    ) -> None:
        check_budget(budget, len(views))
        self.rule = untrained(policy)
        policy = full_name(policy)
        require_target(views, "step 1")
        self.candidates = candidates
        self.views, self.val = views.to(device), None if val is None else val.to(device)
        self.settings, self.policy, self.budget, self.seed = settings, policy, budget, seed
        self.device, self.folder, self.fingerprint = device, Path(folder), fingerprint
        model = model.coarse()
        # Under its first name, so that runs from before it had two are found again.
        known = "rl" if policy == "rl-paper" else policy
        parts = [model.model_dump(), settings.model_dump(), known, budget, seed, device]
        self.key = run_key(fingerprint, views, parts)
        self.episodes = -(-len(views) // budget)
        self.total_steps = settings.epochs * self.episodes * budget
        self.dnr = DNR(model, seed).to(device)
        self.agent: QNetwork | None = None
        self.slow: QNetwork | None = None
        if policy == AGENTS:
            shape = (len(views), model.texture_channels, settings.embedding, seed + 1)
            self.agent, self.slow = QNetwork(*shape).to(device), QNetwork(*shape).to(device)
        self.adam_dnr = adam([self.dnr], settings.learning_rate, device, settings.texture_rate_scale)
        self.adam_agent = adam([self.agent], settings.learning_rate, device) if self.agent else None
        self.probes: list[int] = []
        if self.agent and settings.reward == "improvement":
            self.probes = FarthestPolicy().choose(candidates, min(PROBES, len(views)), seed).views
        elif self.agent and settings.reward == "improvement-all":
            self.probes = list(range(len(views)))
        self.scale = RewardScale(raw=settings.reward_scale == "raw")
        self.notes: list[str] = []
        self.watch = Watch()
        self.history: list[dict] = []
        self.book = EpochBook()
        self.step = 0

    # -- the run ---------------------------------------------------------------------------------------

    def events(self) -> Iterator[Event]:
        record = checkpoint.read_record(self.folder)
        if record is not None and record.get("run") == self.key:
            yield Selected(
                record["selected"], self.policy, record["details"], record.get("gains", []), record.get("why", [])
            )
            return
        first = self._restore()
        for text in self.notes:
            yield Note(text)
        if first:
            yield Note(f"step 1 continues after epoch {first} of {self.settings.epochs}")
        epoch = first
        while epoch < self.settings.epochs:
            done = self._epoch(epoch)
            yield done
            epoch += isinstance(done, EpochEnd)
        choice = self._select()
        names = [self.views.names[i] for i in choice.views]
        info = {
            "fingerprint": self.fingerprint,
            "run": self.key,
            "stage": "step1",
            "settings": self.settings.model_dump(mode="json"),
            "policy": self.policy,
            "budget": self.budget,
            "seed": self.seed,
            "selected": names,
            "details": choice.details,
            "gains": choice.gains,
            "why": choice.why,
            "bfloat16": self.dnr.use_bfloat16,
            "restarts": self.watch.restarts,
            "history": self.history,
        }
        checkpoint.save_model(self.folder, self.dnr, info)
        yield Selected(names, self.policy, choice.details, choice.gains, choice.why)

    def _epoch(self, epoch: int) -> EpochEnd | Diverged:
        """One epoch; where it diverged, the state is that before it, at a lower rate."""
        self.book = EpochBook()
        self.step = epoch * self.episodes * self.budget
        if self.agent is None:
            self._train_all(epoch)
        else:
            for episode in range(self.episodes):
                self._episode(epoch, episode)
        trained = [module for module in (self.dnr, self.agent) if module is not None]
        with torch.no_grad():
            picture = self.dnr(self.views.batch([0])).rgb
        reason = self.watch.trouble(self.book, "dnr", self.history, picture, *trained)
        if reason is not None:
            text = self.watch.restart(epoch + 1, reason)
            self._load(checkpoint.require_state(self.folder, self.key))
            self._save(epoch)
            spent = self.book.entry(epoch + 1, 0.0, {})
            return Diverged(
                "step1",
                epoch + 1,
                f"step 1: {text}",
                spent["seconds"],
                spent["cpu_seconds"],
                spent["steps"],
                self.device,
            )
        scores = validate(self.dnr, self.val, self.settings.validation_views)
        entry = self.book.entry(epoch + 1, self._rate(self.step - 1), scores)
        self.history.append(entry)
        self._save(epoch + 1)
        return EpochEnd(
            "step1",
            epoch + 1,
            self.settings.epochs,
            entry["losses"],
            scores,
            entry["seconds"],
            entry["cpu_seconds"],
            entry["steps"],
            entry["skipped"],
            self.device,
        )

    def _rate(self, step: int) -> float:
        s = self.settings
        return self.watch.scale * learning_rate(step, self.total_steps, s.learning_rate, s.learning_rate_end)

    # -- one step --------------------------------------------------------------------------------------

    def _train_view(self, view: int) -> tuple[float, Tensor]:
        """One DNR step on one view; -> (L_DNRc before the step, T of the view)."""
        batch = self.views.batch([view])
        assert batch.target is not None
        output = self.dnr(batch)
        loss = F.mse_loss(output.rgb, batch.target)
        taken = guarded_step(self.adam_dnr, self.settings.weight_dnr * loss, self._rate(self.step))
        self.book.count(taken)
        value = float(loss.detach())
        self.book.add(dnr=value)
        self.step += 1
        return value, output.texture.detach()

    def _train_all(self, epoch: int) -> None:
        """All candidates in random order, cycled to as many steps as an RL epoch has."""
        random = step_random(self.seed, STEP1, epoch, -1)
        order: list[int] = []
        while len(order) < self.episodes * self.budget:
            order += [int(i) for i in random.permutation(len(self.views))]
        for view in order[: self.episodes * self.budget]:
            self._train_view(view)

    def _episode(self, epoch: int, episode: int) -> None:
        """Select ``budget`` views one after the other, training the DNR and the agent on the way."""
        assert self.agent is not None and self.slow is not None and self.adam_agent is not None
        s, agent = self.settings, self.agent
        random = step_random(self.seed, STEP1, epoch, episode)
        epsilon = epsilon_at(epoch, s.epochs, s.epsilon_start, s.epsilon_end)
        selected = torch.zeros(len(self.views), dtype=torch.bool, device=self.device)
        view = int(random.integers(len(self.views)))
        loss, texture = self._train_view(view)
        self.scale.reward(loss)
        selected[view] = True
        probe = self._probe_loss()
        for taken in range(1, self.budget):
            values = agent(selected, agent.encode(texture))
            view = epsilon_greedy(values.detach(), selected, epsilon, random)
            loss, texture = self._train_view(view)
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
            if not guarded_step(self.adam_agent, s.weight_rl * loss_rl, self._rate(self.step - 1)):
                self.book.skipped += 1
            follow(self.slow, agent)
            self.book.add(rl=float(loss_rl.detach()), reward=reward, q=float(values[view].detach()))

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

    # -- the selection ---------------------------------------------------------------------------------

    def _select(self) -> Choice:
        """The policy's choice: by the trained agent's greedy roll-out where there is one."""
        if self.rule is not None:
            return self.rule.choose(self.candidates, self.budget, self.seed)
        if self.agent is None:
            return choose_by_fisher(self.dnr, self.views, self.candidates, self.budget, self.seed)
        return self._roll_out()

    @torch.no_grad()
    def _roll_out(self) -> Choice:
        assert self.agent is not None
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
        finite = [value if np.isfinite(value) else 0.0 for value in values]
        why = ["drawn at random, as in every episode", *(f"highest action value: {value:.4f}" for value in values)]
        return Choice(order, [0.0, *finite], why, details)

    # -- checkpoints -----------------------------------------------------------------------------------

    def _save(self, epoch: int) -> None:
        tensors = checkpoint.prefixed("dnr", self.dnr.state_dict())
        tensors |= checkpoint.prefixed("adam_dnr", checkpoint.optimiser_tensors(self.adam_dnr))
        if self.agent is not None and self.slow is not None and self.adam_agent is not None:
            tensors |= checkpoint.prefixed("agent", self.agent.state_dict())
            tensors |= checkpoint.prefixed("slow", self.slow.state_dict())
            tensors |= checkpoint.prefixed("adam_agent", checkpoint.optimiser_tensors(self.adam_agent))
        info = {
            "run": self.key,
            "epoch": epoch,
            "bfloat16": self.dnr.use_bfloat16,
            "reward_mean": self.scale.mean,
            "restarts": self.watch.restarts,
            "history": self.history,
        }
        checkpoint.save_state(self.folder, tensors, info)

    def _restore(self) -> int:
        """Load the state of an interrupted run of the same key; -> epochs done. Else start afresh."""
        try:
            saved = checkpoint.load_state(self.folder)
        except DamagedFile as damage:
            self.notes.append(f"{damage.path}: damaged; training starts afresh")
            saved = None
        if saved is None or saved.info.get("run") != self.key:
            self.dnr.use_bfloat16 = decide_bfloat16(self.settings.precision, self.device)
            self._save(0)
            return 0
        self.watch.restarts = saved.info.get("restarts", [])
        self._load(saved)
        return int(saved.info["epoch"])

    def _load(self, saved: checkpoint.Saved) -> None:
        self.dnr.use_bfloat16, self.history = saved.info["bfloat16"], saved.info["history"]
        self.scale = RewardScale(saved.info["reward_mean"], raw=self.settings.reward_scale == "raw")
        checkpoint.load_module(self.dnr, checkpoint.unprefixed("dnr", saved.tensors))
        checkpoint.restore_optimiser(self.adam_dnr, checkpoint.unprefixed("adam_dnr", saved.tensors))
        if self.agent is not None and self.slow is not None and self.adam_agent is not None:
            checkpoint.load_module(self.agent, checkpoint.unprefixed("agent", saved.tensors))
            checkpoint.load_module(self.slow, checkpoint.unprefixed("slow", saved.tensors))
            checkpoint.restore_optimiser(self.adam_agent, checkpoint.unprefixed("adam_agent", saved.tensors))

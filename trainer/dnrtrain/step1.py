"""Step 1: the coarse DNR on rasterised images, and the view selector (paper equations 2 to 5).

With ``rl-paper`` an episode walks ``budget`` candidate views; every view taken is one training step of the DNR
and gives the agent its reward. With any other policy the DNR trains on all candidates in random order for the same
number of steps, without an agent: ``fisher`` asks the finished DNR, and for a policy that needs no training it is worth
its time where step 2 starts from its weights. ``ensemble`` and ``variance`` train coarse DNRs of their own, on the
views that they chose so far (:mod:`.selector.active`); each of these is a run of step 1 itself, in a folder below.

The joint loss 0.1·L_RL + 1.0·L_DNRc (equation 5) is stepped by two Adam optimisers: the observation is
detached, so the two gradients touch disjoint parameters and the sum splits exactly. L_RL = Σ_t (equation
4) is stepped term by term as the episode goes: one temporal-difference update per view taken.
"""

from __future__ import annotations

import shutil
from collections.abc import Generator, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from . import checkpoint
from .contract import ContractError
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
from .selector.active import active_epochs, choose_actively
from .selector.fisher import choose_by_fisher
from .selector.names import ACTIVE_NAMES, full_name
from .selector.policies import untrained
from .selector.protocol import Candidates, Choice, check_budget
from .selector.sightings import Sightings
from .settings import ActiveSettings, ModelSettings, Step1Settings
from .walker import Walker

AGENTS = "rl-paper"
"""The policy whose agent learns while the renderer trains; others that step 1 trains for ask the finished renderer."""
MEMBERS = "members"
"""Folder of the models that a policy trains for itself, below that of the step; gone when it has chosen."""


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
    choice: Choice | None = None,
    active: ActiveSettings | None = None,
    coarse: bool = True,
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
        choice: what the policy has chosen already, where it needs no training; None: it is asked here.
        active: for policies with models of their own (default: :class:`~dnrtrain.settings.ActiveSettings`).
        coarse: whether the saved model is wanted, as the start of step 2. Without it those policies spare themselves
            the training on all candidates; the saved model is then the first of their last batch.

    Raises:
        ContractError: budget out of range, unknown policy, views without targets, a choice of another size.
    """
    if choice is not None and len(choice.views) != budget:
        raise ContractError(f"{len(choice.views)} views were chosen, but the budget is {budget}")
    if np.shape(camera_positions) != (len(views), 3):
        raise ContractError(f"{len(views)} views but camera positions of shape {np.shape(camera_positions)}")
    candidates = Candidates(np.asarray(camera_positions, np.float64), views.camera_directions, sightings)
    run = _Step1(
        views, val, candidates, model, settings, policy, budget, seed, device, checkpoints, fingerprint,
        active or ActiveSettings(), coarse,
    )  # fmt: skip
    run.choice = choice
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
        active: ActiveSettings,
        coarse: bool,
    ) -> None:
        check_budget(budget, len(views))
        self.rule = untrained(policy)
        self.choice: Choice | None = None
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
        self.active, own_epochs = active, 0
        if policy in ACTIVE_NAMES:
            own_epochs = active_epochs(policy, active, budget)
            parts += [active.model_dump(), coarse]
        self.epochs = settings.epochs if coarse or not own_epochs else 0
        self.all_epochs = self.epochs + own_epochs
        self.key = run_key(fingerprint, views, parts)
        self.episodes = -(-len(views) // budget)
        self.total_steps = settings.epochs * self.episodes * budget
        self.dnr = DNR(model, seed).to(device)
        self.adam_dnr = adam([self.dnr], settings.learning_rate, device, settings.texture_rate_scale)
        self.walker: Walker | None = None
        if policy == AGENTS:
            self.walker = Walker(self.dnr, self.views, candidates, settings, budget, seed, device)
        self.notes: list[str] = []
        self.watch = Watch()
        self.history: list[dict] = []
        self.booked: dict[str, float] = {}
        """What the epochs of a policy's own models took in this run."""
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
            yield Note(f"step 1 continues after epoch {first} of {self.epochs}")
        epoch = first
        while epoch < self.epochs:
            done = self._epoch(epoch)
            yield done
            epoch += isinstance(done, EpochEnd)
        book = EpochBook()
        choice = yield from self._select()
        spent = book.entry(0, 0.0, {})
        choosing = {name: max(0.0, spent[name] - self.booked.get(name, 0.0)) for name in ("seconds", "cpu_seconds")}
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
            "choosing": choosing,
        }
        checkpoint.save_model(self.folder, self.dnr, info)
        shutil.rmtree(self.folder / MEMBERS, ignore_errors=True)
        yield Selected(names, self.policy, choice.details, choice.gains, choice.why, **choosing)

    def _epoch(self, epoch: int) -> EpochEnd | Diverged:
        """One epoch; where it diverged, the state is that before it, at a lower rate."""
        self.book = EpochBook()
        self.step = epoch * self.episodes * self.budget
        trained: list[nn.Module] = [self.dnr]
        if self.walker is None:
            self._train_all(epoch)
        else:
            trained.append(self.walker.agent)
            for episode in range(self.episodes):
                self.walker.episode(epoch, episode, self._train_view, lambda: self._rate(self.step - 1), self.book)
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
            self.all_epochs,
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

    # -- the selection ---------------------------------------------------------------------------------

    def _select(self) -> Generator[Event, None, Choice]:
        """The policy's choice, by the trained agent's greedy roll-out where there is one; yields what models
        trained for it tell."""
        if self.choice is not None:
            return self.choice
        if self.policy in ACTIVE_NAMES:
            return (
                yield from choose_actively(
                    self.policy, self.views, self.candidates, self.budget, self.seed, self.active, self._train_member
                )
            )
        if self.rule is not None:
            return self.rule.choose(self.candidates, self.budget, self.seed)
        if self.walker is None:
            return choose_by_fisher(self.dnr, self.views, self.candidates, self.budget, self.seed)
        return self.walker.roll_out()

    def _train_member(self, views: list[int], batch: int, member: int) -> Generator[Event, None, DNR]:
        """A coarse DNR of its own on some candidates: step 1 without an agent, of so many epochs over them.

        It goes on where an interrupted run stopped. Its epochs are numbered, and booked, behind those before it.
        """
        some, folder = self.views.subset(views), self.folder / MEMBERS / f"{batch}-{member}"
        epochs, before = self.active.epochs, len(self.history)
        settings = self.settings.model_copy(update={"epochs": epochs, "validation_views": 0})
        seed = int(np.random.SeedSequence([self.seed, batch, member]).generate_state(1)[0])
        events = run_step1(
            some, None, some.camera_positions, self.dnr.settings, settings,
            policy="random", budget=len(some), seed=seed, device=self.device, checkpoints=folder,
            fingerprint=self.fingerprint,
        )  # fmt: skip
        for event in events:
            if isinstance(event, Selected):
                continue
            if isinstance(event, EpochEnd | Diverged):
                for name in ("seconds", "cpu_seconds"):
                    self.booked[name] = self.booked.get(name, 0.0) + getattr(event, name)
                event = replace(event, epoch=before + event.epoch)
            yield replace(event, epochs=self.all_epochs) if isinstance(event, EpochEnd) else event
        record = checkpoint.read_record(folder)
        assert record is not None  # it has just finished
        for ours, own in ((self.history, record["history"]), (self.watch.restarts, record["restarts"])):
            ours += [{**entry, "epoch": before + entry["epoch"]} for entry in own]
        model = checkpoint.load_model(folder, self.device)
        if not self.epochs and member == 0:
            self.dnr = model
        return model

    # -- checkpoints -----------------------------------------------------------------------------------

    def _save(self, epoch: int) -> None:
        tensors = checkpoint.prefixed("dnr", self.dnr.state_dict())
        tensors |= checkpoint.prefixed("adam_dnr", checkpoint.optimiser_tensors(self.adam_dnr))
        if self.walker is not None:
            tensors |= self.walker.tensors()
        info = {
            "run": self.key,
            "epoch": epoch,
            "bfloat16": self.dnr.use_bfloat16,
            "reward_mean": None if self.walker is None else self.walker.scale.mean,
            "restarts": self.watch.restarts,
            "history": self.history,
        }
        checkpoint.save_state(self.folder, tensors, info)

    def _restore(self) -> int:
        """Load the state of an interrupted run of the same key; -> epochs done. Else start afresh."""
        saved = checkpoint.interrupted(self.folder, self.key, self.notes)
        if saved is None:
            self.dnr.use_bfloat16 = decide_bfloat16(self.settings.precision, self.device)
            self._save(0)
            return 0
        self.watch.restarts = saved.info.get("restarts", [])
        self._load(saved)
        return int(saved.info["epoch"])

    def _load(self, saved: checkpoint.Saved) -> None:
        self.dnr.use_bfloat16, self.history = saved.info["bfloat16"], saved.info["history"]
        checkpoint.load_module(self.dnr, checkpoint.unprefixed("dnr", saved.tensors))
        checkpoint.restore_optimiser(self.adam_dnr, checkpoint.unprefixed("adam_dnr", saved.tensors))
        if self.walker is not None:
            self.walker.load(saved)

"""Step 1: the coarse DNR on rasterised images, and the view selector (paper equations 2 to 5).

With ``rl-paper`` an episode walks ``budget`` candidate views; every view taken is one training step of the DNR
and gives the agent its reward. With any other policy the DNR trains on all candidates in random order for the same
number of steps, without an agent: step 2 may start from its weights.

The joint loss 0.1·L_RL + 1.0·L_DNRc (equation 5) is one loss with one Adam optimiser. L_RL = Σ_t (equation 4) is
stepped term by term as the episode goes: one temporal-difference update per view taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch.nn.functional as F
from torch import Tensor, nn

from . import checkpoint
from .contract import ContractError
from .dataset import ViewSet
from .events import Event, Selected
from .model import DNR
from .precision import decide_bfloat16
from .records import Selection
from .schedule import STEP1, EpochBook, guarded_step, require_target, run_fingerprint, step_random
from .selector.policies import untrained
from .selector.protocol import Candidates, Choice, check_budget
from .settings import ModelSettings, Step1Settings
from .training_run import TrainingRun
from .walker import Walker


def run_step1(
    views: ViewSet,
    val: ViewSet | None,
    model: ModelSettings,
    settings: Step1Settings,
    *,
    policy: str,
    budget: int,
    seed: int,
    device: str,
    checkpoints: Path,
    fingerprint: str,
    choice: Choice | None = None,
) -> Iterator[Event]:
    """Train the coarse DNR (and the selector); the last event is `Selected`.

    Args:
        views: all N candidates, targets = rasterised images.
        val: validation views with rasterised targets, or None.
        model: of the whole run; step 1 trains its ``coarse()`` part.
        policy: a name of ``selector.names``.
        budget: M, the number of views to select, 1 <= M <= N.
        seed: of weights, of the order of steps, of the agent's dice.
        checkpoints: this step's own folder. A run that was interrupted there with the same fingerprint
            and settings is continued after its last whole epoch, a finished one answers at once.
        choice: what a policy without training has chosen. None: it is asked here, and knows the cameras only.

    Raises:
        ContractError: budget out of range, unknown policy, views without targets, a choice of another size.
    """
    check_budget(budget, len(views))
    require_target(views, "step 1")
    if choice is not None and len(choice.views) != budget:
        raise ContractError(f"{len(choice.views)} views were chosen, but the budget is {budget}")
    rule = untrained(policy)
    candidates = Candidates(views.camera_positions, views.camera_directions)
    if rule is not None and choice is None:
        choice = rule.choose(candidates, budget, seed)
    parts = [model.coarse().model_dump(), settings.model_dump(), policy, budget, seed, device, "one optimiser"]
    dnr = DNR(model.coarse(), seed).to(device)
    dnr.use_bfloat16 = decide_bfloat16(settings.precision, device)
    walker = None
    if choice is None:
        walker = Walker(candidates, dnr.settings.texture_channels, settings, budget=budget, seed=seed, device=device)
    step = _Step1(
        dnr=dnr,
        views=views,
        val=val,
        settings=settings,
        budget=budget,
        seed=seed,
        run=run_fingerprint(fingerprint, views, parts),
        folder=Path(checkpoints),
        device=device,
        walker=walker,
    )
    done = step.finished()
    if done is not None:
        known = {"policy": policy, "budget": budget, "seed": seed, "views": done.selected}
        yield Selected(Selection(**known, gains=done.gains, why=done.why, details=done.details))
        return
    yield from step.train()
    book = EpochBook()
    if step.walker is not None:
        choice = step.walker.roll_out(step.look)
    assert choice is not None  # given, the rule's, or the agent's
    spent = book.entry(0, 0.0, {})
    selection = choice.selection(views.names, policy, seed)
    facts = selection.model_dump(exclude={"views", "seed"})
    choosing = {"seconds": spent.seconds, "cpu_seconds": spent.cpu_seconds}
    step.save_model(fingerprint, selected=selection.views, choosing=choosing, **facts)
    yield Selected(selection, **choosing)


@dataclass(kw_only=True)
class _Step1(TrainingRun[Step1Settings]):
    """``walker``: the agent, where the policy has one."""

    number, term = 1, "dnr"

    budget: int
    walker: Walker | None = None

    @property
    def episodes(self) -> int:
        return -(-len(self.views) // self.budget)

    @property
    def steps_per_epoch(self) -> int:
        return self.episodes * self.budget

    def look(self, view: int) -> tuple[Tensor, Tensor]:
        """A candidate -> (L_DNRc on it, with its graph; T of the view, detached)."""
        batch = self.views.batch([view])
        assert batch.target is not None
        output = self.dnr(batch)
        assert output.texture is not None  # the coarse model has a neural texture
        return F.mse_loss(output.rgb, batch.target), output.texture.detach()

    def train_epoch(self, epoch: int, book: EpochBook) -> None:
        first = epoch * self.steps_per_epoch

        def step(loss: Tensor) -> bool:
            return guarded_step(self.optimiser, loss, self.rate(first + book.steps))

        if self.walker is not None:
            for episode in range(self.episodes):
                self.walker.episode(epoch, episode, self.look, step, book)
            return
        # All candidates in random order, cycled to as many steps as an RL epoch has.
        random = step_random(self.seed, STEP1, epoch, -1)
        order: list[int] = []
        while len(order) < self.steps_per_epoch:
            order += [int(i) for i in random.permutation(len(self.views))]
        for view in order[: self.steps_per_epoch]:
            loss, _ = self.look(view)
            book.count(step(self.settings.weight_dnr * loss))
            book.add(dnr=float(loss.detach()))

    def trained(self) -> list[nn.Module]:
        return [self.dnr] if self.walker is None else [self.dnr, self.walker.agent]

    def more_trouble(self) -> str | None:
        return None if self.walker is None else self.walker.trouble()

    def more_state(self) -> tuple[checkpoint.Parts, dict[str, Any]]:
        if self.walker is None:
            return {}, {}
        walker = self.walker
        return walker.parts(), {"reward_mean": walker.scale.mean, "reward_unit": walker.unit}

    def load_more(self, saved: checkpoint.State) -> None:
        if self.walker is not None:
            self.walker.load(saved)

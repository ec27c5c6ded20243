"""What competes, as data: the policies of `dnrpipe select`, the paper's with each reward, and active learning."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ...core.presets import PAPER
from ...core.settings import Settings, merge
from ..cells.request import choose_names
from ..cells.tasks import StudyTask

LEARNED = "rl-paper"
"""The policy that the trainer's step 1 trains."""
Kind = Literal["rule", "active", "step1"]


@dataclass(frozen=True)
class Contender:
    """One line of the tables.

    policy: its name where it is computed. changes: nested settings. kind: rule, a policy of the trainer that needs no
    training (the best of the simple ones is what others are compared with); active, one of `active.batches`; step1, an
    agent that step 1 trains.
    """

    name: str
    what: str
    policy: str
    kind: Kind = "rule"
    changes: Mapping[str, Any] = field(default_factory=dict)


def _paper(name: str, what: str, reward: str) -> Contender:
    """The agent of `core.presets.PAPER`, with the coarse model that it watches; cells train the run's own model."""
    changes = merge(PAPER, {"select": {"step1": {"reward": reward}}})
    return Contender(name, f"the paper's RL selector, reward: {what}", LEARNED, "step1", changes)


_CONTENDERS = (
    Contender("random", "uniform, another draw per seed", "random"),
    Contender("farthest", "farthest-point sampling of camera poses", "farthest"),
    Contender("kmedoids", "k-medoids of camera poses", "kmedoids"),
    Contender("coverage", "greedy coverage: surface x view direction x resolution", "coverage"),
    Contender("ensemble", "active: where coarse renderers of the views so far disagree", "ensemble", "active"),
    Contender("variance", "active: where a coarse renderer of the views so far is least sure", "variance", "active"),
    _paper("rl-paper", "-loss (the paper's)", "neg-loss"),
    _paper("rl-hard", "+loss", "pos-loss"),
    _paper("rl-decrease", "decrease of the error on probe views", "improvement"),
    _paper("rl-own", "decrease of the error on the view itself", "improvement-own"),
    _paper("rl-all", "decrease of the error on all candidates", "improvement-all"),
)
CONTENDERS: dict[str, Contender] = {contender.name: contender for contender in _CONTENDERS}
SIMPLE = ("farthest", "kmedoids", "coverage")
"""The simple rules; the best of them in a pool is the baseline."""
GROUPS: dict[str, tuple[str, ...]] = {
    "core": tuple(c.name for c in _CONTENDERS if c.kind == "rule"),
    "simple": ("random", *SIMPLE),
    "auto": ("coverage",),  # what the default is
    "rewards": tuple(c.name for c in _CONTENDERS if c.policy == LEARNED),
    "all": tuple(CONTENDERS),
}


@dataclass(frozen=True)
class ActiveSettings:
    """members: renderers of policy ensemble, at least 2; variance trains one. rounds: batches in which views are added
    to the first third of the budget. epochs: each renderer's passes over the views chosen so far."""

    members: int = 3
    rounds: int = 2
    epochs: int = 10


class ActiveTask(StudyTask):
    """Choose views of a pool by active learning -> `SelectionResult`. folder: of its trainings, removed at the end."""

    settings: Settings
    policy: str
    folder: Path


def choose_policies(text: str) -> list[Contender]:
    """``"random,kmedoids"`` or groups, in the table's order. Raises UserError for unknown names."""
    return [CONTENDERS[name] for name in choose_names("--policies", "policy", text, CONTENDERS, GROUPS)]


def settings_of(contender: Contender, base: Settings, budget: int) -> Settings:
    """The run's settings with the contender's changes and the budget."""
    data = merge(base.model_dump(mode="json"), contender.changes)
    return Settings.model_validate(merge(data, {"select": {"budget": budget}}))


@functools.cache
def rules_fingerprint() -> str:
    """Hash of the sources of all rules: selections of other code are not kept, for they cost seconds."""
    import dnrtrain.selector

    whole = hashlib.sha256()
    for path in sorted(Path(dnrtrain.selector.__path__[0]).glob("*.py")):
        whole.update(path.name.encode() + b"\0" + path.read_bytes())
    return whole.hexdigest()[:24]

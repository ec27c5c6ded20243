"""The default: the rule that measured best."""

from __future__ import annotations

from typing import ClassVar

from .coverage import CoveragePolicy
from .exchange import ExchangePolicy
from .protocol import Candidates, Choice, Policy, Tick


class AutoPolicy:
    """``coverage``; ``exchange``, which then is k-medoids on poses, where it is not known what the candidates see.

    No learned selection was better than the rules, and of the rules coverage is the best on average: by hundredths of
    a dB, by more where the renderer paints from nothing (docs/bench-select.md).
    """

    looks: ClassVar[bool] = True
    effort: ClassVar[int] = CoveragePolicy.effort

    def choose(self, candidates: Candidates, budget: int, seed: int, tick: Tick | None = None) -> Choice:
        rule: Policy = ExchangePolicy() if candidates.sightings is None else CoveragePolicy()
        return rule.choose(candidates, budget, seed, tick)

"""Active learning on rasterised images: train on the views chosen so far, look where that leaves doubts, choose on.

What ``ensemble`` and ``variance`` have in common. The first third of the budget is chosen by k-medoids of poses. Then
views are added in batches: before each, small coarse renderers are trained from new weights on the rasterised images of
the views so far, and all candidates are judged by them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dnrtrain.dataset import ViewSet
from dnrtrain.model import DNR
from dnrtrain.selector.explain import explained
from dnrtrain.selector.greedy import lazy_greedy
from dnrtrain.selector.medoids import KMedoidsPolicy
from dnrtrain.selector.pool import canonical_order, complete_useful
from dnrtrain.selector.protocol import Candidates, Choice
from dnrtrain.selector.visibility import visibility_of

from ..policies import ActiveSettings
from .ensemble import Disagreement
from .pieces import Doubt, Observed, Pieces, pieces_of
from .variance import PredictedVariance

Train = Callable[[list[int], int, int], DNR]
"""train(views, batch, member): a new coarse renderer, trained on these candidates."""
KINDS: dict[str, type[Doubt]] = {"ensemble": Disagreement, "variance": PredictedVariance}
"""By policy."""


def sizes(budget: int, rounds: int) -> list[int]:
    """How many views are chosen after the start, a third, and after each batch; the last is ``budget``."""
    start = -(-budget // 3)
    return sorted({start, *(start + -(-(budget - start) * done // rounds) for done in range(1, rounds + 1))})


def choose_actively(
    policy: str,
    views: ViewSet,
    budget: int,
    seed: int,
    settings: ActiveSettings,
    train: Train,
) -> Choice:
    """Choose ``budget`` of the views. Gains of the first third are 0: k-medoids counts in another measure.

    policy: a key of KINDS. views: all candidates, targets = rasterised images. seed: of the variance head.
    """
    kind = KINDS[policy]
    count = kind.MODELS or settings.members
    visibility = visibility_of(views)
    # Their places in ``views`` travel with the candidates: the pool's rules put them in another order.
    known = Candidates(views.camera_positions, views.camera_directions, visibility, np.arange(len(views)))
    order = canonical_order(known)  # sums over all views are the same to the last bit whatever order they came in
    start, *wanted = sizes(budget, settings.rounds)
    first = KMedoidsPolicy().choose(known, start, seed)
    chosen, gains, why = list(first.views), [0.0] * start, ["k-medoids of poses, as a start"] * start
    batches: list[dict[str, Any]] = []
    left = first.details
    for number, size in enumerate(wanted, start=1):
        models = [train(chosen, number, member) for member in range(count)]
        doubt = kind(models, views, chosen, seed + number)
        table = [pieces_of(views, view, doubt.unsure(view)) for view in range(len(views))]
        more = complete_useful(known, chosen, size, _by(kind.BATCH([table[i] for i in order]), table))
        batches.append({"trained_on": len(chosen), "chosen": len(more.views), **doubt.facts()})
        for gain, reason in zip(more.gains, more.why, strict=True):
            why.append(f"batch {number}: {reason or kind.WORD.format(gain)}")
        chosen, gains, left = [*chosen, *more.views], [*gains, *more.gains], more.details
    why, facts = explained(visibility, chosen, why)
    trained = {"models": count, "epochs": settings.epochs}
    unused = {name: left[name] for name in ("duplicates", "see_nothing") if name in left}
    details = {"measure": kind.MEASURE, "start": start, "trained": trained, "batches": batches, **unused, **facts}
    return Choice(chosen, gains, why, details)


def _by(batch: Observed, table: list[Pieces]) -> Callable[[Candidates, list[int], int], Choice]:
    def choose(some: Candidates, kept: list[int], count: int) -> Choice:
        assert some.facts is not None  # given above
        others = [i for i in range(len(some)) if i not in set(kept)]
        pieces = [table[int(some.facts[i])] for i in others]
        order, gains = lazy_greedy(len(others), count, lambda i: batch.gain(pieces[i]), lambda i: batch.take(pieces[i]))
        return Choice([others[i] for i in order], gains, [""] * count)

    return choose

"""What all deterministic policies do with their pool: a fixed order, no duplicates, nothing that sees nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .geometry import camera_features, farthest_first
from .protocol import Candidates, Choice, check_budget


def choose_useful(candidates: Candidates, budget: int, choose: Callable[[Candidates, int], Choice]) -> Choice:
    """Run ``choose`` on the useful candidates; take the others only if the budget asks for more.

    The order in which ``choose`` gets the candidates depends on poses and pictures only, so a permutation of the
    candidates does not change the chosen set. Duplicates (the same picture; without visibility the same pose) come
    once. Views that see nothing come last.
    """
    return complete_useful(candidates, (), budget, lambda some, _, count: choose(some, count))


def complete_useful(
    candidates: Candidates,
    kept: Sequence[int],
    budget: int,
    choose: Callable[[Candidates, list[int], int], Choice],
) -> Choice:
    """The views that complete ``kept`` to ``budget``, chosen as in `choose_useful`; duplicates of kept views come last.

    Args:
        kept: views that are chosen already.
        choose: ``choose(some, kept, count)`` answers with ``count`` further views of ``some``.
    """
    check_budget(budget, len(candidates))
    order = canonical_order(candidates)
    ranked = candidates.take(order)
    place = np.argsort(order)
    old = np.zeros(len(order), bool)
    old[place[np.asarray(kept, np.int64)]] = True
    sees = np.ones(len(order), bool) if ranked.visibility is None else ranked.visibility.seen > 0
    first = _first_of_its_kind(ranked, old)
    useful = np.flatnonzero(sees & first)
    chosen = Choice([], [], [])
    wanted = min(budget - int(old.sum()), int((~old[useful]).sum()))
    if wanted > 0:
        inside = np.searchsorted(useful, [int(place[view]) for view in kept if (sees & first)[place[view]]])
        chosen = choose(ranked.take(useful), [int(i) for i in inside], wanted)
    views = [int(useful[i]) for i in chosen.views]
    gains, why = list(chosen.gains), list(chosen.why)
    for group, reason in ((sees & ~first, "a duplicate: all else was chosen"), (~sees, "sees nothing: all else was")):
        extra = _spread(ranked, np.flatnonzero(group & ~old), budget - int(old.sum()) - len(views))
        views += extra
        gains += [0.0] * len(extra)
        why += [reason] * len(extra)
    facts = {"duplicates": int((sees & ~first).sum()), "see_nothing": int((~sees).sum())}
    details = {**chosen.details, **{name: value for name, value in facts.items() if value}}
    return Choice([int(order[i]) for i in views], gains, why, details)


def canonical_order(candidates: Candidates) -> np.ndarray:
    """Indices sorted by position, direction and picture; by index only where all of these are equal."""
    keys = [*candidates.positions.T, *candidates.directions.T]
    if candidates.visibility is not None:
        keys.append(candidates.visibility.pictures)
    return np.lexsort(keys[::-1])


def _first_of_its_kind(candidates: Candidates, old: np.ndarray) -> np.ndarray:
    """Whether each view is the first of its duplicates, bool [N]; ``old`` [N] ones are before all others."""
    first = np.zeros(len(candidates), bool)
    if candidates.visibility is not None:
        kinds = candidates.visibility.pictures[:, None]
    else:
        kinds = np.concatenate([candidates.positions, candidates.directions], axis=1)
    order = np.argsort(~old, kind="stable")
    first[order[np.unique(kinds[order], axis=0, return_index=True)[1]]] = True
    return first


def _spread(candidates: Candidates, group: np.ndarray, wanted: int) -> list[int]:
    """Up to ``wanted`` views of ``group``, farthest-point sampling from the first."""
    if wanted <= 0 or not len(group):
        return []
    taken, _ = farthest_first(camera_features(candidates)[group], 0, min(wanted, len(group)))
    return [int(group[i]) for i in taken]

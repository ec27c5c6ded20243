"""Greedy maximisation of a set function with diminishing returns."""

from __future__ import annotations

import heapq
from collections.abc import Callable

from .protocol import Tick


def lazy_greedy(
    count: int,
    budget: int,
    gain: Callable[[int], float],
    take: Callable[[int], object],
    tick: Tick | None = None,
) -> tuple[list[int], list[float]]:
    """Elements 0 .. count − 1 in greedy order, ``budget`` of them, and what each added.

    Gains must not grow as elements are taken (submodularity); then an old gain bounds the present one from above,
    and most need no new look (CELF, Leskovec et al. 2007; the guarantee of 1 − 1/e is Nemhauser et al. 1978).
    The lowest index wins ties.

    Args:
        gain: what an element would add now.
        take: called once per element chosen.
    """

    def weigh(element: int) -> float:
        if tick is not None:
            tick(1)
        return -gain(element)

    heap = [(weigh(i), i, 0) for i in range(count)]
    heapq.heapify(heap)
    order: list[int] = []
    gains: list[float] = []
    while len(order) < budget:
        bound, element, looked = heapq.heappop(heap)
        if looked == len(order):
            order.append(element)
            gains.append(-bound)
            take(element)
        else:
            heapq.heappush(heap, (weigh(element), element, len(order)))
    return order, gains

"""What the command lines of `ablate` and `bench-select` ask for: settings, and names."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from ...core.errors import UserError
from ...core.settings import merge, parse_assignment

SMOKE_SCENE = "emissive_only"
SMOKE_RUN: dict[str, Any] = {
    "cameras": {"test": 2, "width": 32, "height": 32},
    "passes": {"raster": "cycles-direct", "coverage_samples": 16},
    "raytrace": {"spp": 16, "evaluation_spp": 32, "max_depth": 3},
    "select": {"step1": {"epochs": 2}},
    "finetune": {"step2": {"epochs": 4}},
}
"""What ``--smoke`` is about: a small scene, few epochs."""


def merged(layers: Sequence[Mapping[str, Any]], assignments: Sequence[str]) -> dict[str, Any]:
    """Nested settings, later ones first; ``assignments``, KEY=VALUE, before all.

    A study's settings come from its preset and from these alone, neither from the environment nor from dnrpipe.toml:
    the command that is kept in the results says all.
    """
    found: dict[str, Any] = {}
    for layer in (*layers, *map(parse_assignment, assignments)):
        found = merge(found, layer)
    return found


def epochs_of(steps: int, views: int, batch: int) -> int:
    """Passes over so many views that come nearest to ``steps`` optimiser steps, one at least."""
    return max(1, round(steps / math.ceil(views / batch)))


def choose_names(
    option: str,
    kind: str,
    text: str,
    names: Collection[str],
    groups: Mapping[str, Collection[str]],
) -> list[str]:
    """``"vanilla,dnr"``, or groups, in the order of ``names``, which are all there are.

    option, kind: the flag and what it names, for messages. Raises UserError: an unknown name, or none.
    """
    found: set[str] = set()
    for name in filter(None, (part.strip() for part in text.split(","))):
        if name not in groups and name not in names:
            near = difflib.get_close_matches(name, [*names, *groups], n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"groups: {', '.join(groups)}"
            raise UserError(f"{option} {name}: no such {kind} or group; {hint} ({option[2:]}: {', '.join(names)})")
        found.update(groups.get(name, (name,)))
    if not found:
        raise UserError(f"{option}: names no {kind}; choose of {', '.join([*groups, *names])}")
    return [name for name in names if name in found]

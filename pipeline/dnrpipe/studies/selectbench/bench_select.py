"""`dnrpipe bench-select` behind its options."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...core.console import Console
from ...core.errors import UserError
from ...core.settings import merge, resolve
from ..cells.request import merged
from ..cells.scenes import find_scenes
from .bench import Bench
from .policies import choose_policies
from .pools import choose_pools

SMOKE: dict[str, Any] = {
    "cameras": {"train": 10, "test": 2, "width": 32, "height": 32},
    "passes": {"raster": "cycles-direct", "coverage_samples": 16},
    "raytrace": {"spp": 16, "evaluation_spp": 32, "max_depth": 3},
    "model": {"base": "none", "chain": False, "filter": 0, "output": "display", "guides": False},
    "select": {"step1": {"epochs": 2}},
    "finetune": {"step2": {"epochs": 4}},
}
SMOKE_SCENE = "emissive_only"
SMOKE_REQUEST = {"pools": "dome,path", "budgets": "2,4", "policies": "random,farthest,kmedoids"}
CORE = {"pools": "all", "budgets": "10,25", "policies": "core"}
CANDIDATES = 100


def run_bench(
    *,
    scenes: str | None,
    pools: str | None,
    budgets: str | None,
    policies: str | None,
    views: int | None,
    preset: str,
    assignments: Sequence[str],
    smoke: bool,
    console: Console,
    **more: Any,
) -> dict[str, Any]:
    """Run what is due and write it -> the results. more: fields of `Study`.

    Settings come from the preset and these arguments alone, neither from the environment nor from
    dnrpipe.toml: the command that is kept in the results says all.

    Raises:
        UserError: unknown names, settings that do not fit. TasksFailed: some cells failed; the others are written.
    """
    # Step 2 trains all cells; validation views would cost passes and decide nothing.
    cameras = {"train": CANDIDATES, "val": 0}
    given = {} if views is None else {"cameras": {"train": views}}
    overrides = merged([{"cameras": cameras}, SMOKE if smoke else {}, given], assignments)
    count = resolve(preset, overrides, environment={}).cameras.train
    defaults = SMOKE_REQUEST if smoke else CORE
    wanted = choose_budgets(budgets or defaults["budgets"], count)
    base = resolve(preset, merge(overrides, {"select": {"budget": max(wanted)}}), environment={})
    if base.cameras.source != "auto":
        raise UserError(f"cameras.source={base.cameras.source}: the pools decide where cameras stand; use --pools")
    return Bench(
        sources=find_scenes(scenes or (SMOKE_SCENE if smoke else None)),
        pool_names=choose_pools(pools or defaults["pools"]),
        budgets=wanted,
        policies=choose_policies(policies or defaults["policies"]),
        base=base,
        console=console,
        **more,
    ).carry_out()


def choose_budgets(text: str, candidates: int) -> list[int]:
    """``"10,25"``, or ``"full"``: 5 to 30 by 5, then by 10 up to all candidates.

    Raises UserError: not a number, or not between 1 and the number of candidates.
    """
    found: set[int] = set()
    for part in filter(None, (part.strip() for part in text.split(","))):
        if part == "full":
            found |= {n for n in [*range(5, 31, 5), *range(40, candidates, 10), candidates] if n <= candidates}
        elif not part.isdecimal() or not 1 <= int(part) <= candidates:
            raise UserError(f"--budgets {part}: name numbers of views from 1 to {candidates} (--views), or full")
        else:
            found.add(int(part))
    if not found:
        raise UserError("--budgets: names none; for example 10,25")
    return sorted(found)

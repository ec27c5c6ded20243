"""Numbers from ``results.json``: means over scenes, spreads over seeds, paired differences and their confidence.

Two policies are compared where all else is equal: scene, pool, budget, seed. The seeds of a scene share its difficulty
and its candidates, so they are no independent trials: the unit is the *scene*, its value the mean over seeds, and the
interval is Student's over scenes. With a single scene the units are its seeds, and the interval speaks of that scene.
Only against the number of views (`Figures.paired`) is every pair a unit, and the interval speaks of these very scenes.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from ..cells.intervals import Difference, summarise
from .policies import SIMPLE
from .pools import POOLS

SPHERICAL = ("dome", "sphere")
Choice = tuple[str, int]
"""A policy, and how many views it chose."""


class Figures:
    """Cells by pool, budget, policy; then by (scene, seed).

    devices: scenes by what their cells were trained on. Of several, a CPU's cells alone have seconds: those are of the
    processor, a GPU's of the wall, with whatever shared it.
    """

    def __init__(self, results: Mapping[str, Any]) -> None:
        self.cells: dict[tuple[str, int, str], dict[tuple[str, int], dict[str, Any]]] = {}
        devices = [cell.get("device", results.get("device", "")) for cell in results["cells"]]
        self.devices: dict[str, list[str]] = {name: [] for name in devices}
        for device, cell in zip(devices, results["cells"], strict=True):
            if cell["scene"] not in self.devices[device]:
                self.devices[device].append(cell["scene"])
            if len(self.devices) > 1 and device != "cpu":
                cell = {**cell, **{name: None for name in cell if name.endswith("_seconds")}}
            place = (cell["pool"], cell["budget"], cell["policy"])
            self.cells.setdefault(place, {})[cell["scene"], cell["seed"]] = cell
        present = {(cell["scene"]) for cell in results["cells"]}
        self.scenes = [name for name in results["scenes"] if name in present]
        self.pools = [name for name in POOLS if any(place[0] == name for place in self.cells)]
        self.budgets = sorted({place[1] for place in self.cells})
        self.reaches_all = self.budgets[-1:] == [results.get("candidates")]
        # In the order of the run: published results name policies that are no longer offered, too.
        self.policies = list(dict.fromkeys(cell["policy"] for cell in results["cells"]))
        self.seeds = sorted({cell["seed"] for cell in results["cells"]})

    def values(self, pool: str, budget: int, policy: str, metric: str) -> dict[tuple[str, int], float]:
        """A metric by (scene, seed), where it was measured."""
        found = self.cells.get((pool, budget, policy), {})
        return {place: cell[metric] for place, cell in found.items() if cell.get(metric) is not None}

    def means(self, pool: str, budget: int, policy: str, metric: str) -> list[float]:
        """Means over all scenes, one per seed; seeds that lack a scene are left out."""
        values = self.values(pool, budget, policy, metric)
        whole = [seed for seed in self.seeds if all((scene, seed) in values for scene in self.scenes)]
        return [statistics.fmean(values[scene, seed] for scene in self.scenes) for seed in whole]

    def best_simple(self, pool: str, budget: int) -> str | None:
        """The simple rule of highest PSNR, a scene counting once, over the (scene, seed) that all simple rules have."""
        found = {name: self.values(pool, budget, name, "psnr") for name in SIMPLE}
        found = {name: values for name, values in found.items() if values}
        shared = set.intersection(*(set(values) for values in found.values())) if found else set()
        over = {name: summarise({place: values[place] for place in shared}) for name, values in found.items()}
        means = {name: known.mean for name, known in over.items() if known is not None}
        return max(means, key=means.__getitem__, default=None)

    def against(self, policy: str, kind: str, pools: Sequence[str], budget: int) -> Difference | None:
        """PSNR: policy - baseline, each pool with its own: ``random``, or its best simple rule for kind ``simple``.

        Over several pools it is the mean of each (scene, seed) over them. None where they share nothing, or where the
        policy is the baseline everywhere; where it is the baseline in some pools, these count as 0.
        """
        baselines = {pool: self.best_simple(pool, budget) if kind == "simple" else kind for pool in pools}
        baselines = {pool: baseline for pool, baseline in baselines.items() if baseline is not None}
        if all(baseline == policy for baseline in baselines.values()):
            return None
        found: dict[tuple[str, int], list[float]] = {}
        for pool, baseline in baselines.items():
            ours, theirs = (self.values(pool, budget, name, "psnr") for name in (policy, baseline))
            for place in ours.keys() & theirs.keys():
                found.setdefault(place, []).append(ours[place] - theirs[place])
        whole = {place: statistics.fmean(pairs) for place, pairs in found.items() if len(pairs) == len(baselines)}
        return summarise({place: whole[place] for place in sorted(whole)})

    def paired(self, pool: str, ours: Choice, theirs: Choice, metric: str) -> Difference | None:
        """Ours - theirs over all (scene, seed) that both have; its interval speaks of these scenes."""
        mine, other = (self.values(pool, budget, policy, metric) for policy, budget in (ours, theirs))
        return summarise({place: mine[place] - other[place] for place in sorted(mine.keys() & other)}, pairs=True)

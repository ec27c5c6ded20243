"""The sweep: every point is a row of an ablation, so that it shares its workers, coarse models and resuming.

Views, references and base images are traced once, into the workspace itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from ...core.errors import UserError
from ...core.settings import Settings
from ...core.workspace import Workspace
from ...stages.stage import Run
from ..ablation.ablate import Ablation
from ..ablation.rows import CLASSIC, ROWS, Row, ViewChoice
from ..cells.scenes import Scene, prepared

OTHERS = ("random", "all", "paper")
"""Other ways to train, compared at the settings' own samples and epochs."""


@dataclass(frozen=True)
class Sweep:
    """budgets (views), samples per pixel, optimiser steps: every combination is trained. also: of OTHERS."""

    budgets: tuple[int, ...]
    samples: tuple[int, ...]
    steps: tuple[int, ...]
    also: tuple[str, ...] = OTHERS

    def rows(self, settings: Settings) -> list[Row]:
        """All points as rows; the base image alone last. Raises UserError: no paper row at these sizes."""
        batch = settings.finetune.step2.batch
        found = [
            self._row(f"{views} views, {spp} spp, {steps} steps", views, spp, max(1, round(steps * batch / views)))
            for views in self.budgets
            for spp in self.samples
            for steps in self.steps
        ]
        spp, epochs = settings.raytrace.spp, settings.finetune.step2.epochs
        if "random" in self.also:
            found += [self._row(f"{views} random views", views, spp, epochs, "random") for views in self.budgets]
        if "all" in self.also:
            found.append(self._row("all candidates", None, spp, epochs, "all"))
        if "paper" in self.also:
            if settings.preset not in CLASSIC:
                raise UserError(
                    f"the paper's row has sizes for the presets {', '.join(CLASSIC)}; leave it out of --also"
                )
            found.append(replace(ROWS["paper"], budget=max(self.budgets)))
        if settings.model.base != "none":
            found.append(Row("base image alone", ROWS["base"].what, "dnr", network=False))
        return found

    @staticmethod
    def _row(name: str, views: int | None, spp: int, epochs: int, views_by: ViewChoice = "farthest") -> Row:
        changes = {"finetune": {"step2": {"epochs": epochs}}}
        return Row(name, name, "dnr", changes, views_by, budget=views, spp=spp)


@dataclass
class Frontier(Ablation):
    """An ablation of one scene: the workspace that is open."""

    workspace: Workspace = field(kw_only=True)

    def _open(self, source: Path) -> Scene:
        return prepared(source.stem, Run(self.workspace, self.request.base, self.console), "frontier")

    @property
    def scene(self) -> Scene:
        """The scene, once `run` has prepared it."""
        return self.scenes[0]
